"""The 3-D scene in the browser: ground, rocks, goal, rover, its trail, and the gizmo that moves things.

Everything hangs under one frame. With ``follow`` it moves against the rover, so that the rover stays where the
browser's camera turns about, without touching that camera.
"""

from collections.abc import Callable

import mujoco
import numpy as np
import viser
from jaxtyping import Float

from segvisrl_jax.env.rocks import goal_beacon
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.scene import sun_direction
from segvisrl_jax.types import Scene
from segvisrl_jax.view import solids
from segvisrl_jax.view.solids import Colour, Solid

WORLD = "/world"
GOAL = "goal"
COLLISION_COLOUR: Colour = (230, 120, 40)
GOAL_COLOUR: Colour = (60, 200, 120)
TRAIL_COLOUR: Colour = (90, 180, 255)
LINE_HEIGHT_M = 0.01  # above the ground, so that it does not flicker through it
RING_SIDES = 48
AMBIENT_INTENSITY, SUN_INTENSITY = 1.2, 6.0
SUN_DISTANCE_M = 100.0  # viser's sun shines from its place towards the origin
MOVE = Callable[[str, tuple[float, float]], None]


class Stage:
    """Draws a scene and a rover into a viser server.

    ``on_pick(name)`` is called when ``goal`` or ``rock 1`` ... is clicked, ``on_move(name, xy_m)`` while the gizmo
    is dragged; both in viser's threads.
    """

    def __init__(self, server: viser.ViserServer, env: RoverEnv, on_pick: Callable[[str], None], on_move: MOVE) -> None:
        self._server, self._env = server, env
        self._on_pick, self._on_move = on_pick, on_move
        self._data = mujoco.MjData(env.mj_model)
        self._world = server.scene.add_frame(WORLD, show_axes=False)
        self._things: dict[str, viser.FrameHandle] = {}
        self.picked: str | None = None  # what the gizmo is on
        self._gizmo: viser.TransformControlsHandle | None = None
        self._trail: viser.LineSegmentsHandle | None = None
        self._bodies = self._add_rover()
        self._add_ground()
        self._light()
        self.follow = True

    @property
    def offset_m(self) -> Float[np.ndarray, "3"]:
        """What is added to a place in the world, so that the rover stays in the middle."""
        return self._world.position

    # What does not change within a scene

    def show_scene(self, scene: Scene) -> None:
        """Rocks and goal, drawn anew; nothing is picked any more."""
        self.pick(None)
        for thing in self._things.values():
            thing.remove()
        self._things = {}
        task, model = self._env.config.task, self._env.mj_model
        limit_m = task.collision_radius_m + task.collision_margin_m
        for index, shape in enumerate(np.asarray(scene.rock_shape)):
            solid = solids.library_solid(self._env.rocks, int(shape), solids.material_colour(model, "rock"))
            self._add_thing(rock_name(index), solid, limit_m, COLLISION_COLOUR)
        beacon = solids.library_solid(goal_beacon(), 0, solids.material_colour(model, "goal"))
        self._add_thing(GOAL, beacon, task.goal_radius_m, GOAL_COLOUR)
        self.place_things(scene)

    def place_things(self, scene: Scene) -> None:
        """Rocks and goal, where they are now."""
        for index, xy in enumerate(np.asarray(scene.rock_xy_m)):
            self._stand(rock_name(index), xy, float(scene.rock_yaw_rad[index]))
        self._stand(GOAL, np.asarray(scene.goal_xy_m), float(scene.goal_yaw_rad))

    def _stand(self, name: str, xy_m: Float[np.ndarray, "2"], yaw_rad: float) -> None:
        thing = self._things[name]
        thing.position = (float(xy_m[0]), float(xy_m[1]), 0.0)
        thing.wxyz = (float(np.cos(yaw_rad / 2)), 0.0, 0.0, float(np.sin(yaw_rad / 2)))

    def _add_thing(self, name: str, solid: Solid, radius_m: float, colour: Colour) -> None:
        path = f"{WORLD}/{name.replace(' ', '_')}"
        self._things[name] = self._server.scene.add_frame(path, show_axes=False)
        mesh = self._add_solid(f"{path}/solid", solid)
        mesh.on_click(lambda _: self._on_pick(name))
        self._server.scene.add_line_segments(f"{path}/limit", _ring(radius_m), colour, thickness=0.02)

    def _add_solid(self, path: str, solid: Solid) -> viser.MeshHandle:
        return self._server.scene.add_mesh_simple(
            path, solid.vertices_m, solid.faces, color=solid.colour, flat_shading=True
        )

    def _add_ground(self) -> None:
        half = self._env.config.scene.map_size_m / 2
        corners = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
        colour = solids.material_colour(self._env.mj_model, "ground")
        ground = Solid(corners, np.array([[0, 1, 2], [0, 2, 3]]), colour)
        self._add_solid(f"{WORLD}/ground", ground)
        self._server.scene.add_grid(
            f"{WORLD}/grid",
            2 * half,
            2 * half,
            cell_size=1.0,
            section_size=5.0,
            cell_color=(120, 117, 112),
            section_color=(100, 97, 92),
            position=(0.0, 0.0, LINE_HEIGHT_M / 2),
        )

    def _light(self) -> None:
        """The sun, and a little light from everywhere so that the side in shadow can be seen."""
        x, y, z = (SUN_DISTANCE_M * float(part) for part in sun_direction(self._env.config.scene))
        scene = self._server.scene
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/ambient", intensity=AMBIENT_INTENSITY)
        scene.add_light_directional("/sun", intensity=SUN_INTENSITY, cast_shadow=True, position=(x, y, z))

    # What moves

    def _add_rover(self) -> dict[str, viser.FrameHandle]:
        bodies = {}
        for name, parts in solids.rover_bodies(self._env.mj_model).items():
            bodies[name] = self._server.scene.add_frame(f"{WORLD}/{name}", show_axes=False)
            for number, solid in enumerate(parts):
                self._add_solid(f"{WORLD}/{name}/{number}", solid)
        return bodies

    def show_rover(self, qpos: Float[np.ndarray, "11"]) -> None:
        """The rover at a pose, and the world about it."""
        for name, (position, wxyz) in solids.body_poses(self._env.mj_model, self._data, qpos).items():
            self._bodies[name].position, self._bodies[name].wxyz = position, wxyz
        x, y = (float(qpos[0]), float(qpos[1])) if self.follow else (0.0, 0.0)
        self._world.position = (-x, -y, 0.0)

    def show_trail(self, xy_m: Float[np.ndarray, "T 2"]) -> None:
        """Where the rover has been."""
        points = np.column_stack([xy_m, np.full(len(xy_m), LINE_HEIGHT_M)])
        segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        if self._trail is not None and len(segments):
            self._trail.points = segments
            return
        if self._trail is not None:
            self._trail.remove()
            self._trail = None
        if len(segments):
            path = f"{WORLD}/trail"
            self._trail = self._server.scene.add_line_segments(path, segments, TRAIL_COLOUR, thickness=0.03)

    # Moving things

    def pick(self, name: str | None) -> None:
        """Puts the gizmo on a thing; None takes it away."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        self.picked = name
        if name is None:
            return
        gizmo = self._server.scene.add_transform_controls(
            f"{WORLD}/gizmo",
            scale=1.2,
            active_axes=(True, True, False),
            disable_rotations=True,
            depth_test=False,
            position=self._things[name].position,
        )

        @gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            x, y, _ = event.target.position
            self._on_move(name, (float(x), float(y)))

        self._gizmo = gizmo


def rock_name(index: int) -> str:
    """What a person calls a rock: they count from 1."""
    return f"rock {index + 1}"


def _ring(radius_m: float) -> Float[np.ndarray, "S 2 3"]:
    """A circle on the ground, in segments."""
    angle = np.linspace(0, 2 * np.pi, RING_SIDES + 1)
    points = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.full(len(angle), LINE_HEIGHT_M)])
    return np.stack([points[:-1], points[1:]], axis=1)
