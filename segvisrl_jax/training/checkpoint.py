"""What a run leaves on disk: checkpoints to go on from (orbax), and policies to drive with (JSON and NumPy arrays).

A checkpoint holds everything: parameters, optimizer, environments, memory, keys, counters. A policy folder holds
``policy.json`` (configuration, scores) and the file of parameters that it names. Both carry checksums, and what does
not agree with them is not read; loading runs no code from a file.
"""

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from segvisrl_jax.assets import asset_dir
from segvisrl_jax.config import ConfigError, TrainConfig, from_dict, read_json, run_folder, to_dict
from segvisrl_jax.cpu import make_callbacks_safe
from segvisrl_jax.training.manifest import (
    MANIFEST,
    library_versions,
    read_manifest,
    replace_file,
    require_sha256,
    sha256_of,
    sha256_of_json,
    write_manifest,
)
from segvisrl_jax.training.processes import Processes

CHECKPOINTS_KEPT = 2
POLICY_TRIES = 5  # to read a policy that is being replaced by a better one
POLICY_FORMAT = FIRST_WITH_CHECKSUMS = 2  # before: the parameters in params.npz
SETTINGS_FILE = "config.json"  # of the run
MARK = "has_checkpoints"
DAMAGED_FOLDER = "damaged"  # where checkpoints go that cannot be read
UNFINISHED, FOREIGN = "was not finished", "was made with other settings than the run has"


