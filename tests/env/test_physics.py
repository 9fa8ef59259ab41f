"""Both engines: speed, turning, rest, divergence, and that they agree; docs/rover.md quotes it.

MJX takes long to compile, so all about it runs through one program: ``drive``, at one size.
"""

import functools
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from segvisrl_jax.config import ConfigError, EnvConfig, PhysicsConfig, TaskConfig
from segvisrl_jax.env.physics import PhysicsEngine, make_engine
from segvisrl_jax.env.physics.native import NativeEngine
from segvisrl_jax.env.pose import up_z, yaw_rad
from segvisrl_jax.types import PhysicsState

TOP_SPEED_M_S = PhysicsConfig().top_speed_m_s
NUM_DECISIONS, NUM_ENVS = 20, 32
JUDGE_DT_S = TaskConfig().judge_dt_s
TURN_RATE_DEG_S = 27.2  # one side at full command, the other standing: measured, in docs/rover.md


@functools.cache
def engine_of(name: str) -> PhysicsEngine:
    return make_engine(EnvConfig(physics=PhysicsConfig(engine=name)))


@functools.cache
def drive(name: str):
    """Jitted (states [B], actions [T, B, 2]) -> (last states [B], judged states [T, B, J])."""
    advance = jax.vmap(engine_of(name).advance)

    def decide(state: PhysicsState, action: Array) -> tuple[PhysicsState, PhysicsState]:
        states = advance(state, action)
        return jax.tree.map(lambda x: x[:, -1], states), states

    return jax.jit(lambda state, actions: jax.lax.scan(decide, state, actions))


def parked(name: str, seed: int = 0) -> PhysicsState:
    """A batch at rest at random places and headings."""
    xy_key, yaw_key = jax.random.split(jax.random.key(seed))
    xy = jax.random.uniform(xy_key, (NUM_ENVS, 2), minval=-12.0, maxval=12.0)
    yaw = jax.random.uniform(yaw_key, (NUM_ENVS,), minval=-jnp.pi, maxval=jnp.pi)
    return jax.vmap(engine_of(name).place)(xy, yaw)


def random_actions(seed: int, shape: tuple[int, ...]) -> Array:
    """Beyond [0, 1] now and then, so that full and no command are common."""
    return jax.random.uniform(jax.random.key(seed), (*shape, 2), minval=-0.3, maxval=1.3)


@functools.cache
def steady_run(name: str) -> PhysicsState:
    """Judged states [T, B, J] under constant commands: 1, 0.5, 0.25, one side, the other, none."""
    commands = [(1, 1), (0.5, 0.5), (0.25, 0.25), (0, 1), (1, 0), (0, 0)]
    commands += [(0.9, 0.9)] * (NUM_ENVS - len(commands))
    actions = jnp.broadcast_to(jnp.asarray(commands, jnp.float32), (NUM_DECISIONS, NUM_ENVS, 2))
    return drive(name)(parked(name), actions)[1]


def turned_deg(states: PhysicsState, env: int) -> np.ndarray:
    """Heading of one environment over all judged instants, unwrapped."""
    return np.degrees(np.unwrap(np.asarray(yaw_rad(states.qpos[:, env])).ravel()))


both_engines = pytest.mark.parametrize("name", ["native", "mjx"])


@both_engines
def test_speed_follows_the_command(name: str) -> None:
    positions = np.asarray(steady_run(name).qpos[..., :2])
    for env, command in enumerate((1.0, 0.5, 0.25)):
        driven = np.linalg.norm(positions[-1, env, -1] - positions[4, env, -1])
        speed = driven / (NUM_DECISIONS - 5)
        assert speed == pytest.approx(command * TOP_SPEED_M_S, rel=0.02)


@both_engines
def test_start_takes_six_tenths_of_a_second(name: str) -> None:
    after_600_ms = round(0.6 / JUDGE_DT_S) - 1
    speed = np.linalg.norm(steady_run(name).qvel[0, 0, after_600_ms, :2])
    assert speed == pytest.approx(0.92 * TOP_SPEED_M_S, rel=0.03)


@both_engines
def test_straight_stays_straight(name: str) -> None:
    headings = turned_deg(steady_run(name), 0)
    assert np.ptp(headings) < 0.1


