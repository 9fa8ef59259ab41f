"""Settings of one environment: scene, task, physics, camera."""

import math
from dataclasses import dataclass, field

from segvisrl_jax.config.checks import require, require_divides, require_types
from segvisrl_jax.config.conditions import NEUTRAL, SCANLINE_ONLY, ConditionsConfig
from segvisrl_jax.config.names import EngineName, ObservationKind, RendererName

LARGEST_M = 1e4  # ten times the largest map: what is meant to be without a limit
LEAST_RING_M = 0.01  # width of the ring in which goals lie: a narrower one is hardly ever hit
LARGEST_REWARD = 10**6  # squared, and summed over a batch, it is still far from what a float32 can hold


@dataclass(frozen=True)
class SceneConfig:
    """The layout of the world (paper, section III-A; what is ours is said)."""

    map_size_m: float = 25.0
    """Side of the square map (paper)."""
    start_inset_m: float = 0.5
    """Start: the middle of one end of the map, this far inside the edge, facing inwards (the inset is ours)."""
    random_start_yaw_share: float = 0.0
    """Share of episodes that start with a uniformly random heading (ours; 0 is the paper's start)."""
    goal_distance_min_m: float = 10.0
    """The goal is uniform over the map, at least this far from the start (paper)."""
    goal_distance_max_m: float = 16.0
    """... and at most this far (ours: at 0.16 m/s, 100 s cover 16 m)."""
    num_rocks: int = 4
    """Rocks on the map (paper: 4). Said to `segvisrl train`, it takes the place of a preset's random_num_rocks_max and
    evaluation.rocks."""
    random_num_rocks_max: int = 0
    """Above 0: each training scene has a uniformly random number of rocks from 0 to this, in place of num_rocks (ours;
    test scenes have num_rocks, validation scenes evaluation.rocks where that is set)."""
    rock_start_clearance_m: float = 4.0
    """Least distance of a rock's centre from the start (paper)."""
    rock_goal_clearance_m: float = 1.75
    """Least distance of a rock's centre from the goal, so that every goal can be reached (ours)."""
    rock_radius_min_m: float = 0.15
    """Smallest radius in the rock library (ours)."""
    rock_radius_max_m: float = 0.30
    """Largest radius in the rock library (ours). Rocks do not overlap."""
    num_rock_shapes: int = 64
    """Different rocks in the library; a scene uses each at most once."""
    rock_shapes_seed: int = 0
    """Seed of the rock library."""
    sun_azimuth_deg: float = 60.0
    """Direction towards the sun, from x (forward) towards y (left); only RGB images see it."""
    sun_elevation_deg: float = 30.0
    """Height of the sun above the horizon."""

    @property
    def most_rocks(self) -> int:
        """Most rocks that a scene can have."""
        return self.random_num_rocks_max or self.num_rocks

    @property
    def start_xy_m(self) -> tuple[float, float]:
        """Where the rover starts, in the world frame."""
        return (-self.map_size_m / 2 + self.start_inset_m, 0.0)

    def __post_init__(self) -> None:
        p = "scene"
        require_types(self, p)
        half = self.map_size_m / 2
        require(0 < self.map_size_m <= 1000, f"{p}.map_size_m", self.map_size_m, "in (0, 1000] metres")
        require(0 <= self.start_inset_m < half, f"{p}.start_inset_m", self.start_inset_m, f"in [0, {half})")
        share = self.random_start_yaw_share
        require(0 <= share <= 1, f"{p}.random_start_yaw_share", share, "in [0, 1]")
        low, high = self.goal_distance_min_m, self.goal_distance_max_m
        require(low > 0, f"{p}.goal_distance_min_m", low, "positive")
        should = f"at least {LEAST_RING_M} more than goal_distance_min_m = {low}, and at most {LARGEST_M:g} metres"
        require(low + LEAST_RING_M <= high <= LARGEST_M, f"{p}.goal_distance_max_m", high, should)
        reach = math.hypot(self.map_size_m - self.start_inset_m, half)
        require(
            low < 0.98 * reach, f"{p}.goal_distance_min_m", low, f"below {0.98 * reach:.2f}, so that it fits the map"
        )
        require(self.num_rock_shapes >= 1, f"{p}.num_rock_shapes", self.num_rock_shapes, "at least 1")
        require(self.num_rock_shapes <= 1024, f"{p}.num_rock_shapes", self.num_rock_shapes, "at most 1024")
        for name in ("num_rocks", "random_num_rocks_max"):
            rocks, shapes = getattr(self, name), self.num_rock_shapes
            require(rocks >= 0, f"{p}.{name}", rocks, "0 or more")
            require(rocks <= shapes, f"{p}.{name}", rocks, f"at most num_rock_shapes = {shapes}")
        small, large = self.rock_radius_min_m, self.rock_radius_max_m
        require(small >= 0.02, f"{p}.rock_radius_min_m", small, "at least 0.02")
        should = f"at least rock_radius_min_m = {small}, and at most 10 metres"
        require(small <= large <= 10, f"{p}.rock_radius_max_m", large, should)
        for name in ("rock_start_clearance_m", "rock_goal_clearance_m"):
            clearance = getattr(self, name)
            require(0 <= clearance <= 1000, f"{p}.{name}", clearance, "in [0, 1000] metres")
        require(0 <= self.rock_shapes_seed < 2**32, f"{p}.rock_shapes_seed", self.rock_shapes_seed, "in [0, 2^32)")
        require(1 <= self.sun_elevation_deg <= 90, f"{p}.sun_elevation_deg", self.sun_elevation_deg, "in [1, 90]")
        require(-360 <= self.sun_azimuth_deg <= 360, f"{p}.sun_azimuth_deg", self.sun_azimuth_deg, "in [-360, 360]")
        self._require_room_for_rocks()

    def _require_room_for_rocks(self) -> None:
        """Rejection sampling of rocks must always find a place: at least a tenth of the free area stays free."""
        kept_clear = math.pi * (self.rock_start_clearance_m**2 + self.rock_goal_clearance_m**2)
        per_rock = math.pi * (2 * self.rock_radius_max_m) ** 2
        free = self.map_size_m**2 - kept_clear
        most = max(0, int(0.9 * free / per_rock))
        should = f"at most {most} for rocks of {self.rock_radius_max_m} m on this map, so that they fit without overlap"
        for name in ("num_rocks", "random_num_rocks_max"):
            require(getattr(self, name) <= most, f"scene.{name}", getattr(self, name), should)


