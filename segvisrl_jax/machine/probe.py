"""OpenGL and MuJoCo Warp, each tried in a process of its own: a crash, a hang, or a library that can be loaded only
once for a process spoils nothing else.

``python -m segvisrl_jax.machine.probe egl`` is such a process; it prints one line of JSON.
"""

import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

from segvisrl_jax.config import one_line
from segvisrl_jax.machine.finding import Finding

HEADLESS = ("egl", "osmesa")
VARIABLE = "MUJOCO_GL"
OPENGL, WARP = "OpenGL", "MuJoCo Warp"
TIMEOUT_S = 60.0
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software", "swiftshader")  # in GL_RENDERER, where no GPU draws
PROBED_SIZE_PX = 64
NOT_NEEDED = "Training does not need OpenGL; the renderer gl and its tests do"
INSTALL = "apt-get install libegl1 libgl1-mesa-dri, or libosmesa6"
Answer = dict[str, Any]


def look(ask: Callable[[str], Answer] | None = None) -> Iterator[Finding]:
    """Every way into OpenGL, and MuJoCo Warp.

    Args:
        ask: the answer of a probe by its name; a process for each by default.
    """
    ask = ask or _ask
    yield from _opengl({name: ask(name) for name in _ways()})
    yield _warp(ask("warp"))


def _ways() -> tuple[str, ...]:
    return HEADLESS if platform.system() == "Linux" else ("default",)


def _opengl(answers: dict[str, Answer]) -> Iterator[Finding]:
    opened = {name for name, answer in answers.items() if "error" not in answer}
    for name, answer in answers.items():
        if name in opened:
            yield Finding(OPENGL, name, f"{answer['vendor']}, {answer['renderer']}: {_kind(name, answer['renderer'])}")
        elif opened:
            yield Finding(OPENGL, name, answer["error"], "note", f"{', '.join(opened)} is enough.")
        else:
            yield Finding(OPENGL, name, answer["error"], "problem", f"{NOT_NEEDED}: {INSTALL}.")
    chosen = os.environ.get(VARIABLE)
    if chosen and opened and chosen.lower() not in opened:
        remedy = f"{NOT_NEEDED}: unset {VARIABLE}, or set it to {' or '.join(sorted(opened))}."
        yield Finding(OPENGL, VARIABLE, f"{chosen} is set", "problem", remedy)


def _kind(name: str, renderer: str) -> str:
    is_software = name == "osmesa" or any(word in renderer.lower() for word in SOFTWARE)
    return "software, slow" if is_software else "hardware"


def _warp(answer: Answer) -> Finding:
    if "error" in answer:
        remedy = "Only the renderer warp needs it: pip install 'segvisrl_jax[warp]' brings it."
        return Finding(WARP, "warp", answer["error"], "note", remedy)
    cuda = answer["cuda"]
    if not cuda:
        return Finding(WARP, "warp", "no CUDA device", "note", "The renderer warp runs on the CPU, slowly.")
    return Finding(WARP, "warp", f"CUDA: {', '.join(cuda)}")


def _ask(name: str) -> Answer:
    """What a probe says; an answer with ``error`` where it fails, crashes or hangs."""
    environment = {key: value for key, value in os.environ.items() if key not in (VARIABLE, "PYOPENGL_PLATFORM")}
    words = [sys.executable, "-m", "segvisrl_jax.machine.probe", name]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=TIMEOUT_S, env=environment, check=False)
    except subprocess.TimeoutExpired:
        return {"error": f"no answer within {TIMEOUT_S:.0f} s"}
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        return {"error": f"crashed (exit code {done.returncode})"}
    answer: Answer = json.loads(lines[-1])
    return answer


def _try_opengl(name: str) -> Answer:
    """Opens a context, lets MuJoCo prepare a model in it, asks who draws."""
    import mujoco

    from segvisrl_jax.vision.gl_context import open_draw_context

    if name in HEADLESS:
        os.environ[VARIABLE] = name  # only now: MuJoCo itself cannot be imported with a back end that is not there
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    model.vis.global_.offwidth = model.vis.global_.offheight = PROBED_SIZE_PX
    context, _ = open_draw_context(model)
    from OpenGL import GL  # only now: it settles on a back end when it is imported

    vendor, renderer = (GL.glGetString(key).decode() for key in (GL.GL_VENDOR, GL.GL_RENDERER))
    context.free()
    return {"vendor": vendor, "renderer": renderer}


def _try_warp() -> Answer:
    import mujoco.mjx.third_party.mujoco_warp  # noqa: F401
    import warp

    warp.init()
    return {"cuda": [device.name for device in warp.get_cuda_devices()]}


def _reason(message: str) -> str:
    """Why a back end cannot be opened, without what ``gl_context`` says to mend it: a finding has its remedy apart."""
    inner = re.fullmatch(r"OpenGL cannot be opened \(\w+: (.*?)(\): .*)?", message)
    return inner.group(1) if inner else message


def main(name: str) -> None:
    """Tries one thing and prints the answer as a line of JSON."""
    try:
        answer = _try_warp() if name == "warp" else _try_opengl(name)
    except Exception as error:  # each library has errors of its own
        answer = {"error": _reason(one_line(error))}
    print(json.dumps(answer), flush=True)
    os._exit(0)  # some drivers crash in their exit handlers


if __name__ == "__main__":
    main(sys.argv[1])
