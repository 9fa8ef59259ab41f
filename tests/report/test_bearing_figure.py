"""Success and path over the goal's direction: the bins, and what is left out."""

import imageio.v3 as iio
import numpy as np

from segvisrl_jax.config import EnvConfig
from segvisrl_jax.report.bearing_figure import LEAST_EPISODES, bearing_line, draw_bearings
from segvisrl_jax.report.table import Evaluation


def evaluation(record, method="cnn", seed=3):
    """Episodes as (bearing in degrees, outcome, shortest path, driven path)."""
    bearings, outcomes, shortest, driven = zip(*record, strict=True)
    lists = {"goal_bearing_deg": bearings, "shortest_path_m": shortest, "path_length_m": driven}
    return Evaluation(
        file="a.json",
        method=method,
        source="runs/a",
        training_seed=seed,
        training_config=None,
        episodes=len(record),
        seed=0,
        engine="native",
        renderer=None,
        config=EnvConfig(),
        outcome=outcomes,
        numbers={"per_episode": {name: list(values) for name, values in lists.items()}},
    )


HALF = LEAST_EPISODES // 2
RECORD = (
    [(-20.0, "success", 10.0, 12.5)] * HALF  # in the bin from -30 to -15 degrees
    + [(-29.9, "timeout", 10.0, 40.0)] * HALF
    + [(1.0, "success", 10.0, 9.99)] * LEAST_EPISODES  # the last stretch to the goal is within its radius
    + [(16.0, "success", 10.0, 20.0)] * (LEAST_EPISODES - 1)
    + [(-31.0, "timeout", None, 40.0)] * LEAST_EPISODES
)


def test_episodes_are_binned_by_direction_and_paths_are_of_those_that_arrived():
    line = bearing_line(evaluation(RECORD))
    assert line.name == "cnn, seed 3"
    np.testing.assert_allclose(line.bearing_deg, [-37.5, -22.5, 7.5])
    np.testing.assert_allclose(line.success, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(line.path_share, [np.nan, 0.8, 1.0])


def test_the_figure_is_drawn_also_where_nothing_arrived(tmp_path):
    lost = [(angle, "timeout", 10.0, 40.0) for angle in np.linspace(-80, 80, 200)]
    path = draw_bearings([evaluation(RECORD), evaluation(lost, "p", None)], tmp_path / "bearings.png")
    assert iio.imread(path)[..., :3].std() > 10