@dataclass(frozen=True)
class TaskConfig:
    """Reward and outcome (paper, section III-B)."""

    decision_dt_s: float = 1.0
    """Time between two decisions of the agent (paper)."""
    judge_dt_s: float = 0.2
    """Outcome and reward are judged at the end of each such interval (paper)."""
    max_decisions: int = 100
    """Time limit of an episode (paper)."""
    collision_radius_m: float = 0.5
    """Collision: the rover within this distance of a rock's centre (paper)."""
    collision_margin_m: float = 0.0
    """In training, a collision is judged this much farther from a rock (ours; held-out scenes have no margin)."""
    goal_radius_m: float = 1.0
    """Success: the rover within this distance of the goal's centre (paper)."""
    max_tilt_deg: float = 60.0
    """Fall: the up axis further off vertical than this, or the rover outside the map (the tilt is ours)."""
    progress_reward_per_m: float = 100.0
    """Reward per metre towards the goal, and minus that per metre away from it (paper)."""
    collision_reward: float = -100.0
    """For coming too near to a rock (paper)."""
    fall_reward: float = -100.0
    """For leaving the map or tipping over (paper)."""
    timeout_reward: float = -20.0
    """For reaching the time limit (paper)."""

    @property
    def num_judgements(self) -> int:
        """Judged instants in one decision."""
        return round(self.decision_dt_s / self.judge_dt_s)

    def __post_init__(self) -> None:
        p = "task"
        require_types(self, p)
        for name in ("judge_dt_s", "decision_dt_s"):
            seconds = getattr(self, name)
            require(1e-4 <= seconds <= 3600, f"{p}.{name}", seconds, "in [0.0001, 3600] seconds")
        require_divides(self.judge_dt_s, self.decision_dt_s, f"{p}.judge_dt_s", f"{p}.decision_dt_s")
        require(1 <= self.max_decisions <= 10**6, f"{p}.max_decisions", self.max_decisions, "in [1, 1000000]")
        for name in ("collision_radius_m", "goal_radius_m"):
            radius = getattr(self, name)
            require(0 < radius <= 1000, f"{p}.{name}", radius, "in (0, 1000] metres")
        margin = self.collision_margin_m
        require(0 <= margin <= 10, f"{p}.collision_margin_m", margin, "in [0, 10] metres")
        require(0 < self.max_tilt_deg < 180, f"{p}.max_tilt_deg", self.max_tilt_deg, "in (0, 180)")
        for name in ("progress_reward_per_m", "collision_reward", "fall_reward", "timeout_reward"):
            reward = getattr(self, name)
            require(abs(reward) <= LARGEST_REWARD, f"{p}.{name}", reward, f"in [-{LARGEST_REWARD}, {LARGEST_REWARD}]")


