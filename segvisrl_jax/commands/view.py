"""``segvisrl view``: a page in the browser in which a policy or a person drives, and rocks and goal can be dragged."""

import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated

import tyro

from segvisrl_jax.assets import DEFAULT_POLICY
from segvisrl_jax.cli import parse
from segvisrl_jax.commands.options import RunFolder
from segvisrl_jax.config import ConfigError, require


@dataclass(frozen=True)
class ViewOptions:
    """Opens a page in which a policy, or you, drive one scene, until Ctrl-C."""

    run: RunFolder | None = None
    """A run's folder, or its name in runs/: its best policy drives."""
    policy: Annotated[str | None, tyro.conf.arg(help_behavior_hint=f"(default: {DEFAULT_POLICY})")] = None
    """A policy's folder, or the name of a shipped one."""
    scene: int = 0
    """Number of the scene, as for `segvisrl demo`."""
    num_rocks: int | None = None
    """Rocks on the map; default: env.scene.num_rocks of the policy's settings."""
    port: int = 8080
    """Of the page; 0 takes any free one."""
    host: str = "127.0.0.1"
    """The address to listen on. Whoever can reach it can drive: 0.0.0.0 lets in the whole network."""

    def __post_init__(self) -> None:
        require(0 <= self.scene < 2**31, "--scene", self.scene, "in [0, 2^31)")
        require(bool(self.host.strip()), "--host", self.host, "an address of this machine; 0.0.0.0 is every one")
        require(0 <= self.port < 2**16, "--port", self.port, "in [0, 65535]")


def run(options: Sequence[str]) -> int:
    """Parses, opens the page, drives until Ctrl-C."""
    asked = parse(ViewOptions, options, "view")
    if find_spec("viser") is None:
        raise ConfigError('viser is not installed; pip install "segvisrl_jax[view]" installs it')
    require_free_port(asked.host, asked.port)
    viewer = open_viewer(asked)
    try:
        print(f"http://{asked.host}:{viewer.server.get_port()}  (Ctrl-C ends)", flush=True)
        viewer.run(threading.Event())
    except KeyboardInterrupt:
        print()
    finally:
        viewer.close()
    return 0


def open_viewer(asked: ViewOptions):
    """The viewer, its page open, not driving yet."""
    from segvisrl_jax.commands.eval import load_driver, with_overrides
    from segvisrl_jax.env.rover_env import RoverEnv
    from segvisrl_jax.view.session import Session
    from segvisrl_jax.view.viewer import Viewer

    named = asked.policy or (None if asked.run else DEFAULT_POLICY)
    policy, params, config = load_driver(asked.run, named, None)
    env = RoverEnv(with_overrides(config, asked.num_rocks, None, None))
    return Viewer(Session(env, policy, params, asked.scene), asked.host, asked.port)


def require_free_port(host: str, port: int) -> None:
    """viser would take the next free port without a word, and never return for an address that is not here.

    Raises:
        ConfigError: where nothing can listen there.
    """
    try:
        [(family, kind, _, _, address), *_] = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except PermissionError:
        raise ConfigError(f"--port = {port}: should be 1024 or more for this user") from None
    except (socket.gaierror, UnicodeError):
        raise ConfigError(f"--host = {host!r}: should be an address of this machine") from None
    except OSError as error:
        raise ConfigError(f"--host, --port = {host}:{port}: should be free ({error.strerror})") from None