@both_engines
def test_turning_is_steady_and_symmetric(name: str) -> None:
    one_second = round(1 / JUDGE_DT_S)
    to_left, to_right = (turned_deg(steady_run(name), env) for env in (3, 4))
    rates = np.diff(to_left[2 * one_second :: one_second])  # after the start
    assert np.mean(rates) == pytest.approx(TURN_RATE_DEG_S, rel=0.02)
    assert np.ptp(rates) < 0.02 * np.mean(rates)
    assert to_left[-1] - to_left[0] == pytest.approx(to_right[0] - to_right[-1], rel=0.02)


@both_engines
def test_rest_is_rest(name: str) -> None:
    """Within a millimetre in 20 s: MJX creeps by 0.02 mm/s, the noise of single precision."""
    start, states = parked(name).qpos[5], steady_run(name).qpos[:, 5]
    assert np.abs(states[..., :3] - start[:3]).max() < 1e-3


@functools.cache
def moving_start() -> PhysicsState:
    """A batch in motion: what 20 random decisions leave behind."""
    start, actions = parked("native", seed=1), random_actions(1, (NUM_DECISIONS, NUM_ENVS))
    return drive("native")(start, actions)[0]


@functools.cache
def random_run(name: str) -> tuple[PhysicsState, PhysicsState]:
    """Last states [B] and judged states [T, B, J] from ``moving_start`` under random actions."""
    return drive(name)(moving_start(), random_actions(2, (NUM_DECISIONS, NUM_ENVS)))


def test_engines_agree() -> None:
    native, mjx = (random_run(name)[1].qpos for name in ("native", "mjx"))
    apart = np.linalg.norm(native[..., :2] - mjx[..., :2], axis=-1)
    turned = np.asarray(yaw_rad(native) - yaw_rad(mjx))
    turned = np.degrees(np.abs((turned + np.pi) % (2 * np.pi) - np.pi))
    assert apart.max() < 0.005
    assert turned.max() < 0.5
    moved = np.linalg.norm(native[-1, :, -1, :2] - moving_start().qpos[:, :2], axis=-1)
    assert moved.mean() > 0.3  # they did drive


@both_engines
def test_divergence_stays_and_stays_alone(name: str) -> None:
    """Four environments are spoilt, one of them on the way; the others keep their bits."""
    start, clean = moving_start(), random_run(name)[1]
    spoilt = PhysicsState(
        qpos=start.qpos.at[3, 0].set(jnp.nan).at[9, 2].set(jnp.inf),
        qvel=start.qvel.at[7, 5].set(1e9),
    )
    actions = random_actions(2, (NUM_DECISIONS, NUM_ENVS)).at[6, 11, 1].set(jnp.nan)
    states = drive(name)(spoilt, actions)[1]
    for env in (3, 7, 9):
        assert not np.isfinite(states.qpos[:, env]).any()
    assert np.isfinite(states.qpos[:6, 11]).all()
    assert not np.isfinite(states.qpos[6:, 11]).any()
    assert not np.isfinite(states.qvel[6:, 11]).any()
    others = np.setdiff1d(np.arange(NUM_ENVS), (3, 7, 9, 11))
    np.testing.assert_array_equal(states.qpos[:, others], clean.qpos[:, others])
    np.testing.assert_array_equal(states.qvel[:, others], clean.qvel[:, others])


@both_engines
def test_one_compilation(name: str) -> None:
    last, _ = random_run(name)
    before = drive(name)._cache_size()
    drive(name)(last, random_actions(3, (NUM_DECISIONS, NUM_ENVS)))
    assert drive(name)._cache_size() == before
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(last))


@both_engines
def test_shapes_and_types(name: str) -> None:
    engine = engine_of(name)
    state = engine.place(jnp.asarray([1.0, -2.0]), jnp.asarray(0.5))
    np.testing.assert_allclose(state.qpos[:2], [1, -2])
    assert float(yaw_rad(state.qpos)) == pytest.approx(0.5)
    out = jax.eval_shape(engine.advance, state, jnp.zeros(2))
    judged = TaskConfig().num_judgements
    assert (out.qpos.shape, out.qvel.shape) == ((judged, 11), (judged, 10))
    assert out.qpos.dtype == out.qvel.dtype == state.qpos.dtype == jnp.float32
    assert not any(leaf.weak_type for leaf in jax.tree.leaves((out, state)))


