"""The peers of the benchmark are real ones, of the same network and sizes."""

import math

import pytest

from segvisrl_jax.config import preset_config, replace_fields

pytest.importorskip("sb3_contrib")
from segvisrl_jax.machine import peers


def num_parameters(arrays):
    return sum(math.prod(array.shape) for array in arrays)


def test_the_network_has_as_many_parameters_as_ours():
    import gymnasium
    import jax
    import numpy as np

    from segvisrl_jax.agent.networks import make_network

    config = preset_config("cnn_lstm", "cpu")
    ours = make_network("cnn_lstm", config.network, (27, 48, 3)).init(jax.random.key(0))["params"]["body"]
    space = gymnasium.spaces.Box(0, 255, (3, 27, 48), np.uint8)
    theirs = peers.TorchImpala(space, config.network)
    assert num_parameters(theirs.parameters()) == num_parameters(jax.tree.leaves(ours))


@pytest.mark.slow
def test_every_row_has_ours_theirs_and_their_ratio():
    small = replace_fields(preset_config("cnn_lstm", "smoke"), width_px=192, height_px=108, scale=12.0)
    limit, *rows = peers.peer_rows(small, repeats=1, scales=(12.0,))
    assert limit["gflop_per_s"] > 0
    assert [row["name"] for row in rows] == ["gradient images/s, 16 x 9", "training decisions/s"]
    assert rows[0]["peer"] == "PyTorch"
    assert rows[1]["peer"].startswith("sb3-contrib RecurrentPPO, renderer ")
    for row in rows:
        assert row["theirs"] > 0
        assert row["ratio"] == pytest.approx(row["segvisrl_jax"] / row["theirs"])
        ours, theirs = row["percent_of_matrix_product"], row["theirs_percent_of_matrix_product"]
        assert 0 < ours < 100
        assert ours / theirs == pytest.approx(row["ratio"])
