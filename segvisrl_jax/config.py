"""Every setting of the project, one frozen dataclass per part, checked when it is built.

Units are in the names. A wrong value raises ``ConfigError`` with one line: the field, the value, what would be right.
This file owns settings and their checks; it computes nothing that depends on JAX or MuJoCo.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

Arch = Literal["cnn_lstm", "cnn", "cnn_lstm_raw", "mlp"]
ObservationKind = Literal["segmentation", "rgb", "state"]
RendererName = Literal["auto", "scanline", "gl"]
EngineName = Literal["auto", "native", "mjx"]
PresetName = Literal["paper", "cpu", "gpu", "smoke"]


class ConfigError(ValueError):
    """A setting that cannot be used: the message names the field, the value and what would be right."""


def require(condition: bool, name: str, value: object, should: str) -> None:
    """Raises ``ConfigError`` naming the field, its value and what it should be, unless ``condition`` holds."""
    if not condition:
        raise ConfigError(f"{name} = {value!r}: should be {should}")


def _require_finite_numbers(part: Any, prefix: str) -> None:
    """Every float of a config part is a finite real number, every int an int, every bool a bool."""
    for f in dataclasses.fields(part):
        value = getattr(part, f.name)
        name = f"{prefix}.{f.name}"
        if f.type in (float, "float"):
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            require(is_number and math.isfinite(value), name, value, "a finite number")
        elif f.type in (int, "int"):
            require(isinstance(value, int) and not isinstance(value, bool), name, value, "a whole number")
        elif f.type in (bool, "bool"):
            require(isinstance(value, bool), name, value, "True or False")


def _require_choice(value: object, choices: Any, name: str) -> None:
    options = choices.__args__
    require(value in options, name, value, "one of " + ", ".join(options))


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
    """Rocks on the map (paper: 4)."""
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
    def start_xy_m(self) -> tuple[float, float]:
        """Where the rover starts, in the world frame."""
        return (-self.map_size_m / 2 + self.start_inset_m, 0.0)

    def __post_init__(self) -> None:
        p = "scene"
        _require_finite_numbers(self, p)
        half = self.map_size_m / 2
        require(0 < self.map_size_m <= 1000, f"{p}.map_size_m", self.map_size_m, "in (0, 1000] metres")
        require(0 <= self.start_inset_m < half, f"{p}.start_inset_m", self.start_inset_m, f"in [0, {half})")
        share = self.random_start_yaw_share
        require(0 <= share <= 1, f"{p}.random_start_yaw_share", share, "in [0, 1]")
        low, high = self.goal_distance_min_m, self.goal_distance_max_m
        require(low > 0, f"{p}.goal_distance_min_m", low, "positive")
        require(high > low, f"{p}.goal_distance_max_m", high, f"more than goal_distance_min_m = {low}")
        reach = math.hypot(self.map_size_m - self.start_inset_m, half)
        require(low < 0.98 * reach, f"{p}.goal_distance_min_m", low, f"below {0.98 * reach:.2f}, so that it fits the map")
        require(self.num_rock_shapes >= 1, f"{p}.num_rock_shapes", self.num_rock_shapes, "at least 1")
        require(self.num_rock_shapes <= 1024, f"{p}.num_rock_shapes", self.num_rock_shapes, "at most 1024")
        rocks = self.num_rocks
        require(rocks >= 0, f"{p}.num_rocks", rocks, "0 or more")
        require(rocks <= self.num_rock_shapes, f"{p}.num_rocks", rocks, f"at most num_rock_shapes = {self.num_rock_shapes}")
        small, large = self.rock_radius_min_m, self.rock_radius_max_m
        require(small >= 0.02, f"{p}.rock_radius_min_m", small, "at least 0.02")
        require(large >= small, f"{p}.rock_radius_max_m", large, f"at least rock_radius_min_m = {small}")
        require(self.rock_start_clearance_m >= 0, f"{p}.rock_start_clearance_m", self.rock_start_clearance_m, "0 or more")
        require(self.rock_goal_clearance_m >= 0, f"{p}.rock_goal_clearance_m", self.rock_goal_clearance_m, "0 or more")
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
        require(self.num_rocks <= most, "scene.num_rocks", self.num_rocks, should)


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
    goal_radius_m: float = 1.0
    """Success: the rover within this distance of the goal's centre (paper)."""
    max_tilt_deg: float = 60.0
    """Fall: the up axis further off vertical than this, or the rover outside the map (the tilt is ours)."""
    progress_reward_per_m: float = 100.0
    """Reward per metre towards the goal, and minus that per metre away from it (paper)."""
    collision_reward: float = -100.0
    fall_reward: float = -100.0
    timeout_reward: float = -20.0

    @property
    def num_judgements(self) -> int:
        """Judged instants in one decision."""
        return round(self.decision_dt_s / self.judge_dt_s)

    def __post_init__(self) -> None:
        p = "task"
        _require_finite_numbers(self, p)
        require(self.judge_dt_s > 0, f"{p}.judge_dt_s", self.judge_dt_s, "positive")
        require(self.decision_dt_s > 0, f"{p}.decision_dt_s", self.decision_dt_s, "positive")
        _require_divides(self.judge_dt_s, self.decision_dt_s, f"{p}.judge_dt_s", f"{p}.decision_dt_s")
        require(1 <= self.max_decisions <= 10**6, f"{p}.max_decisions", self.max_decisions, "in [1, 1000000]")
        require(self.collision_radius_m > 0, f"{p}.collision_radius_m", self.collision_radius_m, "positive")
        require(self.goal_radius_m > 0, f"{p}.goal_radius_m", self.goal_radius_m, "positive")
        require(0 < self.max_tilt_deg < 180, f"{p}.max_tilt_deg", self.max_tilt_deg, "in (0, 180)")


