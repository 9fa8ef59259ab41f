"""Steps an exported policy with ONNX Runtime: what it says about itself, its actions, the time of a step on one core.

``python run_onnx.py POLICY.onnx [OBSERVATION]``: an .npy array, or an image file (needs Pillow); else random numbers.
Needs numpy and onnxruntime; neither JAX nor segvisrl_jax.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import onnxruntime as ort

STEPS_SHOWN, STEPS_BEFORE_TIMING, STEPS_TIMED = 5, 20, 200


def read(words: list[str], like: ort.NodeArg) -> np.ndarray:
    """The observation, (1, H, W, 3) uint8 or (1, D) float32: the given one, or a random one."""
    dtype = np.uint8 if like.type == "tensor(uint8)" else np.float32
    if not words:
        numbers = np.random.default_rng(0).random(like.shape)
        return (255 * numbers if dtype == np.uint8 else numbers).astype(dtype)
    if words[0].endswith(".npy"):
        seen = np.load(words[0], allow_pickle=False)
    else:
        from PIL import Image

        seen = np.asarray(Image.open(words[0]).convert("RGB"))
    if seen.dtype != dtype or seen.shape != tuple(like.shape[1:]):
        asked = f"{tuple(like.shape[1:])} {np.dtype(dtype)}"
        sys.exit(f"{words[0]}: {seen.shape} {seen.dtype}, but the policy sees {asked}")
    return seen[None]


def main(words: list[str]) -> None:
    """Runs the file named first on the observation named second."""
    if not 1 <= len(words) <= 2:
        sys.exit("usage: python run_onnx.py POLICY.onnx [OBSERVATION.npy | OBSERVATION.png]")
    for word in words:
        if not Path(word).is_file():
            sys.exit(f"{word}: no such file")
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = ort.InferenceSession(words[0], options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime raises classes of its own for each way in which a file is wrong
        sys.exit(f"{words[0]}: ONNX Runtime cannot read it: {' '.join(str(error).split())}")
    texts = session.get_modelmeta().custom_metadata_map
    if not {"carry", "top_speed_m_s"} <= set(texts):
        sys.exit(f"{words[0]}: not a file of segvisrl export: it does not say what the policy is")
    about = {name: json.loads(text) for name, text in texts.items()}
    for name in sorted(about):
        print(f"{name}: {json.dumps(about[name])}")

    state = {"observation": read(words[1:], session.get_inputs()[0])}
    state |= {part["name"]: np.full(part["shape"], part["start"], part["dtype"]) for part in about["carry"]}
    if about["carry"]:
        state["is_first"] = np.ones(1, np.float32)
    times_s = []
    for step in range(STEPS_BEFORE_TIMING + STEPS_TIMED):
        began = time.perf_counter()
        action, *after = session.run(None, state)
        times_s.append(time.perf_counter() - began)
        state |= {part["name"]: new for part, new in zip(about["carry"], after, strict=True)}
        if about["carry"]:
            state["is_first"] = np.zeros(1, np.float32)
        if step < STEPS_SHOWN:
            left, right = action[0] * about["top_speed_m_s"]
            print(f"step {step}: action {action[0].tolist()}: left {left:.3f} m/s, right {right:.3f} m/s")
    timed_ms = 1e3 * np.array(times_s[STEPS_BEFORE_TIMING:])
    median_ms, fastest_ms = np.median(timed_ms), timed_ms.min()
    print(f"one step on one core: median {median_ms:.3f} ms of {STEPS_TIMED}, fastest {fastest_ms:.3f} ms")


if __name__ == "__main__":
    main(sys.argv[1:])
