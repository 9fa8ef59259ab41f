"""Curves over a setting: which evaluations make a line, what is refused, and that the figure shows their numbers."""

import copy
import dataclasses

import imageio.v3 as iio
import matplotlib.figure
import numpy as np
import pytest

from segvisrl_jax.config import ConfigError, EnvConfig, preset_config, replace_fields, to_dict
from segvisrl_jax.report.success_curves import axis_name, draw_success_curves, is_geometric, lines_of, resolve_field
from segvisrl_jax.report.table import Evaluation
from segvisrl_jax.training.statistics import wilson_interval

EPISODES = 50


def evaluation(method, successes, collisions=0, seed=None, training=None, source="", renderer=None, **settings):
    outcome = ["success"] * successes + ["collision"] * collisions
    outcome += ["timeout"] * (EPISODES - len(outcome))
    numbers = {}
    for kind in ("success", "collision"):
        numbers[kind] = outcome.count(kind) / EPISODES
        numbers[f"{kind}_ci95"] = list(wilson_interval(outcome.count(kind), EPISODES))
    return Evaluation(
        file=f"{method}-{successes}.json",
        method=method,
        source=source or method,
        training_seed=seed,
        training_config=training,
        episodes=EPISODES,
        seed=0,
        engine="native",
        renderer=renderer,
        config=replace_fields(EnvConfig(), **settings),
        outcome=tuple(outcome),
        numbers=numbers,
    )