def _require_divides(part: float, whole: float, part_name: str, whole_name: str) -> None:
    count = whole / part
    divides = count >= 1 - 1e-9 and abs(count - round(count)) < 1e-6
    require(divides, part_name, part, f"a whole fraction of {whole_name} = {whole}")


@dataclass(frozen=True)
class PhysicsConfig:
    """The simulation. Rover geometry, masses and motors are in mjcf/rover.xml."""

    engine: EngineName = "auto"
    """native: MuJoCo C on a pool of threads; mjx: MJX, on the device; auto: mjx on an accelerator, else native."""
    timestep_s: float = 0.04
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
        _require_finite_numbers(self, p)
        _require_choice(self.engine, EngineName, f"{p}.engine")
        require(1e-4 <= self.timestep_s <= 0.05, f"{p}.timestep_s", self.timestep_s, "in [0.0001, 0.05], where the wheels are stable")
        require(0 < self.gravity_m_s2 <= 30, f"{p}.gravity_m_s2", self.gravity_m_s2, "in (0, 30]")
        require(0 < self.top_speed_m_s <= 2, f"{p}.top_speed_m_s", self.top_speed_m_s, "in (0, 2]")
        require(0.05 <= self.wheel_friction <= 5, f"{p}.wheel_friction", self.wheel_friction, "in [0.05, 5]")
        require(0 <= self.num_threads <= 4096, f"{p}.num_threads", self.num_threads, "in [0, 4096]")


@dataclass(frozen=True)
class CameraConfig:
    """The camera (a RealSense D435, paper section III-A) and how far its image is shrunk."""

    width_px: int = 1920
    height_px: int = 1080
    horizontal_fov_deg: float = 69.4
    near_m: float = 0.01
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
        _require_finite_numbers(self, p)
        require(4 <= self.width_px <= 8192, f"{p}.width_px", self.width_px, "in [4, 8192]")
        require(4 <= self.height_px <= 8192, f"{p}.height_px", self.height_px, "in [4, 8192]")
        fov = self.horizontal_fov_deg
        require(5 <= fov <= 150, f"{p}.horizontal_fov_deg", fov, "in [5, 150]")
        require(0 < self.near_m < self.far_m, f"{p}.near_m", self.near_m, f"between 0 and far_m = {self.far_m}")
        largest = min(self.width_px, self.height_px) / 4
        require(1 <= self.scale, f"{p}.scale", self.scale, "1 or more")
        should = f"at most {largest:g}, so that at least 4 pixels are left per axis"
        require(min(self.observation_size_px) >= 4, f"{p}.scale", self.scale, should)


