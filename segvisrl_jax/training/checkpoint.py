"""What a run leaves on disk: checkpoints to go on from (orbax), and policies to drive with (JSON and NumPy arrays).

A checkpoint holds everything: parameters, optimizer, environments, memory, keys, counters. A policy folder holds
``policy.json`` (configuration, scores) and ``params.npz``; loading either runs no code from the file.
"""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from segvisrl_jax.assets import asset_dir
from segvisrl_jax.config import ConfigError, TrainConfig, from_dict, to_dict

CHECKPOINTS_KEPT = 2
POLICY_FORMAT = 1


class Checkpoints:
    """The checkpoints of one run, by number of updates; the last ones are kept. Writing is atomic (orbax)."""

    def __init__(self, run_dir: Path):
        options = ocp.CheckpointManagerOptions(max_to_keep=CHECKPOINTS_KEPT, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager((run_dir / "checkpoints").resolve(), options=options)

    @property
    def latest(self) -> int | None:
        """Number of updates behind the newest checkpoint, or None."""
        return self._manager.latest_step()

    def save(self, updates: int, state: Any, host: dict[str, Any]) -> None:
        """Writes a pytree of arrays and keys, and JSON data that lives on the host."""
        if updates == self.latest:
            return
        args = ocp.args.Composite(state=ocp.args.StandardSave(_stored(state)), host=ocp.args.JsonSave(host))
        self._manager.save(updates, args=args)

    def restore_latest(self, like: Any) -> tuple[Any, dict[str, Any]]:
        """Reads the newest checkpoint; see ``restore``.

        Raises:
            ConfigError: where there is none, or it does not fit.
        """
        if self.latest is None:
            raise ConfigError(f"{self._manager.directory}: holds no checkpoint; leave --resume out and start again")
        return self.restore(self.latest, like)

    def restore(self, updates: int, like: Any) -> tuple[Any, dict[str, Any]]:
        """Reads a checkpoint into the structure, shapes and dtypes of ``like``.

        Raises:
            ConfigError: where the checkpoint does not fit, as one of another architecture does not.
        """
        target = jax.tree.map(ocp.utils.to_shape_dtype_struct, _stored(like))
        args = ocp.args.Composite(state=ocp.args.StandardRestore(target), host=ocp.args.JsonRestore())
        try:
            found = self._manager.restore(updates, args=args)
        except (ValueError, KeyError, TypeError, FileNotFoundError) as error:
            reason = " ".join(str(error).split())[:200]
            raise ConfigError(
                f"checkpoint {self._manager.directory}/{updates} does not fit these settings: {reason}"
            ) from None
        return _restored(found["state"], like), found["host"]

    def close(self) -> None:
        """Waits for writes and lets go of the folder."""
        self._manager.close()


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _stored(tree: Any) -> Any:
    """What is written: keys as numbers, dataclasses as dicts of those fields that hold anything.

    So a field that the settings leave empty leaves no trace, and runs from before there was such a field go on.
    """
    if dataclasses.is_dataclass(tree):
        fields = {f.name: getattr(tree, f.name) for f in dataclasses.fields(tree)}
        return {name: _stored(value) for name, value in fields.items() if not _is_left_out(value)}
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, tree)


def _is_left_out(value: Any) -> bool:
    """Whether it holds nothing: orbax refuses arrays without elements, as the rocks of a map without rocks are."""
    return (
        value is None
        or (dataclasses.is_dataclass(value) and not jax.tree.leaves(value))
        or (isinstance(value, jax.Array) and value.size == 0)
    )


def _restored(stored: Any, like: Any) -> Any:
    """The inverse of ``_stored``."""
    if dataclasses.is_dataclass(like):
        fields = {name: _restored(value, getattr(like, name)) for name, value in stored.items()}
        return dataclasses.replace(like, **fields)  # type: ignore[type-var]

    def restore(array: Any, leaf: Any) -> Any:
        return jax.random.wrap_key_data(array) if _is_key(leaf) else array

    return jax.tree.map(restore, stored, like)


def _without_folders(config: TrainConfig) -> TrainConfig:
    """The settings without the folders of the machine that trained; a policy to start from keeps its run's name."""
    source = Path(config.start_from)
    name = source.parent.name if source.name == "policy" else source.name
    return dataclasses.replace(config, runs_dir=TrainConfig.runs_dir, start_from=name)


def save_policy(folder: Path, config: TrainConfig, params: Any, scores: dict[str, Any]) -> None:
    """Writes a policy folder; an older one of the same name is replaced file by file, each in one move."""
    folder.mkdir(parents=True, exist_ok=True)
    flat = {"/".join(path): np.asarray(leaf) for path, leaf in _leaves(jax.device_get(params))}
    _replace(folder / "params.npz", lambda file: np.savez(file, **flat))  # type: ignore[arg-type]
    card = {"format": POLICY_FORMAT, "config": to_dict(_without_folders(config)), "scores": scores}
    text = json.dumps(card, indent=2) + "\n"
    _replace(folder / "policy.json", lambda file: file.write(text.encode()))


def load_policy(folder: Path) -> tuple[TrainConfig, Any, dict[str, Any]]:
    """Reads a policy folder, or a shipped policy by its name (``pretrained/cnn_lstm`` or ``cnn_lstm``).

    Returns:
        The configuration it was trained with, its parameters (nested dicts of NumPy arrays), its scores.

    Raises:
        ConfigError: where it is missing or damaged; the message names the file.
    """
    folder = _find_policy(Path(folder))
    card_file, params_file = folder / "policy.json", folder / "params.npz"
    try:
        card = json.loads(card_file.read_text())
        config, scores = from_dict(TrainConfig, card["config"]), card["scores"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{card_file}: not a policy's card ({error})") from None
    try:
        with np.load(params_file, allow_pickle=False) as arrays:
            params = _nest({name: arrays[name] for name in arrays.files})
    except Exception as error:  # a damaged zip raises many kinds; all mean the same to the user
        raise ConfigError(f"{params_file}: cannot be read ({error})") from None
    return config, params, scores


def _find_policy(folder: Path) -> Path:
    if (folder / "policy.json").is_file():
        return folder
    shipped = asset_dir("pretrained") / folder.name
    is_bare_name = len(folder.parts) == 1 or folder.parts[:-1] == ("pretrained",)
    if is_bare_name and (shipped / "policy.json").is_file():
        return shipped
    known = sorted(p.parent.name for p in asset_dir("pretrained").glob("*/policy.json"))
    raise ConfigError(f"policy = {str(folder)!r}: should be a folder with policy.json, or one of {known}")


def _leaves(params: dict[str, Any], path: tuple[str, ...] = ()):
    for name, value in params.items():
        if isinstance(value, dict):
            yield from _leaves(value, (*path, name))
        else:
            yield (*path, name), value


def _nest(flat: dict[str, np.ndarray]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for name, array in flat.items():
        *path, last = name.split("/")
        here = nested
        for part in path:
            here = here.setdefault(part, {})
        here[last] = array
    return nested


def _replace(path: Path, write) -> None:
    """Writes beside the file, then moves over it, so that no half-written file is ever read."""
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
