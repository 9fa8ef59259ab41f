"""Growth: which points are measured, which are not and why, and the power with which costs grow."""

import subprocess
from types import SimpleNamespace

import pytest

from segvisrl_jax.config import ConfigError, preset_config
from segvisrl_jax.machine import growth
from segvisrl_jax.machine.growth import GrowthSizes, Point, exponent_rows, last_half, points_of, why_not

BASE = preset_config("cnn_lstm", "cpu")
TOOK = {"physics_ms": 0.1, "rendering_ms": 0.1, "acting_ms": 1.0, "learning_ms": 8.0, "memory_gib": 1.0}


def made_up(varied, values, power):
    """Points whose cost a decision is that power of the value, after a first half that is anything."""
    rows = [{"varied": varied, "value": value} | dict.fromkeys(TOOK, 2.0 * value**power) for value in values]
    for row in rows[: len(rows) // 2]:
        row |= dict.fromkeys(TOOK, 7.0)
    return rows


@pytest.mark.parametrize(("varied", "more"), [("rocks", 0), ("pixels", 0), ("environments", 1), ("unroll", 1)])
def test_the_exponent_is_that_of_the_cost_in_all(varied, more):
    [row] = exponent_rows(made_up(varied, [1, 4, 16, 64, 256, 1024], power=-0.25))
    assert row["over"] == "64 to 1,024"
    for part in ("physics", "rendering", "acting", "learning"):
        assert row[part] == pytest.approx(more - 0.25)
    assert row["memory"] == pytest.approx(-0.25)


def test_points_at_0_and_those_not_run_are_left_out_of_the_fit():
    rows = [{"varied": "rocks", "value": 0, **TOOK}, *made_up("rocks", [1, 2, 4, 8], 0.5)]
    [row] = exponent_rows([*rows, {"varied": "rocks", "value": 16, "note": "not run: 40 GiB"}])
    assert (row["over"], row["learning"]) == ("4 to 8", pytest.approx(0.5))
    assert list(exponent_rows(rows[:2])) == []
    assert [len(last_half([{}] * count)) for count in (2, 3, 4, 6, 7)] == [2, 2, 2, 3, 4]


def test_one_factor_is_varied_at_a_time_around_the_preset():
    points = points_of(BASE, GrowthSizes())
    for varied, count in (("rocks", 6), ("environments", 8), ("pixels", 7), ("unroll", 6)):
        values = [point.value for point in points if point.varied == varied]
        assert len(values) == count
        assert values == sorted(values)
    of = {(point.varied, point.value): point.config for point in points}
    assert of["rocks", 16].env.scene.num_rocks == of["rocks", 16].env.scene.most_rocks == 16
    assert of["environments", 32] == of["pixels", 48 * 27] == of["unroll", 64] == BASE
    assert [of["environments", n].ppo.num_minibatches for n in (1, 4, 16, 4096)] == [1, 4, 8, 8]
    with pytest.raises(ConfigError, match="scale"):
        points_of(BASE, GrowthSizes(scales=(900.0,)))


def test_what_would_take_too_much_is_not_run_and_says_how_much():
    first = Point("preset", 0, BASE)
    of = {(point.varied, point.value): point for point in points_of(BASE, GrowthSizes())}

    def note(varied, value, most_s=300, most_gib=8):
        return why_not(of[varied, value], first, TOOK, 3, most_s, most_gib, on_cpu=True)

    assert note("environments", 1024) == note("rocks", 64) == ""
    assert note("pixels", 960 * 540) == "not run: 12 GiB"
    assert note("pixels", 960 * 540, most_gib=100) == "not run: 8 min"
    assert note("environments", 4096, most_s=60) == "not run: 3 min"


def test_a_process_that_fails_or_hangs_leaves_a_note(monkeypatch):
    point = Point("preset", 0, BASE)
    died = SimpleNamespace(returncode=-9, stdout="", stderr="first\nlast words\n")
    monkeypatch.setattr(growth.subprocess, "run", lambda *words, **more: died)
    assert growth._measured(point, 1, 60.0) == {"note": "failed (exit code -9) last words"}
    with pytest.raises(ConfigError, match="last words"):
        list(growth.growth_rows(BASE, GrowthSizes(), 1))

    def hang(*words, **more):
        raise subprocess.TimeoutExpired("growth_point", 60)

    monkeypatch.setattr(growth.subprocess, "run", hang)
    assert "no answer within" in growth._measured(point, 1, 60.0)["note"]
