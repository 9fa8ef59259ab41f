"""The ONNX graph computes what the network does, for every architecture, odd sizes and other settings."""

import jax
import numpy as np
import pytest

from segvisrl_jax.agent.networks import make_network
from segvisrl_jax.config import NetworkConfig
from segvisrl_jax.export.check import compare
from segvisrl_jax.export.formats import file_format
from segvisrl_jax.export.step import PolicyStep

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

SMALL = {"channels": (4, 6), "blocks_per_stage": 1, "feature_size": 8, "lstm_size": 5, "mlp_sizes": (9, 6)}
SPREAD = 0.3


def random_step(arch, shape, **settings):
    """A network whose every parameter is random, so that biases and the small policy head count."""
    network = make_network(arch, NetworkConfig(**{**SMALL, **settings}), shape)
    draw = np.random.default_rng(0).standard_normal
    like = jax.eval_shape(network.init, jax.random.key(0))
    return PolicyStep(network, jax.tree.map(lambda leaf: np.asarray(SPREAD * draw(leaf.shape), leaf.dtype), like))


@pytest.mark.parametrize(
    ("arch", "shape", "settings"),
    [
        ("cnn_lstm", (9, 16, 3), {}),
        ("cnn_lstm_raw", (7, 5, 3), {"blocks_per_stage": 2}),
        ("cnn", (4, 10, 3), {"channels": (3, 5, 4), "blocks_per_stage": 0}),
        ("cnn", (6, 7, 3), {"bounded_mean": False}),
        ("mlp", (7,), {"mlp_sizes": (8,), "mean_overshoot": 0.1}),
        ("mlp_rocks", (31,), {"bounded_mean": False}),
    ],
)
def test_the_graph_computes_what_the_network_does(arch, shape, settings):
    step = random_step(arch, shape, **settings)
    onnx_file = file_format("onnx")
    run, _ = onnx_file.open(onnx_file.build(step))
    drawn = np.random.default_rng(0).random((2, 10, *shape))
    is_image = len(shape) == 3
    drives = list((255 * drawn).astype(np.uint8) if is_image else (2 * drawn - 1).astype(np.float32))
    found = compare(run, step.on_host(), drives, step.start_carry())
    assert found["decisions"] == 20
    assert found["largest_action_difference"] < 1e-5
    action, carry = run(drives[0][:1], step.start_carry(), np.ones(1, np.float32))
    original = step.on_host()(drives[0][:1], step.start_carry(), np.ones(1, np.float32))
    assert action.shape == (1, 2)
    for part, same in zip(carry, original[1], strict=True):
        np.testing.assert_allclose(part, same, atol=1e-5)
