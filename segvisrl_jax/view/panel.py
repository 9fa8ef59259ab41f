"""The controls beside the 3-D scene: what a person can press, the state in numbers, the camera panes.

This file owns widgets and keys. What they do is handed in as ``Actions``, called in viser's threads.
"""

import functools
import html
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser

from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.report.episode import observation_caption
from segvisrl_jax.report.layout import OUTCOME_NAMES
from segvisrl_jax.view.driver import Direction
from segvisrl_jax.view.panes import Image, enlarged
from segvisrl_jax.view.session import Session

NOTHING = "nothing"
SPEEDS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
START_SPEED = 4.0  # at 0.2 m/s a scene takes a minute or more
LAST_SCENE = 2**31 - 1
PANES_WIDTH_PX, CONTROLS_WIDTH_PX = 400, 320
ARROWS_DRIVE = """<img src="data:," alt="" hidden onerror="document.documentElement.addEventListener('keydown',
 event => event.code.startsWith('Arrow') && event.stopPropagation())">"""
"""viser turns its camera with the arrow keys too, and has no switch for that. Its hotkeys listen on the document's
element, its camera on the document above: an arrow that goes no higher drives, and leaves the camera alone."""
HELP = """Arrow keys drive (down stops), also while the policy does. Space pauses, **N** one decision, **P** policy,
**R** restart, **F** follow. Click the 3-D view first; click a rock or the goal to drag it."""
KEYS = {
    Direction.FORWARD: ("arrowup", "Drive on"),
    Direction.LEFT: ("arrowleft", "Turn left"),
    Direction.RIGHT: ("arrowright", "Turn right"),
    Direction.STOP: ("arrowdown", "Stop"),
}


@dataclass(frozen=True)
class Actions:
    """What a person can ask for."""

    press: Callable[[Direction], None]
    pause: Callable[[], None]
    step: Callable[[], None]
    restart: Callable[[], None]
    reset: Callable[[], None]
    new_scene: Callable[[int], None]
    pick: Callable[[str | None], None]
    follow: Callable[[bool], None]