def trained(successes, seed=0, scale=10.0, source="runs/a", collisions=0, **settings):
    training = to_dict(replace_fields(preset_config("cnn", "smoke"), scale=scale, seed=seed))
    training = {name: value for name, value in training.items() if name not in ("run", "runs_dir", "resume")}
    settings = {"scale": scale, **settings}
    return evaluation("cnn", successes, collisions, seed, training, source, "scanline", **settings)


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved while a test ran."""
    figures = []
    save = matplotlib.figure.Figure.savefig

    def remember(figure, *arguments, **options):
        figures.append(figure)
        save(figure, *arguments, **options)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", remember)
    return figures


def density(method="p", counts=((0, 50), (4, 45), (8, 40))):
    return [evaluation(method, successes, 50 - successes, num_rocks=rocks) for rocks, successes in counts]


def test_a_setting_is_found_by_its_full_name_or_its_last_part():
    assert resolve_field(density(), "num_rocks") == "scene.num_rocks"
    assert resolve_field(density(), "scene.num_rocks") == "scene.num_rocks"
    with pytest.raises(ConfigError, match=r"--x = 'num_rock': .*, such as num_rocks"):
        resolve_field(density(), "num_rock")
    with pytest.raises(ConfigError, match=r"camera\.scale.*such as scene\.num_rocks; it is 10\.0 in all"):
        resolve_field(density(), "scale")
    with pytest.raises(ConfigError, match="but these files differ in none"):
        resolve_field(density()[:1], "num_rocks")
    with pytest.raises(ConfigError, match="a setting that is a number"):
        resolve_field(density(), "obs")
    with pytest.raises(ConfigError, match="none given"):
        resolve_field([], "num_rocks")


def test_policies_trained_for_each_value_make_one_line_and_their_median_seed_counts():
    policies = [trained(40 - scale - seed, seed, float(scale)) for scale in (5, 10) for seed in (0, 1, 2, 3)]
    [line] = lines_of(policies, "camera.scale")
    assert {value: len(seeds) for value, seeds in line.points.items()} == {5.0: 4, 10.0: 4}
    assert [line.median(value).numbers["success"] for value in (5.0, 10.0)] == [33 / 50, 28 / 50]
    with pytest.raises(ConfigError, match="holds cnn with training seed 1 too"):
        lines_of([*policies, policies[1]], "camera.scale")


def test_other_policies_are_other_lines_named_by_where_they_came_from():
    ours = [trained(40, num_rocks=n) for n in (4, 8)]
    other = [trained(30, num_rocks=n, source="runs/cnn_wide") for n in (4, 8)]
    for one in other:
        one.training_config["network"]["lstm_size"] = 7
    names = [line.name for line in lines_of([*ours, *other, *density()], "scene.num_rocks")]
    assert names == ["cnn (a)", "cnn_wide", "P controller"]
    several = [dataclasses.replace(one, source=f"runs/{i}") for i, one in enumerate([*ours, *other])]
    names = [line.name for line in lines_of([*several, *density()], "scene.num_rocks")]
    assert names == ["cnn (lstm_size 256)", "cnn (lstm_size 7)", "P controller"]


def test_lines_of_several_runs_are_named_by_the_fewest_settings_that_tell_them_apart():
    runs = []
    for i, (lstm_size, channels, discount) in enumerate([(256, 16, 0.97), (256, 32, 0.5), (7, 32, 0.97)]):
        for n in (4, 8):
            one = trained(40, num_rocks=n, source=f"runs/{i}-{n}")
            one.training_config["network"] |= {"lstm_size": lstm_size, "channels": [channels, 32, 32]}
            one.training_config["ppo"]["discount"] = discount
            runs.append(one)
    names = [line.name for line in lines_of(runs, "scene.num_rocks")]
    assert names == ["cnn (channels [16, 32, 32])", "cnn (discount 0.5)", "cnn (lstm_size 7)"]
    for one in runs[2:]:
        one.training_config["network"]["lstm_size"] = 256
        one.training_config["ppo"]["discount"] = 0.5
    for one in runs[4:]:
        one.training_config["ppo"]["unroll_length"] = 3
    runs[0].training_config["ppo"]["discount"] = runs[1].training_config["ppo"]["discount"] = 0.5
    names = [line.name for line in lines_of(runs, "scene.num_rocks")]
    assert names[1:] == ["cnn (channels [32, 32, 32], unroll_length 32)", "cnn (unroll_length 3)"]


def test_other_worlds_are_refused_but_other_eyes_engines_and_rewards_are_not():
    lines = lines_of([*density(), *(trained(40, num_rocks=n, scale=40.0) for n in (0, 4))], "scene.num_rocks")
    assert len(lines) == 2
    finer = [evaluation("planner", 50, num_rocks=n, timestep_s=0.02, collision_reward=-5.0) for n in (0, 4)]
    assert len(lines_of([*density(), *finer], "scene.num_rocks")) == 2
    far = evaluation("planner", 50, goal_distance_max_m=18.0)
    with pytest.raises(ConfigError, match=r"planner-50\.json: scene\.goal_distance_max_m = 18\.0: should be 16\.0"):
        lines_of([*density(), far], "scene.num_rocks")
    elsewhere = dataclasses.replace(evaluation("planner", 50), seed=3)
    with pytest.raises(ConfigError, match="seed = 3"):
        lines_of([*density(), elsewhere], "scene.num_rocks")


def test_the_figure_shows_shares_intervals_and_a_dashed_ceiling(tmp_path, drawn):
    counts = ((0, 50), (4, 45), (8, 40), (16, 30), (32, 20))
    evaluations = density(counts=counts) + density("planner", ((0, 50), (32, 50)))
    image = iio.imread(draw_success_curves(evaluations, "num_rocks", tmp_path / "density.png"))
    assert image.shape[1] > 1000
    success, collision = drawn[0].axes
    controller, planner = success.lines[0], next(line for line in success.lines if line.get_linestyle() == "--")
    np.testing.assert_array_equal(controller.get_xdata(), [0, 4, 8, 16, 32])
    np.testing.assert_allclose(controller.get_ydata(), [1.0, 0.9, 0.8, 0.6, 0.4])
    np.testing.assert_array_equal(planner.get_ydata(), [1, 1])
    np.testing.assert_allclose(collision.lines[0].get_ydata(), [0.0, 0.1, 0.2, 0.4, 0.6])
    corners = success.collections[0].get_paths()[0].vertices
    last = corners[corners[:, 0] == 32, 1]
    np.testing.assert_allclose((last.min(), last.max()), wilson_interval(20, 50))
    assert len(success.collections) == 1  # the ceiling has no band
    assert [text.get_text() for text in collision.texts] == ["P controller", "planner (ceiling)"]
    assert [label.get_text() for label in success.get_xticklabels()] == ["0", "4", "8", "16", "32"]
    places = success.transData.transform([(value, 0.5) for value in (0, 4, 8, 16, 32)])[:, 0]
    np.testing.assert_allclose(np.diff(places), np.diff(places).mean(), rtol=1e-6)  # as far apart, the 0 too
    left, right = success.get_xlim()
    assert left < 0 < 32 < right
    assert success.get_xlabel() == "rocks on the map"


def test_what_does_not_look_is_level_over_the_cameras_settings(tmp_path, drawn):
    policies = [trained(40 - scale, scale=float(scale)) for scale in (10, 20, 30)]
    draw_success_curves([*policies, evaluation("p", 45)], "scale", tmp_path / "scale.png")
    success = drawn[0].axes[0]
    level = success.lines[-1]
    np.testing.assert_array_equal(level.get_xdata(), [10, 20, 30])
    np.testing.assert_array_equal(level.get_ydata(), [0.9, 0.9, 0.9])
    assert success.get_xticklabels()[0].get_text() == "10\n192\nx 108"
    assert success.get_xscale() == "linear"


def test_the_scale_is_the_one_on_which_values_are_more_even():
    assert is_geometric([0, 4, 8, 16, 32, 64])
    assert is_geometric([5, 10, 20, 40, 60])
    assert not is_geometric([10, 20, 30, 40, 50, 60])
    assert not is_geometric([0, 4, 8, 12])
    assert not is_geometric([1, 100])
    assert not is_geometric([-1, 1, 10, 100])


def test_axes_are_named_with_their_units():
    names = {name: axis_name(name) for name in ("physics.gravity_m_s2", "task.collision_radius_m", "scene.new_thing")}
    assert list(names.values()) == ["gravity [m/s²]", "collision radius [m]", "new thing"]
    assert axis_name("physics.top_speed_m_s") == "top speed [m/s]"


def test_drawing_changes_no_evaluation(tmp_path):
    evaluations = density()
    before = copy.deepcopy(evaluations)
    draw_success_curves(evaluations, "num_rocks", tmp_path / "density.png")
    assert evaluations == before
