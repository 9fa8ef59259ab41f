"""What JAX computes on, and whether it overlooks a GPU."""

import contextlib
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from typing import Any

from segvisrl_jax.config import one_line
from segvisrl_jax.machine.finding import GIB, Finding

SECTION = "devices"
ASK_TIMEOUT_S = 20.0
PLATFORMS_VARIABLE = "JAX_PLATFORMS"


def look() -> Iterator[Finding]:
    """JAX's devices, and NVIDIA's word on what is there."""
    chosen = os.environ.get(PLATFORMS_VARIABLE)
    devices = _jax_devices()
    if isinstance(devices, str):
        remedy = f"{PLATFORMS_VARIABLE} = {chosen!r} is set: unset it." if chosen else "Install jax anew."
        yield Finding(SECTION, "jax", devices, "problem", remedy, stops_training=True)
        return
    for device in devices:
        yield Finding(SECTION, f"jax: {device.platform} {device.id}", _describe(device))
    on_gpu = any(device.platform == "gpu" for device in devices)
    yield from _nvidia(ask_nvidia_smi(), on_gpu, chosen)
    if chosen and on_gpu and "cpu" not in chosen.split(","):
        remedy = f"The physics engine native needs JAX's cpu platform beside it: {PLATFORMS_VARIABLE}={chosen},cpu."
        yield Finding(SECTION, PLATFORMS_VARIABLE, chosen, "note", remedy)


def _jax_devices() -> list[Any] | str:
    """The devices, or why there are none. Starts JAX as training does."""
    with contextlib.suppress(Exception):  # MuJoCo cannot be imported: ``installed`` has said so
        from segvisrl_jax.cpu import make_callbacks_safe

        make_callbacks_safe()  # before JAX's backends start
    try:
        import jax

        return jax.devices()
    except Exception as error:  # a broken installation raises anything
        return one_line(error)


def _describe(device: Any) -> str:
    stats = device.memory_stats() or {}
    memory = f", {stats['bytes_limit'] / GIB:.0f} GiB for JAX" if "bytes_limit" in stats else ""
    return f"{device.device_kind}{memory}"


def ask_nvidia_smi() -> tuple[str, int | None] | None:
    """(the GPUs, the highest major version of CUDA that the driver can run); None without an NVIDIA driver."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return None
    listed = _output([program, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"])
    if not listed:
        return None
    found = re.search(r"CUDA[^:\n]*Version:\s*(\d+)", _output([program]))
    return "; ".join(listed.splitlines()), int(found.group(1)) if found else None


def _output(words: list[str]) -> str:
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=ASK_TIMEOUT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


def _nvidia(found: tuple[str, int | None] | None, on_gpu: bool, chosen: str | None) -> Iterator[Finding]:
    if found is None:
        return
    gpus, cuda = found
    if on_gpu:
        yield Finding(SECTION, "nvidia-smi", gpus)
        return
    if chosen and not {"cuda", "gpu"} & set(chosen.split(",")):
        yield Finding(SECTION, "nvidia-smi", gpus, "problem", f"{PLATFORMS_VARIABLE}={chosen} is set: unset it.")
        return
    extra = "cuda13" if cuda is not None and cuda >= 13 else "cuda12"
    remedy = f"JAX does not see this GPU: pip install 'segvisrl_jax[{extra}]' brings what it needs."
    yield Finding(SECTION, "nvidia-smi", gpus, "problem", remedy)