class Panel:
    """Widgets in a viser server; read ``policy_drives``, ``wheels`` and ``speed``."""

    def __init__(self, server: viser.ViserServer, session: Session, things: list[str], actions: Actions) -> None:
        self._server, self._gui, self._actions = server, server.gui, actions
        self._add_state()
        self._add_driving()
        self._add_scene(session, things)
        self._add_panes(session.env)
        self._add_keys()
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(CONTROLS_WIDTH_PX)

    # Widgets

    def _add_state(self) -> None:
        self._state = self._gui.add_markdown("")

    def _add_driving(self) -> None:
        gui, actions = self._gui, self._actions
        with gui.add_folder("Driving"):
            self._policy = gui.add_checkbox("Policy drives", True)
            self._sides = [gui.add_slider(f"{side} wheels", 0.0, 1.0, 0.05, 0.0) for side in ("Left", "Right")]
            arrows = {"\u2190": Direction.LEFT, "\u2191": Direction.FORWARD, "\u2192": Direction.RIGHT}
            keys = gui.add_button_group("One press", tuple(arrows))
            keys.on_click(lambda event: actions.press(arrows[event.target.value]))
            clock = gui.add_button_group("Time", ("Pause / go", "One decision"))
            by_label = {"Pause / go": actions.pause, "One decision": actions.step}
            clock.on_click(lambda event: by_label[event.target.value]())
            speeds = [f"{speed:g} x" for speed in SPEEDS]
            self._speed = gui.add_dropdown("Speed", speeds, initial_value=f"{START_SPEED:g} x")

    def _add_scene(self, session: Session, things: list[str]) -> None:
        gui, actions = self._gui, self._actions
        with gui.add_folder("Scene"):
            self._number = gui.add_number("Number", session.number, min=0, max=LAST_SCENE, step=1)
            self._number.on_update(self._number_changed)
            again = gui.add_button_group("Again", ("Restart", "Reset"))
            by_label = {"Restart": actions.restart, "Reset": actions.reset}
            again.on_click(lambda event: by_label[event.target.value]())
            self._moved = gui.add_dropdown("Move", [NOTHING, *things], initial_value=NOTHING)
            self._moved.on_update(self._moved_changed)
            self._follow = gui.add_checkbox("Follow the rover", True)
            self._follow.on_update(lambda event: actions.follow(event.target.value))
        gui.add_markdown(HELP)
        gui.add_html(ARROWS_DRIVE)

    def _number_changed(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # not when this program changes it
            self._actions.new_scene(int(event.target.value))

    def _moved_changed(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            name = event.target.value
            self._actions.pick(None if name == NOTHING else name)

    def _add_panes(self, env: RoverEnv) -> None:
        panel = self._gui.add_panel()
        blank = np.zeros((9, 16, 3), np.uint8)
        with panel.add_tab("Cameras"):
            self._coloured = self._gui.add_image(blank, label="onboard camera")
            self._segmented = self._gui.add_image(blank, label="segmentation", format="png")
            is_image = len(env.observation_shape) == 3
            caption = observation_caption(env) if is_image else ""
            self.seen = self._gui.add_image(blank, label=caption, format="png", visible=is_image)
        panel.dock_left()
        panel.set_width(PANES_WIDTH_PX)

    def _add_keys(self) -> None:
        actions = self._actions
        for direction, (key, label) in KEYS.items():
            self._add_key(label, key, functools.partial(actions.press, direction))
        self._add_key("Pause or go on", "space", actions.pause)
        self._add_key("One decision", "N", actions.step)
        self._add_key("Restart: moved things stay", "R", actions.restart)
        self._add_key("The policy drives, or not", "P", self._toggle_policy)
        self._add_key("Follow the rover, or not", "F", self._toggle_follow)

    def _add_key(self, label: str, key: str, act: Callable[[], None]) -> None:
        command = self._gui.add_command(label, hotkey=key)  # type: ignore[arg-type]
        command.on_trigger(lambda event: act())

    def _toggle_policy(self) -> None:
        self._policy.value = not self._policy.value  # type: ignore[misc]

    def _toggle_follow(self) -> None:
        self._follow.value = not self._follow.value  # type: ignore[misc]
        self._actions.follow(self._follow.value)

    # What is set

    @property
    def policy_drives(self) -> bool:
        """Whether the policy drives where no key is pressed."""
        return self._policy.value

    @property
    def wheels(self) -> np.ndarray:
        """Left and right slider, as shares of the top speed, (2,) float32."""
        return np.array([slider.value for slider in self._sides], np.float32)

    @property
    def speed(self) -> float:
        """Simulated seconds in a second."""
        return float(self._speed.value.removesuffix(" x"))

    # What is shown

    def show_note(self, note: str) -> None:
        """A sentence in place of the state."""
        self._state.content = note

    def show_state(self, session: Session, is_paused: bool) -> None:
        """The episode in numbers."""
        self._state.content = state_table(session, is_paused)

    def show_picked(self, name: str | None) -> None:
        """What the gizmo is on."""
        self._moved.value = name or NOTHING  # type: ignore[misc]

    def show_camera(self, coloured: Image, segmented: Image) -> None:
        """The onboard camera."""
        self._coloured.image = coloured
        self._segmented.image = segmented

    def show_seen(self, observation: Image | None) -> None:
        """What the policy sees; None for a policy without images."""
        if observation is not None:
            self.seen.image = enlarged(observation)


def state_table(session: Session, is_paused: bool) -> str:
    """The episode in numbers, as a markdown table."""
    left, right = session.wheel_speeds_rad_s.reshape(2, 2).mean(axis=0)
    outcome = OUTCOME_NAMES[session.outcome] if session.is_over or not is_paused else "paused"
    nearest_m = session.rock_distance_m
    rows = {
        "outcome": f"**{outcome}**",
        "driven by": html.escape(session.policy.name) if session.policy_drove else "you",
        "time": f"{session.time_s:.0f} s",
        "to the goal": f"{session.goal_distance_m:.2f} m",
        "nearest rock": f"{nearest_m:.2f} m" if np.isfinite(nearest_m) else "none",
        "wheels, left / right": f"{left:.2f} / {right:.2f} rad/s",
        "commanded": _shares(session.command),
        "the policy wants": "" if session.proposal is None else _shares(session.proposal),
        "reward so far": f"{session.reward_sum:.1f}",
    }
    return "| | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in rows.items())


def _shares(wheels: np.ndarray) -> str:
    """Two shares of the top speed."""
    left, right = (round(100 * float(share)) for share in wheels)
    return f"{left} / {right} %"
