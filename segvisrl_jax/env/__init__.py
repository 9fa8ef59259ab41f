"""The environment: scene, model, physics, task, and ``RoverEnv`` that composes them."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints two lines where Warp is not installed; Warp is optional
    import mujoco.mjx  # noqa: F401