@dataclass(frozen=True)
class PhysicsConfig:
    """The simulation. Rover geometry, masses and motors are in mjcf/rover.xml."""

    engine: EngineName = "auto"
    """native: MuJoCo C on a pool of threads; mjx: MJX, on the device; auto: mjx on an accelerator, else native."""
    timestep_s: float = 0.05
    """MuJoCo's own time step; it divides task.judge_dt_s."""
    gravity_m_s2: float = 1.62
    """The Moon's."""
    top_speed_m_s: float = 0.2
    """Speed of the rover at full command (paper)."""
    wheel_friction: float = 0.8
    """Sliding friction between wheels and ground (ours)."""
    num_threads: int = 0
    """Threads of the native engine; 0 takes one per core."""

    def __post_init__(self) -> None:
        p = "physics"
        require_types(self, p)
        require(
            1e-4 <= self.timestep_s <= 0.05,
            f"{p}.timestep_s",
            self.timestep_s,
            "in [0.0001, 0.05], where the wheels are stable",
        )
        require(0 < self.gravity_m_s2 <= 30, f"{p}.gravity_m_s2", self.gravity_m_s2, "in (0, 30]")
        require(0 < self.top_speed_m_s <= 2, f"{p}.top_speed_m_s", self.top_speed_m_s, "in (0, 2]")
        require(0.05 <= self.wheel_friction <= 5, f"{p}.wheel_friction", self.wheel_friction, "in [0.05, 5]")
        require(0 <= self.num_threads <= 4096, f"{p}.num_threads", self.num_threads, "in [0, 4096]")


@dataclass(frozen=True)
class CameraConfig:
    """The camera (a RealSense D435, paper section III-A) and how far its image is shrunk."""

    width_px: int = 1920
    """Columns of the image before it is shrunk (paper)."""
    height_px: int = 1080
    """Its rows (paper)."""
    horizontal_fov_deg: float = 69.4
    """Field of view; the vertical one follows from it, for square pixels."""
    near_m: float = 0.01
    """What is nearer is not drawn."""
    far_m: float = 20.0
    """What lies beyond is space."""
    scale: float = 10.0
    """Bicubic downsampling per axis (paper: 10, so 192 x 108)."""

    @property
    def vertical_fov_deg(self) -> float:
        """MuJoCo's ``fovy``, for square pixels."""
        half = math.tan(math.radians(self.horizontal_fov_deg) / 2) * self.height_px / self.width_px
        return math.degrees(2 * math.atan(half))

    @property
    def observation_size_px(self) -> tuple[int, int]:
        """(rows, columns) of the downsampled image."""
        return (round(self.height_px / self.scale), round(self.width_px / self.scale))

    def __post_init__(self) -> None:
        p = "camera"
        require_types(self, p)
        require(4 <= self.width_px <= 8192, f"{p}.width_px", self.width_px, "in [4, 8192]")
        require(4 <= self.height_px <= 8192, f"{p}.height_px", self.height_px, "in [4, 8192]")
        fov = self.horizontal_fov_deg
        require(5 <= fov <= 150, f"{p}.horizontal_fov_deg", fov, "in [5, 150]")
        require(0 < self.far_m <= LARGEST_M, f"{p}.far_m", self.far_m, f"in (0, {LARGEST_M:g}] metres")
        require(0 < self.near_m < self.far_m, f"{p}.near_m", self.near_m, f"between 0 and far_m = {self.far_m}")
        largest = min(self.width_px, self.height_px) / 4
        require(self.scale >= 1, f"{p}.scale", self.scale, "1 or more")
        should = f"at most {largest:g}, so that at least 4 pixels are left per axis"
        require(min(self.observation_size_px) >= 4, f"{p}.scale", self.scale, should)