@dataclass(frozen=True)
class EnvConfig:
    """One environment: what is seen, by which renderer, in which world."""

    obs: ObservationKind = "segmentation"
    """segmentation: four classes, coloured and shrunk; rgb: colour, only shrunk; state: a vector, no camera."""
    renderer: RendererName = "auto"
    """scanline: in the compiled program; gl: MuJoCo's own renderer, behind a callback; auto: scanline where it can."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)

    def __post_init__(self) -> None:
        _require_choice(self.obs, ObservationKind, "env.obs")
        _require_choice(self.renderer, RendererName, "env.renderer")
        _require_divides(self.physics.timestep_s, self.task.judge_dt_s, "physics.timestep_s", "task.judge_dt_s")
        radius, limit = self.scene.rock_radius_max_m, self.task.collision_radius_m
        should = f"below task.collision_radius_m = {limit}, so that a collision is judged before the rover touches the rock"
        require(radius < limit, "scene.rock_radius_max_m", radius, should)
        clearance, needed = self.scene.rock_goal_clearance_m, limit
        should = f"more than task.collision_radius_m = {needed}, so that the goal can be reached"
        require(clearance > needed, "scene.rock_goal_clearance_m", clearance, should)


@dataclass(frozen=True)
class NetworkConfig:
    """The policy and value network (paper, section III-D)."""

    channels: tuple[int, ...] = (16, 32, 32)
    """Channels of the Impala CNN's stages (paper)."""
    blocks_per_stage: int = 2
    """Residual blocks in each stage (paper)."""
    feature_size: int = 256
    """Width of the dense layer behind the CNN."""
    lstm_size: int = 256
    """Width of the LSTM."""
    mlp_sizes: tuple[int, ...] = (128, 128)
    """Hidden layers of the mlp architecture."""
    bounded_mean: bool = True
    """The Gaussian's mean is squashed to the wheels' range [0, 1]; else it is free."""
    initial_std: float = 0.25
    """Standard deviation of the action at the start, as a share of the top speed."""

    def __post_init__(self) -> None:
        p = "network"
        _require_finite_numbers(self, p)
        for name, sizes in (("channels", self.channels), ("mlp_sizes", self.mlp_sizes)):
            good = isinstance(sizes, tuple) and len(sizes) > 0
            good = good and all(type(size) is int and 1 <= size <= 4096 for size in sizes)
            require(good, f"{p}.{name}", sizes, "one or more whole numbers in [1, 4096]")
        require(0 <= self.blocks_per_stage <= 16, f"{p}.blocks_per_stage", self.blocks_per_stage, "in [0, 16]")
        require(1 <= self.feature_size <= 8192, f"{p}.feature_size", self.feature_size, "in [1, 8192]")
        require(1 <= self.lstm_size <= 8192, f"{p}.lstm_size", self.lstm_size, "in [1, 8192]")
        require(0 < self.initial_std <= 10, f"{p}.initial_std", self.initial_std, "in (0, 10]")


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (paper, table I, gives steps, epochs, rates and weights)."""

    num_envs: int = 32
    """Environments that drive at once (paper: 1)."""
    unroll_length: int = 64
    """Decisions of each environment between two updates (paper: 64)."""
    num_minibatches: int = 8
    """Parts of a batch, cut by environment and never in time (paper: 1)."""
    num_epochs: int = 4
    """Passes over a batch (paper: 4)."""
    learning_rate: float = 1e-3
    """Adam's rate at the start (paper: 3e-4)."""
    final_learning_rate_share: float = 0.05
    """The rate falls linearly to this share of itself at the end (paper: 1, constant)."""
    discount: float = 0.97
    """Per decision (paper: 0.85)."""
    gae_lambda: float = 0.95
    """(paper: 0.95)."""
    clip_epsilon: float = 0.2
    """(paper: 0.2)."""
    entropy_cost: float = 0.006
    """(paper: 0.01)."""
    value_cost: float = 0.5
    """(paper: 0.5)."""
    max_gradient_norm: float = 0.5
    """(paper: 0.5)."""
    reward_scale: float = 0.01
    """Rewards are multiplied by this before learning (paper: 1)."""
    normalize_advantage: bool = True
    """Advantages of a batch are shifted and scaled to mean 0, deviation 1."""
    kl_stop: float = 0.03
    """A batch's epochs end early once the policy moved this far (approximate KL); 0 never stops."""
    bootstrap_on_timeout: bool = False
    """Whether the value of the last state stands in for what the time limit cut off. Off: the timeout reward is the end."""

    @property
    def decisions_per_update(self) -> int:
        """Decisions in one batch."""
        return self.num_envs * self.unroll_length

    def __post_init__(self) -> None:
        p = "ppo"
        _require_finite_numbers(self, p)
        for name in ("num_envs", "unroll_length", "num_minibatches", "num_epochs"):
            value = getattr(self, name)
            require(1 <= value <= 10**6, f"{p}.{name}", value, "in [1, 1000000]")
        divides = self.num_envs % self.num_minibatches == 0
        should = f"a divisor of num_envs = {self.num_envs}, since minibatches are cut by environment"
        require(divides, f"{p}.num_minibatches", self.num_minibatches, should)
        require(0 < self.learning_rate <= 1, f"{p}.learning_rate", self.learning_rate, "in (0, 1]")
        for name in ("final_learning_rate_share", "discount", "gae_lambda"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"{p}.{name}", value, "in [0, 1]")
        require(0 < self.clip_epsilon < 10, f"{p}.clip_epsilon", self.clip_epsilon, "in (0, 10)")
        require(self.max_gradient_norm > 0, f"{p}.max_gradient_norm", self.max_gradient_norm, "positive")
        require(self.reward_scale > 0, f"{p}.reward_scale", self.reward_scale, "positive")
        for name in ("entropy_cost", "value_cost", "kl_stop"):
            value = getattr(self, name)
            require(value >= 0, f"{p}.{name}", value, "0 or more")