def test_native_diverges_where_mujoco_warns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo stops and repeats a state it warns of, finite though it is: that is no standing still.

    A short time step keeps the state finite while the acceleration is beyond MuJoCo's bound.
    """
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a file here
    engine = NativeEngine(EnvConfig(physics=PhysicsConfig(engine="native", timestep_s=1e-4)))
    state = jax.vmap(engine.place)(jnp.zeros((2, 2)), jnp.zeros(2))
    spinning = PhysicsState(qpos=state.qpos, qvel=state.qvel.at[0, 3].set(1e5).at[0, 6].set(1e7))
    states = jax.vmap(engine.advance)(spinning, jnp.ones((2, 2)))
    assert (tmp_path / "MUJOCO_LOG.TXT").exists()
    assert not np.isfinite(states.qpos[0]).any()
    alone = engine.advance(PhysicsState(qpos=state.qpos[1], qvel=state.qvel[1]), jnp.ones(2))
    np.testing.assert_array_equal(states.qpos[1], alone.qpos)


def test_native_under_every_transformation() -> None:
    """jit, nested vmap with an unbatched argument, scan and cond give what plain calls give."""
    engine, judged = engine_of("native"), TaskConfig().num_judgements
    state = engine.place(jnp.zeros(2), jnp.asarray(0.3))
    actions = random_actions(5, (2, 3))
    plain = np.stack([[engine.advance(state, a).qpos for a in row] for row in actions])
    nested = jax.jit(jax.vmap(jax.vmap(engine.advance, in_axes=(None, 0)), in_axes=(None, 0)))
    np.testing.assert_array_equal(nested(state, actions).qpos, plain)

    @jax.jit
    def scanned(state: PhysicsState, actions: Array) -> Array:
        def body(carry: PhysicsState, action: Array) -> tuple[PhysicsState, Array]:
            stay = jax.tree.map(lambda x: jnp.broadcast_to(x, (judged, *x.shape)), carry)
            go = functools.partial(engine.advance, carry, action)
            states = jax.lax.cond(action[0] > 0, go, lambda: stay)
            return jax.tree.map(lambda x: x[-1], states), states.qpos

        return jax.lax.scan(body, state, actions)[1]

    commands = jnp.asarray([[0.5, 1.0], [0.0, 1.0], [1.0, 0.2]])
    seen = scanned(state, commands)
    first = engine.advance(state, commands[0])
    np.testing.assert_array_equal(seen[0], first.qpos)
    np.testing.assert_array_equal(seen[1], np.repeat(first.qpos[-1:], judged, axis=0))
    assert not np.array_equal(seen[2, -1], seen[1, -1])


def test_action_is_clipped() -> None:
    engine = engine_of("native")
    state = engine.place(jnp.zeros(2), jnp.zeros(()))
    beyond, clipped = (engine.advance(state, jnp.asarray(a)) for a in ((3.0, -2.0), (1.0, 0.0)))
    np.testing.assert_array_equal(beyond.qpos, clipped.qpos)
    assert float(yaw_rad(beyond.qpos[-1])) < -0.01  # only the left side drives: a turn to the right


def test_threads_and_callers_do_not_change_the_bits() -> None:
    single = NativeEngine(EnvConfig(physics=PhysicsConfig(engine="native", num_threads=1)))
    triple = NativeEngine(EnvConfig(physics=PhysicsConfig(engine="native", num_threads=3)))
    state, actions = parked("native", seed=6), random_actions(6, (NUM_ENVS,))
    expected = jax.vmap(single.advance)(state, actions)
    results: list[PhysicsState] = []

    def call() -> None:
        results.append(jax.jit(jax.vmap(triple.advance))(state, actions))

    callers = [threading.Thread(target=call) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(results) == len(callers)
    for result in results:
        np.testing.assert_array_equal(result.qpos, expected.qpos)


@pytest.mark.parametrize("num_envs", [50, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_driving_is_calm(num_envs: int) -> None:
    """20 decisions of 50 steps each, a million steps for 1,000 rovers.

    None hops, tips, or makes MuJoCo warn (which would be NaN).
    """
    engine = engine_of("native")
    yaw = jnp.linspace(-3.0, 3.0, num_envs)
    start = jax.vmap(engine.place)(jnp.zeros((num_envs, 2)), yaw)
    states = drive("native")(start, random_actions(7, (NUM_DECISIONS, num_envs)))[1]
    assert np.isfinite(states.qpos).all()
    assert np.isfinite(states.qvel).all()
    height = np.asarray(states.qpos[..., 2]) - float(start.qpos[0, 2])
    assert np.abs(height).max() < 0.001
    assert np.degrees(np.arccos(np.clip(up_z(states.qpos), -1, 1))).max() < 0.2


@pytest.mark.parametrize(
    ("timestep_s", "gravity_m_s2", "wheel_friction"),
    [
        (0.05, 1.62, 0.8),
        (0.002, 1.62, 0.8),
        (0.02, 9.81, 0.8),
        (0.02, 1.62, 5.0),
        (0.04, 1.62, 0.3),
    ],
)
def test_other_settings_drive_too(timestep_s: float, gravity_m_s2: float, wheel_friction: float) -> None:
    physics = PhysicsConfig(
        engine="native",
        timestep_s=timestep_s,
        gravity_m_s2=gravity_m_s2,
        wheel_friction=wheel_friction,
    )
    engine = NativeEngine(EnvConfig(physics=physics))
    state = jax.vmap(engine.place)(jnp.zeros((3, 2)), jnp.zeros(3))
    actions = jnp.asarray([[1.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
    for _ in range(6):
        states = jax.vmap(engine.advance)(state, actions)
        state = jax.tree.map(lambda x: x[:, -1], states)
    speed = np.linalg.norm(state.qvel[0, :2])
    assert speed == pytest.approx(TOP_SPEED_M_S, rel=0.02)
    rates = np.degrees(state.qvel[:, 5])
    assert rates[1] == pytest.approx(-rates[2], rel=0.02)
    assert 20 < rates[1] < 36
    assert (np.asarray(up_z(state.qpos)) > np.cos(np.radians(0.5))).all()


def test_auto_is_native_on_a_cpu() -> None:
    assert engine_of("auto").name == ("native" if jax.default_backend() == "cpu" else "mjx")


def test_unknown_engine_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"physics\.engine = 'bullet'.*native.*mjx"):
        PhysicsConfig(engine="bullet")  # type: ignore[arg-type]


def test_engine_that_cannot_run_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "segvisrl_jax.env.physics.mjx", None)  # as if not importable
    with pytest.raises(ConfigError, match=r"physics\.engine = 'mjx': should be 'native' here"):
        make_engine(EnvConfig(physics=PhysicsConfig(engine="mjx")))


@pytest.mark.parametrize(
    ("text", "reason"), [("no such contact\nmore", "no such contact"), ("", "NotImplementedError")]
)
def test_what_mjx_refuses_is_said_in_one_line(text: str, reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise NotImplementedError(text)

    monkeypatch.setattr("mujoco.mjx.put_model", refuse)
    with pytest.raises(ConfigError, match=rf"because MJX cannot run: {reason}$"):
        make_engine(EnvConfig(physics=PhysicsConfig(engine="mjx")))


FRESH_PROCESS = """
import jax
from segvisrl_jax.config import EnvConfig
from segvisrl_jax.env.physics import make_engine

engine = make_engine(EnvConfig())
xy = jax.numpy.zeros((2048, 2))
state = jax.vmap(engine.place)(xy, xy[:, 0])

@jax.jit
def drive(state):
    def decide(state, _):
        states = jax.vmap(engine.advance)(state, xy)
        return jax.tree.map(lambda x: x[:, -1], states), None
    return jax.lax.scan(decide, state, None, length=3)[0]

print(bool(jax.numpy.isfinite(drive(drive(state)).qpos).all()))
"""


def test_a_fresh_process_ends() -> None:
    """Neither a large batch nor the end of the interpreter hangs."""
    command = [sys.executable, "-c", FRESH_PROCESS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.split() == ["True"]
