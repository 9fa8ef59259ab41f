"""The networks of ``agent.networks``, acting by their mean, as ONNX nodes.

This must compute what ``agent`` computes: every export is compared with the original (``check.py``). The operators are
few and old, so that any runtime has them.
"""

from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from segvisrl_jax.agent.convolution import POOL_STRIDE, POOL_WINDOW, WINDOW
from segvisrl_jax.agent.memory import GATES
from segvisrl_jax.agent.networks import MIDDLE_SPEED, PIXEL_MAX, mean_reach
from segvisrl_jax.config import NetworkConfig
from segvisrl_jax.export.step import CARRY_NAMES

OBSERVATION, IS_FIRST, ACTION = "observation", "is_first", "action"
NEXT = "next_"  # what comes out for the next step's ``cell`` is named ``next_cell``
CHANNELS_FIRST, CHANNELS_LAST = (0, 3, 1, 2), (0, 2, 3, 1)  # ONNX's images have channels first


class Graph:
    """Nodes and constants in the order in which they were added; a value is its name."""

    def __init__(self, weights: dict[str, np.ndarray]) -> None:
        """Takes the parameters by their paths, such as ``body/Conv_0/kernel``."""
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.weights = weights

    def add(self, operator: str, *inputs: str, named: str | None = None, **attributes: Any) -> str:
        """A node with one output."""
        output = named or f"{operator}_{len(self.nodes)}"
        self.add_split(operator, inputs, (output,), **attributes)
        return output

    def add_split(self, operator: str, inputs: tuple[str, ...], outputs: tuple[str, ...], **attributes: Any) -> None:
        """A node with several outputs."""
        name = f"{operator}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, outputs, name=name, **attributes))

    def constant(self, name: str, value: Any, dtype: type = np.float32) -> str:
        """A constant array or number."""
        self.constants.append(numpy_helper.from_array(np.array(value, dtype, order="C"), name))
        return name

    def dense(self, vector: str, path: str) -> str:
        """flax's ``Dense`` of that path: (1, D) to (1, F)."""
        names = [self.constant(f"{path}/{part}", self.weights[f"{path}/{part}"]) for part in ("kernel", "bias")]
        return self.add("Gemm", vector, *names)

    def convolution(self, images: str, path: str) -> str:
        """flax's ``Conv`` of that path, 3 x 3 with stride 1 and SAME padding: (1, C, H, W) to (1, D, H, W)."""
        kernel = self.weights[f"{path}/kernel"].transpose(3, 2, 0, 1)  # flax: rows, columns, in, out
        names = self.constant(f"{path}/kernel", kernel), self.constant(f"{path}/bias", self.weights[f"{path}/bias"])
        return self.add("Conv", images, *names, kernel_shape=WINDOW, pads=[size // 2 for size in WINDOW * 2])

    def max_pool(self, images: str, height: int, width: int) -> str:
        """``agent.convolution.max_pool`` of (1, C, height, width); where its padding is uneven, the end has more."""
        padding = [max(POOL_STRIDE * (pooled(size) - 1) + POOL_WINDOW - size, 0) for size in (height, width)]
        before = [size // 2 for size in padding]
        after = [whole - first for whole, first in zip(padding, before, strict=True)]
        window, strides = (POOL_WINDOW, POOL_WINDOW), (POOL_STRIDE, POOL_STRIDE)
        return self.add("MaxPool", images, kernel_shape=window, strides=strides, pads=before + after)


def pooled(size: int) -> int:
    """Rows or columns that a max-pool leaves."""
    return -(-size // POOL_STRIDE)


def image_features(graph: Graph, shape: tuple[int, ...], config: NetworkConfig) -> str:
    """``ImpalaCNN`` of the observation, (1, H, W, 3) uint8 with ``shape`` = (H, W, 3): the features, (1, F)."""
    pixels = graph.add("Cast", OBSERVATION, to=onnx.TensorProto.FLOAT)
    shares = graph.add("Div", pixels, graph.constant("pixel_max", PIXEL_MAX))
    features, (height, width, _) = graph.add("Transpose", shares, perm=CHANNELS_FIRST), shape
    for stage in range(len(config.channels)):
        features = graph.max_pool(graph.convolution(features, f"body/Conv_{stage}"), height, width)
        height, width = pooled(height), pooled(width)
        for block in range(config.blocks_per_stage):
            features = _residual_block(graph, features, stage * config.blocks_per_stage + block)
    last = graph.add("Transpose", graph.add("Relu", features), perm=CHANNELS_LAST)
    flat = graph.add("Reshape", last, graph.constant("flat_shape", (1, -1), np.int64))
    return graph.add("Relu", graph.dense(flat, "body/Dense_0"))


def _residual_block(graph: Graph, images: str, number: int) -> str:
    """``ResidualBlock`` number ``number`` of all stages together."""
    change = images
    for layer in range(2):
        change = graph.convolution(graph.add("Relu", change), f"body/ResidualBlock_{number}/Conv_{layer}")
    return graph.add("Add", images, change)


def vector_features(graph: Graph, config: NetworkConfig) -> str:
    """``MLP`` of the observation, (1, D) float32: the features, (1, F)."""
    features = OBSERVATION
    for layer in range(len(config.mlp_sizes)):
        features = graph.add("Relu", graph.dense(features, f"body/Dense_{layer}"))
    return features


def remember(graph: Graph, features: str) -> str:
    """``ResettableLSTM``: the next hidden state, (1, S), which is an output of the file too, as the next cell is."""
    zero = graph.constant("zero", 0.0)
    begins = graph.add("Greater", IS_FIRST, zero)
    cell, hidden = (graph.add("Where", begins, zero, name) for name in CARRY_NAMES)
    entering = graph.add("Concat", features, hidden, axis=1)
    graph.add_split("Split", (_gates(graph, entering),), tuple(GATES), axis=1)
    enter, forget, leave = (graph.add("Sigmoid", gate) for gate in ("i", "f", "o"))
    kept, new = graph.add("Mul", forget, cell), graph.add("Mul", enter, graph.add("Tanh", "g"))
    next_cell, next_hidden = (NEXT + name for name in CARRY_NAMES)
    graph.add("Add", kept, new, named=next_cell)
    return graph.add("Mul", leave, graph.add("Tanh", next_cell), named=next_hidden)


def _gates(graph: Graph, entering: str) -> str:
    """All four gates before their functions, (1, 4 * S), from features and hidden state, (1, F + S)."""

    def side_by_side(letter: str, part: str) -> np.ndarray:
        return np.concatenate([graph.weights[f"memory/cell/{letter}{gate}/{part}"] for gate in GATES], axis=-1)

    by_entering = np.concatenate([side_by_side("i", "kernel"), side_by_side("h", "kernel")])
    kernel = graph.constant("memory/kernel", by_entering)
    return graph.add("Gemm", entering, kernel, graph.constant("memory/bias", side_by_side("h", "bias")))


def act(graph: Graph, features: str, config: NetworkConfig) -> str:
    """The policy's head: the mean of the action, clipped to [0, 1], (1, 2)."""
    deviation = graph.dense(features, "policy_head")
    if config.bounded_mean:
        reach = graph.constant("mean_reach", mean_reach(config))
        deviation = graph.add("Mul", graph.add("Tanh", deviation), reach)
    mean = graph.add("Add", deviation, graph.constant("middle_speed", MIDDLE_SPEED))
    bounds = graph.constant("slowest", 0.0), graph.constant("fastest", 1.0)
    return graph.add("Clip", mean, *bounds, named=ACTION)