@dataclass(frozen=True)
class EvaluationConfig:
    """Held-out evaluation while training: on validation scenes, with deterministic actions."""

    every_decisions: int = 40_960
    """Training decisions between two evaluations (rounded up to whole updates)."""
    episodes: int = 200
    """Episodes of each."""
    num_slots: int = 64
    """Episodes that are driven at the same time; the scenes are the same for any number."""

    def __post_init__(self) -> None:
        p = "evaluation"
        _require_finite_numbers(self, p)
        require(self.every_decisions >= 1, f"{p}.every_decisions", self.every_decisions, "1 or more")
        require(1 <= self.episodes <= 10**7, f"{p}.episodes", self.episodes, "in [1, 10000000]")
        require(1 <= self.num_slots <= 10**5, f"{p}.num_slots", self.num_slots, "in [1, 100000]")


@dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    arch: Arch = "cnn_lstm"
    """cnn_lstm, cnn: segmented images, with and without memory; cnn_lstm_raw: colour images; mlp: the true state."""
    preset: PresetName = "cpu"
    """Where the defaults came from."""
    seed: int = 0
    steps: int = 327_680
    """Training decisions in all (rounded up to whole updates)."""
    run: str = ""
    """Name of the run's folder; empty: made from arch, preset and seed."""
    runs_dir: str = "runs"
    """Where run folders go."""
    resume: bool = False
    """Go on from the run folder's last checkpoint."""
    checkpoint_every_updates: int = 8
    env: EnvConfig = field(default_factory=EnvConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    @property
    def run_name(self) -> str:
        """The run folder's name."""
        return self.run or f"{self.arch}-{self.preset}-seed{self.seed}"

    @property
    def num_updates(self) -> int:
        """Updates that ``steps`` come to."""
        return -(-self.steps // self.ppo.decisions_per_update)

    def __post_init__(self) -> None:
        _require_choice(self.arch, Arch, "arch")
        _require_choice(self.preset, PresetName, "preset")
        for name in ("seed", "steps", "checkpoint_every_updates"):
            value = getattr(self, name)
            require(type(value) is int, name, value, "a whole number")
        require(0 <= self.seed < 2**31, "seed", self.seed, "in [0, 2^31)")
        require(1 <= self.steps <= 10**12, "steps", self.steps, "in [1, 10^12]")
        require(self.checkpoint_every_updates >= 1, "checkpoint_every_updates", self.checkpoint_every_updates, "1 or more")
        is_plain = isinstance(self.run, str) and "/" not in self.run and self.run not in (".", "..") and "\0" not in self.run
        require(is_plain, "run", self.run, "a folder's name without slashes")
        seen = ARCH_OBSERVATION[self.arch]
        require(self.env.obs == seen, "env.obs", self.env.obs, f"{seen} for arch {self.arch}")


ARCH_OBSERVATION: dict[str, ObservationKind] = {
    "cnn_lstm": "segmentation",
    "cnn": "segmentation",
    "cnn_lstm_raw": "rgb",
    "mlp": "state",
}
"""What each architecture reads."""

_PRESETS: dict[str, dict[str, Any]] = {
    # The paper's table I; where it is silent, this project's defaults.
    "paper": {
        "steps": 5_000_000,
        "scale": 10.0,
        "num_envs": 1,
        "unroll_length": 64,
        "num_minibatches": 1,
        "num_epochs": 4,
        "learning_rate": 3e-4,
        "final_learning_rate_share": 1.0,
        "discount": 0.85,
        "entropy_cost": 0.01,
        "kl_stop": 0.0,
        "reward_scale": 1.0,
        "bounded_mean": False,
        "initial_std": 1.0,
        "every_decisions": 102_400,
        "checkpoint_every_updates": 200,
    },
    # A 48 x 27 image: 16 times less work for the network than 192 x 108, with goal and rocks still in view at 16 m.
    "cpu": {"steps": 327_680, "scale": 40.0, "random_start_yaw_share": 0.5},
    # The paper's image over many environments: large batches fill an accelerator.
    "gpu": {
        "steps": 5_000_000,
        "scale": 10.0,
        "random_start_yaw_share": 0.5,
        "num_envs": 512,
        "num_minibatches": 16,
        "unroll_length": 64,
        "every_decisions": 327_680,
        "episodes": 500,
        "num_slots": 500,
    },
    # Everything once, at a size that only shows that it runs.
    "smoke": {
        "steps": 512,
        "scale": 120.0,
        "num_envs": 4,
        "unroll_length": 32,
        "num_minibatches": 2,
        "num_epochs": 2,
        "every_decisions": 256,
        "episodes": 8,
        "num_slots": 8,
        "checkpoint_every_updates": 1,
    },
}


def preset_config(arch: str, preset: str) -> TrainConfig:
    """The settings of a preset for an architecture.

    Raises:
        ConfigError: for an architecture or preset that does not exist.
    """
    _require_choice(arch, Arch, "arch")
    _require_choice(preset, PresetName, "preset")
    env = EnvConfig(obs=ARCH_OBSERVATION[arch])
    base = TrainConfig(arch=arch, preset=preset, env=env)  # type: ignore[arg-type]
    return replace_fields(base, **_PRESETS[preset])


ConfigT = TypeVar("ConfigT")


def replace_fields(config: ConfigT, **values: Any) -> ConfigT:
    """A copy of a config with fields replaced by their bare names, wherever in it they live.

    Args:
        config: a dataclass whose fields may be dataclasses in turn; field names are unique across its parts.
        **values: new values by field name, for example ``num_rocks=8, timestep_s=0.01``.

    Raises:
        ConfigError: for a name that no part has (the message lists the nearest names), or a value its part refuses.
    """
    parts = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}  # type: ignore[arg-type]
    here = {name: values.pop(name) for name in list(values) if name in parts}
    for name, part in parts.items():
        if not dataclasses.is_dataclass(part):
            continue
        inside = {key: values.pop(key) for key in list(values) if key in _field_names(part)}
        if inside:
            here[name] = replace_fields(here.get(name, part), **inside)
    if values:
        _refuse_unknown(next(iter(values)), _field_names(config))
    return dataclasses.replace(config, **here)  # type: ignore[type-var]


def _field_names(config: Any) -> list[str]:
    names = []
    for f in dataclasses.fields(config):
        names.append(f.name)
        part = getattr(config, f.name)
        if dataclasses.is_dataclass(part):
            names += _field_names(part)
    return names


def _refuse_unknown(name: str, known: list[str]) -> None:
    import difflib

    near = difflib.get_close_matches(name, known, n=3)
    hint = f"did you mean {' or '.join(near)}?" if near else "known: " + ", ".join(sorted(known))
    raise ConfigError(f"{name}: no such setting; {hint}")


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain JSON data."""
    return {name: list(v) if isinstance(v, tuple) else v for name, v in _shallow(config)}


def _shallow(config: Any) -> list[tuple[str, Any]]:
    fields = [(f.name, getattr(config, f.name)) for f in dataclasses.fields(config)]
    return [(name, to_dict(v) if dataclasses.is_dataclass(v) else v) for name, v in fields]


def from_dict(kind: type[ConfigT], data: Any, where: str = "config") -> ConfigT:
    """The config that ``to_dict`` wrote.

    Raises:
        ConfigError: for data of another shape, a field that does not exist, or a value that its part refuses.
    """
    require(isinstance(data, dict), where, data, "an object with settings")
    known = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    values = {}
    for name, value in data.items():
        require(name in known, f"{where}.{name}", value, "left out: no such setting")
        part = known[name].default_factory
        is_part = part is not dataclasses.MISSING
        value = tuple(value) if isinstance(value, list) else value
        values[name] = from_dict(part, value, f"{where}.{name}") if is_part else value  # type: ignore[arg-type]
    return kind(**values)