class Checkpoints:
    """The checkpoints of one run, by number of updates; the last ones are kept. Writing is atomic.

    Opening looks at what is there: what was not finished is removed, what is damaged is set aside, and ``say`` is told.

    Raises:
        ConfigError: where checkpoints are there and none is whole, one is of a newer version, or all belong to other
            settings than the run's. They stay where they are.
    """

    def __init__(self, run_dir: Path, processes: Processes | None = None, say: Callable[[str], None] = print):
        self._run_dir, self._processes, self._say = Path(run_dir), processes or Processes(), say
        self._folder = (self._run_dir / "checkpoints").resolve()
        self._processes.on_first(self._keep_whole_ones)
        self._manager = self._open()

    def _open(self) -> ocp.CheckpointManager:
        options = ocp.CheckpointManagerOptions(max_to_keep=CHECKPOINTS_KEPT, enable_async_checkpointing=False)
        return ocp.CheckpointManager(self._folder, options=options)

    @property
    def latest(self) -> int | None:
        """Number of updates behind the newest checkpoint, or None."""
        return self._manager.latest_step()

    def save(self, updates: int, state: Any, host: dict[str, Any]) -> None:
        """Writes a pytree of arrays and keys, and JSON data that lives on the host; nothing where it has a later one.

        Raises:
            Exception: of many kinds where the disk is full or the folder is gone; those from before are still there.
        """
        self._forget_removed_ones()
        if self.latest is not None and updates <= self.latest:
            return
        args = ocp.args.Composite(state=ocp.args.StandardSave(_stored(state)), host=ocp.args.JsonSave(host))
        try:
            self._manager.save(updates, args=args)
            if self._processes.is_first:
                about = {"updates": updates, "settings": self._settings(), "versions": library_versions()}
                write_manifest(self._folder / str(updates), about)
                self._mark()
        except Exception:
            if self._processes.count == 1:
                self._start_again(updates)
            raise

    def _forget_removed_ones(self) -> None:
        """Has the manager look again where somebody removed the newest: it counts what it has written itself."""
        if self._processes.count == 1 and self.latest and not (self._folder / str(self.latest)).exists():
            self._manager.close()
            self._manager = self._open()

    @property
    def are_lost(self) -> bool:
        """Whether there is none any more."""
        return self.latest is None and (self._run_dir / MARK).exists()

    def whole(self) -> set[int]:
        """Updates behind those that are as they were written."""
        return {step for step in self._manager.all_steps() if self._complaint(self._folder / str(step)) is None}

    def go_back_to(self, updates: int) -> None:
        """Removes later ones; with 0, all, as if none had been written.

        Raises:
            OSError: where one cannot be removed.
        """
        later = sorted((step for step in self._manager.all_steps() if step > updates), reverse=True)
        self._manager.close()
        if updates == 0:
            (self._run_dir / MARK).unlink(missing_ok=True)
        for step in later:
            shutil.rmtree(self._folder / str(step))
        self._manager = self._open()

    def _mark(self) -> None:
        mark = self._run_dir / MARK
        with contextlib.suppress(OSError):  # the checkpoint is written, and worth more
            if not mark.exists():
                mark.write_text("The run has checkpoints: without any, it does not begin again.\n")

    def _start_again(self, updates: int) -> None:
        """Drops what a failed write left, and the manager, which counts it as written."""
        with contextlib.suppress(Exception):
            self._manager.close()
        for left in self._folder.glob(f"{updates}*"):
            shutil.rmtree(left, ignore_errors=True)
        with contextlib.suppress(Exception):  # the folder may be gone for good: the next write says so
            self._manager = self._open()

    def restore_latest(self, like: Any) -> tuple[Any, dict[str, Any]]:
        """Reads the newest checkpoint; see ``restore``.

        Raises:
            ConfigError: where there is none, or it does not fit.
        """
        if self.latest is None:
            raise ConfigError(f"{self._folder}: holds no checkpoint; leave --resume out and start again")
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
        except Exception as error:  # a file without a checksum may fail to be read in any way
            reason = " ".join(str(error).split())[:200]
            raise ConfigError(f"checkpoint {self._folder}/{updates} does not fit these settings: {reason}") from None
        return _restored(found["state"], like), found["host"]

    def close(self) -> None:
        """Waits for writes and lets go of the folder."""
        self._manager.close()

    def _settings(self) -> str | None:
        """The checksum of the run's settings; None where they are not in a file."""
        path = self._run_dir / SETTINGS_FILE
        return sha256_of(path) if path.is_file() else None

    def _keep_whole_ones(self) -> None:
        """Leaves the newest whole checkpoint as the newest one."""
        found = sorted(
            (path for path in self._folder.glob("*") if path.name.isdecimal()), key=lambda path: -int(path.name)
        )
        if found and not any((path / MANIFEST).exists() for path in found):
            self._say(f"{self._folder}: the checkpoints have no checksums, as those of earlier versions")
            return
        complaints = {path: self._complaint(path) for path in found}
        if complaints and all(complaint == FOREIGN for complaint in complaints.values()):
            raise ConfigError(
                f"{self._run_dir / SETTINGS_FILE}: is not what its checkpoints were made with: changed, or damaged"
            )
        if complaints and None not in complaints.values():  # nothing is moved: it may be needed, or mended
            told = "; ".join(f"update {path.name}: {complaint}" for path, complaint in complaints.items())
            raise ConfigError(f"no whole checkpoint is left: {told}")
        for path, complaint in complaints.items():
            if complaint is None:
                self._tell_versions(path)
                break
            self._remove(path, complaint)

    def _tell_versions(self, path: Path) -> None:
        """Says what has changed since a checkpoint was made, which may change what comes of it."""
        then, now = read_json(path / MANIFEST)["about"].get("versions") or {}, library_versions()
        changed = [f"{name} {then[name]}, now {now.get(name)}" for name in then if then[name] != now.get(name)]
        if changed:
            self._say(f"the checkpoint of update {path.name} was made with {'; '.join(changed)}: results may differ")

    def _complaint(self, path: Path) -> str | None:
        """What keeps a checkpoint from being used.

        Raises:
            ConfigError: where a newer version wrote it.
        """
        if not (path / MANIFEST).exists():
            return UNFINISHED
        try:
            about = read_manifest(path)
        except ConfigError:
            raise
        except ValueError as error:
            return str(error)
        return None if about.get("settings") == self._settings() else FOREIGN

    def _remove(self, path: Path, complaint: str) -> None:
        if complaint == UNFINISHED:
            shutil.rmtree(path)
            self._say(f"the checkpoint of update {path.name} was not finished; it is gone")
            return
        aside = self._run_dir / DAMAGED_FOLDER / path.name
        shutil.rmtree(aside, ignore_errors=True)
        aside.parent.mkdir(exist_ok=True)
        shutil.move(path, aside)  # to another file system, where checkpoints/ is a link there
        self._say(f"warning: the checkpoint of update {path.name} is not used ({complaint}); it is in {aside} now")


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
    """Writes a policy folder, or a newer policy in place of the one there: whenever it ends, one of them is whole."""
    folder.mkdir(parents=True, exist_ok=True)
    flat = {"/".join(path): np.asarray(leaf) for path, leaf in _leaves(jax.device_get(params))}
    partial = folder / "params.npz"
    replace_file(partial, lambda file: np.savez(file, **flat))  # type: ignore[arg-type]
    digest = sha256_of(partial)
    params_file = partial.rename(folder / f"params-{digest[:8]}.npz")
    card = {
        "format": POLICY_FORMAT,
        "params": {"file": params_file.name, "sha256": digest},
        "versions": library_versions(),
        "config": to_dict(_without_folders(config)),
        "scores": scores,
    }
    text = json.dumps(card | {"sha256": sha256_of_json(card)}, indent=2) + "\n"
    replace_file(folder / "policy.json", lambda file: file.write(text.encode()))
    for older in folder.glob("params*.npz"):
        if older != params_file:
            older.unlink()


