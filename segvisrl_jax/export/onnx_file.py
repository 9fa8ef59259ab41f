"""ONNX: one model file, with metadata in ``metadata_props``: each value there is JSON.

Inputs are ``observation``, and with memory ``cell``, ``hidden`` and ``is_first``; outputs are ``action``, and with
memory ``next_cell`` and ``next_hidden``, which are the next step's ``cell`` and ``hidden``.

The graph is built by hand: the network is small and known. The converter jax2onnx gives twice as many nodes (pooling
as slices), asks for a newer runtime, and brings a dozen packages that restrict the versions of others.
"""

import json
from typing import Any

import jax
import numpy as np
import onnx
import onnxruntime
from onnx import helper

from segvisrl_jax.config import flatten
from segvisrl_jax.export.formats import FileFormat
from segvisrl_jax.export.onnx_network import (
    ACTION,
    IS_FIRST,
    NEXT,
    OBSERVATION,
    Graph,
    act,
    image_features,
    remember,
    vector_features,
)
from segvisrl_jax.export.step import ACTION_SHAPE, CARRY_NAMES, HostCarry, PolicyStep, RunStep

OPSET, IR_VERSION = 17, 8  # of 2022: ONNX Runtime 1.12 and later, TensorRT 8.5 and later


def build(step: PolicyStep) -> bytes:
    """The step as a checked ONNX model.

    Raises:
        onnx.checker.ValidationError: where shapes do not fit together.
    """
    graph = _graph(step)
    inputs = [_tensor(OBSERVATION, step.observation)]
    outputs = [helper.make_tensor_value_info(ACTION, onnx.TensorProto.FLOAT, ACTION_SHAPE)]
    for name, part in zip(CARRY_NAMES, step.carry, strict=False):
        inputs.append(_tensor(name, part))
        outputs.append(_tensor(NEXT + name, part))
    if step.carry:
        inputs.append(_tensor(IS_FIRST, step.is_first))
    whole = helper.make_graph(graph.nodes, "policy_step", inputs, outputs, graph.constants)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(whole, producer_name="segvisrl_jax", opset_imports=opset, ir_version=IR_VERSION)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _graph(step: PolicyStep) -> Graph:
    """Nodes and constants of the whole step."""
    network, config = step.network, step.network.module.config
    leaves = flatten(jax.device_get(step.params)["params"])
    graph = Graph({name.replace(".", "/"): value for name, value in leaves.items()})
    if network.has_convolutions:
        features = image_features(graph, network.observation_shape, config)
    else:
        features = vector_features(graph, config)
    act(graph, remember(graph, features) if network.has_memory else features, config)
    return graph


def _tensor(name: str, like: jax.ShapeDtypeStruct) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(np.dtype(like.dtype)), like.shape)


def with_metadata(model: bytes, metadata: dict[str, Any]) -> bytes:
    """The model with its description."""
    loaded = onnx.load_from_string(model)
    helper.set_model_props(loaded, {name: json.dumps(value) for name, value in metadata.items()})
    return loaded.SerializeToString()


def open_file(data: bytes) -> tuple[RunStep, dict[str, Any]]:
    """The step, in ONNX Runtime on the CPU, and the metadata."""
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    described = session.get_modelmeta().custom_metadata_map
    has_memory = len(session.get_inputs()) > 1

    def run(observation: np.ndarray, carry: HostCarry, is_first: np.ndarray) -> tuple[np.ndarray, HostCarry]:
        memory = {**dict(zip(CARRY_NAMES, carry, strict=True)), IS_FIRST: is_first} if has_memory else {}
        action, *after = session.run(None, {OBSERVATION: observation, **memory})
        return action, tuple(after)

    return run, {name: json.loads(value) for name, value in described.items()}


def signature(step: PolicyStep) -> str:
    """Inputs and outputs by their names."""
    memory = CARRY_NAMES if step.carry else ()
    inputs = (OBSERVATION, *memory, *((IS_FIRST,) if memory else ()))
    outputs = (ACTION, *(NEXT + name for name in memory))
    return f"({', '.join(inputs)}) -> ({', '.join(outputs)})"


FORMAT = FileFormat(build, with_metadata, open_file, signature, f"onnxruntime {onnxruntime.__version__}")
