"""Settings for the whole suite: CPU only, repeatable property tests, programs that do not pile up."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Small programs that run once: compiling them takes longer than running them. A fifth less time for the suite.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true")

# What one test compiled, others need not: in this process, in the other workers, and in programs that tests start.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "programs"))
os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(2**31))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import jax
import pytest
from hypothesis import HealthCheck, settings

MAPS = Path("/proc/self/maps")  # Linux: a line for each piece of this process's memory
MOST_MAPS = 20_000  # Linux allows 65,530 (vm.max_map_count); beyond, compiling ends the process

settings.register_profile(
    "repeatable",
    derandomize=True,
    deadline=None,
    max_examples=25,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("repeatable")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that compare with OpenGL are left out, by name, where it cannot be opened; all else runs anywhere."""
    marked = [item for item in items if item.get_closest_marker("gl")]
    reason = _why_no_opengl() if marked else ""
    for item in marked:
        if reason:
            item.add_marker(pytest.mark.skip(reason=reason))


def _why_no_opengl() -> str:
    from segvisrl_jax.config import ConfigError
    from segvisrl_jax.vision.gl_context import open_gl_context

    try:
        open_gl_context(16, 16).free()
    except ConfigError as error:
        return str(error)
    return ""


@pytest.fixture(autouse=True)
def _mujoco_without_a_display(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """``mujoco.Renderer`` opens OpenGL as the project does; by itself it wants a display, and aborts without one."""
    if request.node.get_closest_marker("gl"):
        from mujoco.rendering.classic import gl_context

        from segvisrl_jax.vision.gl_context import open_gl_context

        monkeypatch.setattr(gl_context, "GLContext", open_gl_context)


@pytest.fixture(autouse=True)
def _programs_do_not_pile_up() -> Iterator[None]:
    """Every compiled program keeps some pieces of memory, and a worker compiles thousands of programs."""
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()
