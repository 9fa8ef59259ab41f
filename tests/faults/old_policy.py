"""A shipped policy in the first format, which has no checksums: what is wrong with it is found by what reads it."""

import json
import shutil
from pathlib import Path

from segvisrl_jax.assets import asset_dir


def copy_in_first_format(name: str, folder: Path) -> Path:
    """Writes policy.json and params.npz to a new folder, and returns it."""
    shipped = asset_dir("pretrained") / name
    card = json.loads((shipped / "policy.json").read_text())
    folder.mkdir(parents=True)
    shutil.copy(shipped / card["params"]["file"], folder / "params.npz")
    (folder / "policy.json").write_text(json.dumps({"format": 1, "config": card["config"], "scores": card["scores"]}))
    return folder