@dataclass(frozen=True)
class EnvConfig:
    """One environment: what is seen, by which renderer, in which world."""

    obs: ObservationKind = "segmentation"
    """segmentation: four classes, coloured and shrunk; rgb: colour, only shrunk; state: a vector, no camera;
    state_and_rocks: a vector that holds the nearest rocks too."""
    renderer: RendererName = "auto"
    """scanline: in the compiled program; gl: MuJoCo's own renderer, behind a callback; warp: MuJoCo Warp's ray caster,
    a call out of the program, needs segvisrl_jax[warp]; auto: scanline."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    conditions: ConditionsConfig = field(default_factory=ConditionsConfig)

    def __post_init__(self) -> None:
        require_types(self, "env")
        require_divides(self.physics.timestep_s, self.task.judge_dt_s, "physics.timestep_s", "task.judge_dt_s")
        radius, limit = self.scene.rock_radius_max_m, self.task.collision_radius_m
        should = (
            f"below task.collision_radius_m = {limit}, so that a collision is judged before the rover touches the rock"
        )
        require(radius < limit, "scene.rock_radius_max_m", radius, should)
        clearance, needed = self.scene.rock_goal_clearance_m, limit + self.task.collision_margin_m
        should = f"more than task.collision_radius_m + collision_margin_m = {needed}, so that the goal can be reached"
        require(clearance > needed, "scene.rock_goal_clearance_m", clearance, should)
        clearance, should = (
            self.scene.rock_start_clearance_m,
            should.replace("the goal can be reached", "no rover starts in a collision"),
        )
        require(clearance > needed, "scene.rock_start_clearance_m", clearance, should)
        radius, nearest = self.task.goal_radius_m, self.scene.goal_distance_min_m
        should = f"below scene.goal_distance_min_m = {nearest}, so that no rover starts at its goal"
        require(radius < nearest, "task.goal_radius_m", radius, should)
        self._require_conditions_that_fit()

    def _require_conditions_that_fit(self) -> None:
        """What conditions ask of the other parts."""
        p, conditions, judge_dt = "conditions", self.conditions, self.task.judge_dt_s
        latency, count = conditions.latency_s, conditions.latency_s / judge_dt
        fits = abs(count - round(count)) < 1e-6 and round(count) <= self.task.num_judgements
        should = f"a multiple of task.judge_dt_s = {judge_dt}, at most task.decision_dt_s = {self.task.decision_dt_s}"
        require(fits, f"{p}.latency_s", latency, should)
        varied = conditions.varied(self.obs)
        if self.renderer in ("gl", "warp"):
            for name in (name for name in SCANLINE_ONLY if name in varied):
                name, neutral = ("randomize", False) if conditions.draws(name) else (name, NEUTRAL[name])
                should = f"{neutral!r} with env.renderer = {self.renderer!r}; scanline draws it"
                require(False, f"{p}.{name}", getattr(conditions, name), should)
        if "num_ghost_rocks" in varied:
            needed, shapes = self.scene.most_rocks + conditions.most_ghost_rocks, self.scene.num_rock_shapes
            should = f"at least {needed}, one for every rock and every ghost (conditions.num_ghost_rocks, randomize)"
            require(shapes >= needed, "scene.num_rock_shapes", shapes, should)
