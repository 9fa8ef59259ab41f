"""What a file says about itself, as JSON data: what goes in and what comes out, in which units, and whose it is."""

from importlib.metadata import version
from typing import Any

import numpy as np

from segvisrl_jax.config import IMAGE_OBSERVATIONS, EnvConfig, TrainConfig, to_dict
from segvisrl_jax.env.vector import NUM_NEAREST_ROCKS, ROCK_RANGE_M, TYPICAL_TURN_RATE_RAD_S
from segvisrl_jax.export.step import ACTION_SHAPE, CARRY_NAMES, PolicyStep
from segvisrl_jax.vision.classes import CLASS_NAMES, PALETTE

METADATA_FORMAT = 1
FRAME = "forward and left are the rover's; the heading is 0 along the map's x axis and grows to the left"
IS_FIRST_MEANING = "1 where a drive begins: the carry is taken as zeros; else 0"
PACKAGES = ("segvisrl_jax", "jax", "jaxlib", "flax", "numpy")


def describe(name: str, step: PolicyStep, config: TrainConfig, scores: dict[str, Any]) -> dict[str, Any]:
    """The metadata of an exported policy, without the check.

    Args:
        name: what the policy is called.
        step: what is exported.
        config: the settings of the run that trained it.
        scores: what ``evaluation.summarize`` said of it on validation scenes.
    """
    network = step.network
    return {
        "metadata_format": METADATA_FORMAT,
        "policy": name,
        "architecture": network.module.arch,
        "network": to_dict(network.module.config),
        "observation": {**_array(step.observation), **_what_is_seen(config.env)},
        "carry": [
            {"name": part, **_array(like), "start": 0.0} for part, like in zip(CARRY_NAMES, step.carry, strict=False)
        ],
        "is_first": {**_array(step.is_first), "meaning": IS_FIRST_MEANING} if step.carry else None,
        "action": {
            "shape": list(ACTION_SHAPE),
            "dtype": "float32",
            "elements": ["left wheels", "right wheels"],
            "meaning": "speed, held until the next decision",
            "unit": "share of top_speed_m_s",
            "range": [0.0, 1.0],
        },
        "top_speed_m_s": config.env.physics.top_speed_m_s,
        "decision_period_s": config.env.task.decision_dt_s,
        "versions": {package: version(package) for package in PACKAGES},
        "training": {"preset": config.preset, "seed": config.seed, "steps": config.steps},
        "validation": scores,
    }


def _array(like: Any) -> dict[str, Any]:
    return {"shape": list(like.shape), "dtype": str(np.dtype(like.dtype))}


def _what_is_seen(env: EnvConfig) -> dict[str, Any]:
    """kind, and what each number of an observation means."""
    if env.obs not in IMAGE_OBSERVATIONS:
        return {"kind": env.obs, "elements": _elements(env), "frame": FRAME}
    camera, is_segmented = env.camera, env.obs == "segmentation"
    shown = "image in the colours of the classes" if is_segmented else "colour image"
    classes = {"classes": dict(zip(CLASS_NAMES, PALETTE.tolist(), strict=True))} if is_segmented else {}
    return {
        "kind": env.obs,
        "axes": ["batch", "rows from the top", "columns from the left", "colours"],
        "colour_order": "RGB",
        **classes,
        "image_scale": camera.scale,
        "made_from": f"{camera.width_px} x {camera.height_px} {shown}, shrunk as cv2.resize does with INTER_CUBIC",
        "horizontal_fov_deg": camera.horizontal_fov_deg,
        "far_m": camera.far_m,
    }


def _elements(env: EnvConfig) -> list[str]:
    """What each number of a vector is; ``env.vector`` computes them."""
    goal, speed, turn = env.scene.goal_distance_max_m, env.physics.top_speed_m_s, TYPICAL_TURN_RATE_RAD_S
    state = [
        f"goal forward [m] / {goal:g}",
        f"goal left [m] / {goal:g}",
        "sine of the heading on the map",
        "cosine of the heading on the map",
        f"speed forward [m/s] / {speed:g}",
        f"speed left [m/s] / {speed:g}",
        f"turn rate to the left [rad/s] / {turn:g}",
    ]
    near = env.task.collision_radius_m
    rocks = [
        f"rock {number}, the nearest first, zero beyond {ROCK_RANGE_M:g} m: {what}"
        for number in range(1, NUM_NEAREST_ROCKS + 1)
        for what in ("direction forward", "direction left", f"{near:g} m / distance, at most 1")
    ]
    return state + (rocks if env.obs == "state_and_rocks" else [])