def load_policy(folder: Path) -> tuple[TrainConfig, Any, dict[str, Any]]:
    """Reads a policy folder, or a shipped policy by its name (``pretrained/cnn_lstm`` or ``cnn_lstm``).

    Returns:
        The configuration it was trained with, its parameters (nested dicts of NumPy arrays), its scores.

    Raises:
        ConfigError: where it is missing or damaged; the message names the file.
    """
    make_callbacks_safe()  # for whoever builds an environment afterwards
    folder = _find_policy(Path(folder))
    card = folder / "policy.json"
    for tries_left in reversed(range(POLICY_TRIES)):
        before = _stamp(card)
        try:
            return _read_policy(card)
        except ConfigError:
            if not tries_left or _stamp(card) == before:  # else a training has just put a better one there
                raise
    raise AssertionError("the last try returns or raises")


def _stamp(file: Path) -> tuple[int, int] | None:
    """Another one whenever a file has been replaced."""
    try:
        stat = file.stat()
    except OSError:
        return None
    return stat.st_ino, stat.st_mtime_ns


def _read_policy(card: Path) -> tuple[TrainConfig, Any, dict[str, Any]]:
    """See ``load_policy``."""
    config, scores, params_file = _read_card(card)
    try:
        with np.load(params_file, allow_pickle=False) as arrays:
            params = _nest({name: arrays[name] for name in arrays.files})
    except Exception as error:  # a damaged zip raises many kinds; all mean the same to the user
        raise ConfigError(f"{params_file}: cannot be read ({error})") from None
    return config, params, scores


def _read_card(path: Path) -> tuple[TrainConfig, dict[str, Any], Path]:
    """(settings, scores, the file of the parameters) of a policy; what has checksums agrees with them."""
    try:
        card = read_json(path)
        version, checksum = int(card["format"]), card.pop("sha256", None)
        if version <= POLICY_FORMAT and (version < FIRST_WITH_CHECKSUMS or checksum == sha256_of_json(card)):
            config, scores = from_dict(TrainConfig, card["config"]), card["scores"]
            params = card["params"] if version >= FIRST_WITH_CHECKSUMS else {"file": "params.npz"}
            params_file = path.parent / Path(params["file"]).name
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError) as error:
        raise ConfigError(f"{path}: not a policy's card ({error})") from None
    if version > POLICY_FORMAT:
        raise ConfigError(f"{path}: was written by a newer version of segvisrl_jax (format {version})")
    if version >= FIRST_WITH_CHECKSUMS:
        if checksum != sha256_of_json(card):
            raise ConfigError(f"{path}: is damaged, or was edited (its checksum is another)")
        try:
            require_sha256(params_file, params["sha256"])
        except ValueError as error:
            raise ConfigError(str(error)) from None
    return config, scores, params_file


def _find_policy(folder: Path) -> Path:
    if (folder / "policy.json").is_file():
        return folder
    shipped = asset_dir("pretrained") / folder.name
    is_bare_name = len(folder.parts) == 1 or folder.parts[:-1] == ("pretrained",)
    if is_bare_name and (shipped / "policy.json").is_file():
        return shipped
    known = ", ".join(sorted(p.parent.name for p in asset_dir("pretrained").glob("*/policy.json")))
    inside = run_folder(folder) / "policy"
    hint = f"; this is a run, and {inside} its policy" if (inside / "policy.json").is_file() else ""
    raise ConfigError(f"policy = {str(folder)!r}: should be a folder with policy.json, or one of {known}{hint}")


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
