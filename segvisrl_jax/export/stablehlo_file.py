"""StableHLO: a zip with the step as ``jax.export`` writes it and ``metadata.json``.

The step is (observation, carry, is_first) -> (action, carry), with the parameters inside, for CPU, CUDA and TPU.
``jax.export.deserialize(...).call`` runs it without this package; JAX promises to read it for six months at least.
"""

import dataclasses
import io
import json
import zipfile
from importlib.metadata import version
from typing import Any

import jax
from jax import export

from segvisrl_jax.export.formats import FileFormat
from segvisrl_jax.export.step import CARRY_NAMES, PolicyStep, RunStep, exact, run_on_host

STEP_ENTRY, METADATA_ENTRY = "step.jax_export", "metadata.json"
PLATFORMS = ("cpu", "cuda", "tpu")


def build(step: PolicyStep) -> bytes:
    """The step, lowered for every platform and serialized."""
    step = dataclasses.replace(step, network=step.network.portable)
    lowered = export.export(jax.jit(exact(step)), platforms=PLATFORMS)(step.observation, step.carry, step.is_first)
    return bytes(lowered.serialize())


def with_metadata(artifact: bytes, metadata: dict[str, Any]) -> bytes:
    """The zip's bytes; equal for equal content, as its entries carry no time."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        text = json.dumps(metadata, indent=2) + "\n"
        for name, content in ((METADATA_ENTRY, text.encode()), (STEP_ENTRY, artifact)):
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def open_file(data: bytes) -> tuple[RunStep, dict[str, Any]]:
    """The step, on JAX's default device, and the metadata."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        artifact, metadata = archive.read(STEP_ENTRY), json.loads(archive.read(METADATA_ENTRY))
    return run_on_host(jax.jit(export.deserialize(bytearray(artifact)).call)), metadata


def signature(step: PolicyStep) -> str:
    """As pytrees; without memory, ``is_first`` changes nothing."""
    carry = f"({', '.join(CARRY_NAMES)})" if step.carry else "()"
    return f"(observation, {carry}, is_first) -> (action, {carry})"


FORMAT = FileFormat(build, with_metadata, open_file, signature, f"jax {version('jax')}")
