"""MuJoCo's own renderer, with segmentation on, as one would use it without this project: a peer of the renderers."""

from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from segvisrl_jax.config import EnvConfig, replace_fields
from segvisrl_jax.env.model import CAMERA_NAME
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.vision.classes import GEOM_PREFIXES, PALETTE
from segvisrl_jax.vision.gl_context import open_gl_context
from segvisrl_jax.vision.resample import downsample


def mujoco_look(config: EnvConfig) -> Callable[[Any], list[Any]]:
    """From a batch of states to their observations, one frame after another, shrunk as the project's own are.

    Raises:
        ConfigError: where OpenGL cannot be opened.
    """
    gl_context.GLContext = open_gl_context  # else it looks for a display where MUJOCO_GL is not set
    env = RoverEnv(replace_fields(config, obs="state"))
    camera, model = config.camera, env.mj_model
    renderer = mujoco.Renderer(model, camera.height_px, camera.width_px)
    renderer.enable_segmentation_rendering()
    names = [model.geom(geom).name for geom in range(model.ngeom)]
    of_geom = [next((k for prefix, k in GEOM_PREFIXES.items() if name.startswith(prefix)), 0) for name in names]
    colours = np.append(PALETTE[of_geom], PALETTE[:1], axis=0)  # what is no geom (-1) is space
    shrink = jax.jit(lambda image: downsample(image, camera.scale))

    def look(states: Any) -> list[Any]:
        arrays = jax.tree.map(np.asarray, states)
        images = []
        for number in range(len(arrays.num_decisions)):
            data = env.to_mujoco(jax.tree.map(lambda leaf, number=number: leaf[number], arrays))
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, CAMERA_NAME)
            images.append(shrink(colours[renderer.render()[..., 0]]))
        return images

    return look
