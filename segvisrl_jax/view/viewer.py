"""The viewer: a session, its 3-D scene and its controls in one viser server, and the loop that keeps time.

Why viser and not rerun: rerun shows what a program logged. This page also talks back: viser has key commands, widgets,
clicks on meshes and gizmos that drag them, and images that change while one looks, all from Python.

viser calls back from threads of its own. They only note what was asked for; the loop, in one thread, does it.
"""

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import viser
from jaxtyping import Float

from segvisrl_jax.view.driver import Direction, KeyDriver
from segvisrl_jax.view.panel import Actions, Panel
from segvisrl_jax.view.panes import Panes, at_pose
from segvisrl_jax.view.playback import Motion
from segvisrl_jax.view.session import Session
from segvisrl_jax.view.stage import GOAL, Stage, rock_name

FRAME_S = 0.05
PANES_S = 0.15  # between two drawings of the camera panes: some 10 ms of work each
CAMERA_AT_M, CAMERA_LOOKS_AT_M = (-2.0, -1.5, 1.3), (0.7, 0.1, 0.1)  # about the rover, which faces x
GETTING_READY = "Compiling: driving begins in a minute or less."


class Viewer:
    """Runs until it is told to stop. Decisions are made only while a browser looks."""

    def __init__(self, session: Session, host: str, port: int) -> None:
        """Opens the server; ``port`` 0 takes any free one."""
        self.session = session
        self._panes, self._keys = Panes(session.env), KeyDriver()
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._dragged: dict[str, tuple[float, float]] = {}
        self._motion: Motion | None = None
        self._last_ended_s = -np.inf  # the motion before
        self._trail: list[Float[np.ndarray, "K 2"]] = []
        self.is_paused, self._steps_due = False, 0
        self._panes_are_old, self._panes_due_s = True, 0.0
        with quiet_viser():
            self.server = viser.ViserServer(host, port, label="segvisrl view", verbose=False)
        self._dress_page()
        things = [GOAL, *(rock_name(index) for index in range(len(session.scene.rock_xy_m)))]
        self.stage = Stage(self.server, session.env, self._ask_pick, self.drag)
        self.panel = Panel(self.server, session, things, self._actions())
        self._begin()
        self.panel.show_note(GETTING_READY)

    def _dress_page(self) -> None:
        """No share button: it would hand the page to a server elsewhere."""
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self.server.initial_camera.position = CAMERA_AT_M
        self.server.initial_camera.look_at = CAMERA_LOOKS_AT_M
        self.server.initial_camera.fov = np.radians(50.0)

    # What is asked for, in viser's threads

    def _actions(self) -> Actions:
        def later(act: Callable) -> Callable:
            return lambda *words: self._asked.put(lambda: act(*words))

        return Actions(
            press=later(self._press),
            pause=later(self._pause),
            step=later(self._step),
            restart=later(lambda: self._again(self.session.restart)),
            reset=later(lambda: self._again(self.session.reset)),
            new_scene=later(lambda number: self._again(lambda: self.session.new_scene(number))),
            pick=self._ask_pick,
            follow=later(self._follow),
        )

    def _ask_pick(self, name: str | None) -> None:
        self._asked.put(lambda: self._pick(name))

    def drag(self, name: str, xy_m: tuple[float, float]) -> None:
        """``goal`` or ``rock 1`` ... shall stand there from the next frame on. From any thread."""
        self._dragged[name] = xy_m  # only the last place counts

    # ... and done, in the loop's

    def _press(self, direction: Direction) -> None:
        self._keys.press(direction, time.monotonic())

    def _pause(self) -> None:
        self.is_paused = not self.is_paused
        self.panel.show_state(self.session, self.is_paused)

    def _step(self) -> None:
        self.is_paused = True
        self._steps_due += 1

    def _follow(self, is_on: bool) -> None:
        self.stage.follow = is_on
        self.stage.show_rover(self._pose)

    def _pick(self, name: str | None) -> None:
        self.stage.pick(name)
        self.panel.show_picked(name)

    def _again(self, begin: Callable[[], None]) -> None:
        begin()
        self._begin()

    def _begin(self) -> None:
        """Shows a session that is at its start."""
        self._motion, self._steps_due = None, 0
        self._dragged.clear()
        self._keys.release()
        self._pose = np.asarray(self.session.rover.physics.qpos)
        self._trail = [self._pose[None, :2]]
        self.stage.show_scene(self.session.scene)
        self.panel.show_picked(None)
        self.stage.show_trail(self._trail[0])
        self.stage.show_rover(self._pose)
        self.panel.show_state(self.session, self.is_paused)
        self._panes_are_old = True

    def _move_dragged(self) -> None:
        for name in list(self._dragged):
            xy_m = self._dragged.pop(name)
            if name == GOAL:
                self.session.move_goal(xy_m)
            else:
                self.session.move_rock(int(name.split()[1]) - 1, xy_m)
            self.stage.place_things(self.session.scene)
            self.panel.show_state(self.session, self.is_paused)
            self._panes_are_old = True

    @property
    def is_moving(self) -> bool:
        """Whether a decision is being shown."""
        return self._motion is not None

    # The loop

    def run(self, stop: threading.Event) -> None:
        """Compiles, then drives, until ``stop`` is set."""
        self._compile()
        while not stop.is_set():
            began_s = time.monotonic()
            self.tick(began_s)
            stop.wait(max(0.0, FRAME_S - (time.monotonic() - began_s)))

    def close(self) -> None:
        """Ends the server."""
        with quiet_viser():
            self.server.stop()

    def _compile(self) -> None:
        """Draws and decides once, so that nothing stutters later."""
        self._show_panes()
        self.session.decide(None)
        scene = self.session.scene
        self.session.move_goal(tuple(scene.goal_xy_m))
        if len(scene.rock_xy_m):
            self.session.move_rock(0, tuple(scene.rock_xy_m[0]))
        self._again(self.session.restart)
        self._again(self.session.reset)

    def tick(self, now_s: float) -> None:
        """One frame, at a time of the monotonic clock."""
        while not self._asked.empty():
            self._asked.get()()
        self._move_dragged()
        if self._motion is not None:
            self._play(self._motion, now_s)
        if self._motion is None and self._may_decide():
            self._decide(now_s)
        if self._panes_are_old and now_s >= self._panes_due_s:
            self._panes_due_s = now_s + PANES_S
            self._show_panes()

    def _play(self, motion: Motion, now_s: float) -> None:
        """Shows the rover on its way; at the end, what the decision led to."""
        self._pose = motion.at(now_s)
        self.stage.show_rover(self._pose)
        self._panes_are_old = True
        if now_s >= motion.ends_s:
            self._motion, self._last_ended_s = None, motion.ends_s
            self._trail.append(motion.poses[1:, :2])
            self.stage.show_trail(np.concatenate(self._trail))
            self.panel.show_state(self.session, self.is_paused)

    def _may_decide(self) -> bool:
        if self.session.is_over or not self.server.get_clients():
            return False
        return not self.is_paused or self._steps_due > 0

    def _decide(self, now_s: float) -> None:
        self._steps_due = max(0, self._steps_due - 1)
        command = self._keys.command(now_s)
        if command is None and not self.panel.policy_drives:
            command = self.panel.wheels
        self.panel.show_seen(self.session.observation)  # on which the policy decides
        poses = self.session.decide(command)
        instant_s = self.session.env.config.task.judge_dt_s / self.panel.speed
        began_s = max(self._last_ended_s, now_s - FRAME_S)  # right behind the one before: no time is lost
        self._motion = Motion(np.concatenate([self._pose[None], poses]), began_s, instant_s)

    def _show_panes(self) -> None:
        """The camera panes for the pose that is shown; where nothing moves, what the policy sees too."""
        self._panes_are_old = False
        rover = at_pose(self.session.rover, self._pose)
        self.panel.show_camera(self._panes.coloured(rover), self._panes.segmented(rover))
        if self._motion is None:
            self.panel.show_seen(self.session.observation)


@contextlib.contextmanager
def quiet_viser() -> Iterator[None]:
    """viser announces itself in a frame; the program prints one line of its own."""
    import rich

    console = rich.get_console()
    was, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = was
