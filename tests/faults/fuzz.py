"""Files that a user may edit or that a crash may damage, thrown at everything that reads them.

Whatever the input, a loader gives a result or raises ``ConfigError``. ``test_fuzz.py`` tries a few of each; as a
program this file tries many, and prints how many of each were read, refused, and answered with another exception:

    python tests/faults/fuzz.py --examples 100000
"""

import argparse
import contextlib
import copy
import dataclasses
import functools
import io
import json
import os
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from old_policy import copy_in_first_format

from segvisrl_jax.commands import runs as runs_command
from segvisrl_jax.commands.table import read_evaluation, sections_of
from segvisrl_jax.commands.train import _stored_config
from segvisrl_jax.config import RUN_TEST_SEED, ConfigError, EnvConfig, TrainConfig, from_dict, preset_config, to_dict
from segvisrl_jax.report.figures import _read_run, _run_title
from segvisrl_jax.report.learning_curves import band_of, methods_of, read_curves
from segvisrl_jax.report.run_list import list_runs
from segvisrl_jax.report.table import results_table
from segvisrl_jax.sweep.plan import Trial, _check_same_settings
from segvisrl_jax.sweep.results import in_words, result_row
from segvisrl_jax.training.checkpoint import load_policy
from segvisrl_jax.training.statistics import wilson_interval

ROOT = Path(__file__).parents[2]
CONFIG = preset_config("mlp", "smoke")
TRIAL = Trial("trial", {"seed": "0"}, ())
FORTY_DIGITS, TOO_DEEP = 10**40, 3000
SHOWN = 3  # tracebacks for each loader


# What is thrown

NASTY = st.sampled_from(
    [None, True, -1, 0, 1, 2**31, 2**63, FORTY_DIGITS, 10**400, 1e30, -1e30, 1e-320, float("nan"), float("inf"), "",
     "x", "nan", "\0", "\n", "\ud800", "é", "/", "..", "x" * 300, [], [[]], {}, {"": 0}]
)  # fmt: skip
LEAVES = NASTY | st.integers() | st.floats() | st.text(max_size=20) | st.booleans()
ANYTHING = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def places_in(data: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in JSON data: the keys and indices that lead there."""
    inside = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [at, *(place for name, value in inside for place in places_in(value, (*at, name)))]


@st.composite
def damaged_data(draw, sound: Any) -> Any:
    """Sound data in which up to three places hold something else, or nothing."""
    data = copy.deepcopy(sound)
    for place in draw(st.lists(st.sampled_from(places_in(sound)), min_size=1, max_size=3)):
        if not place:
            data = draw(ANYTHING) if draw(st.integers(0, 9)) == 0 else data
            continue
        with contextlib.suppress(KeyError, IndexError, TypeError):  # an earlier damage took it away
            whole = functools.reduce(lambda part, name: part[name], place[:-1], data)
            how = draw(st.integers(0, 5))
            if how == 0:
                del whole[place[-1]]
            elif how == 1 and isinstance(whole, dict):
                whole[draw(st.text(max_size=8))] = draw(LEAVES)
            else:
                whole[place[-1]] = draw(ANYTHING if how == 2 else LEAVES)
    return data


@st.composite
def damaged_bytes(draw, sound: bytes) -> bytes:
    """Sound bytes that are cut off, or in which some are others, gone, or new."""
    data = bytearray(sound)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        how = draw(st.sampled_from(["cut", "set", "drop", "insert"]))
        if how == "cut":
            del data[at:]
        elif how == "set" and data:
            data[at] = draw(st.integers(0, 255))
        elif how == "drop":
            del data[at : at + draw(st.integers(1, 40))]
        else:
            data[at:at] = draw(st.binary(max_size=20))
    return bytes(data)


def as_json(data: Any) -> bytes:
    """As Python writes it: NaN and Infinity too."""
    return json.dumps(data).encode()


def json_files(sound: Any) -> st.SearchStrategy[bytes]:
    """Files that should hold JSON: other settings, other data, other bytes, or far too deep."""
    deep = st.sampled_from(
        [b"[" * TOO_DEEP + b"]" * TOO_DEEP, b'{"a":' * TOO_DEEP + b"1" + b"}" * TOO_DEEP, b"[" * 99999]
    )
    others = ANYTHING.map(as_json) | damaged_bytes(as_json(sound)) | st.binary(max_size=60) | deep
    return st.one_of(damaged_data(sound).map(as_json), damaged_data(sound).map(as_json), others)


def line_files(sound: list[Any]) -> st.SearchStrategy[bytes]:
    """Files that should hold a JSON object in every line."""
    lines = damaged_data(sound).map(
        lambda rows: b"\n".join(map(as_json, rows if isinstance(rows, list) else [rows])) + b"\n"
    )
    whole = b"".join(as_json(row) + b"\n" for row in sound)
    return lines | damaged_bytes(whole) | st.binary(max_size=60)


# What is sound

OUTCOMES = ["success", "success", "collision", "timeout"]
ROWS = [
    {"step": 128 * n, "episode/return": -1.5, "evaluation/success": 0.5, "evaluation/success_low": 0.4,
     "evaluation/success_high": 0.6, "evaluation/collision": None, "time/seconds": 2.0 * n,
     "time/decisions_per_second": 64.0}
    for n in (1, 2, 3)
]  # fmt: skip
CURVES = (
    b"arch,recipe,run,seed,decisions,return,success\nmlp,ab,m,0,100,-3.5,0.5\nmlp,ab,m,0,200,-2,\nmlp,ab,n,1,100,1,\n"
)


def evaluation() -> dict[str, Any]:
    """What ``segvisrl eval --json`` writes, of four episodes."""
    count = len(OUTCOMES)
    shares = {kind: OUTCOMES.count(kind) / count for kind in ("success", "collision", "fall", "timeout", "unstable")}
    intervals = {
        f"{kind}_ci95": list(wilson_interval(OUTCOMES.count(kind), count)) for kind in shares if kind != "unstable"
    }
    numbers = [1.0, 2.0, None, 4.0]
    lists = ("num_decisions", "path_length_m", "shortest_path_m", "min_clearance_m", "goal_bearing_deg")
    return {
        "method": "mlp", "source": "runs/a", "episodes": count, **shares, **intervals, "spl": 0.5, "path_ratio": 1.1,
        "mean_time_s": 60.0, "min_clearance_m": 0.7, "seed": 0, "training_seed": 0,
        "training_config": {"steps": 512, "preset": "smoke", "arch": "mlp", "env": {"obs": "state"}},
        "policy_sha256": "00", "command": "segvisrl eval", "wall_clock_s": 1.5, "versions": {"jax": "0.10"},
        "device": "cpu", "physics_engine": "native", "renderer": None,
        "config": to_dict(CONFIG.env),
        "per_episode": {"outcome": OUTCOMES, **dict.fromkeys(lists, numbers)},
    }  # fmt: skip


# What reads it: each is given the content of one file, and a folder

Load = Callable[[Any, Path], Any]


def _written(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def load_settings(data: Any, _: Path) -> Any:
    return from_dict(TrainConfig, data), from_dict(
        EnvConfig, data["env"] if isinstance(data, dict) and "env" in data else {}
    )


def load_stored_settings(content: bytes, folder: Path) -> Any:
    _written(folder, "run/config.json", content)
    return _stored_config(str(folder), "run")


def load_sweeps_settings(content: bytes, folder: Path) -> None:
    _check_same_settings(CONFIG, _written(folder, "run/config.json", content))


def load_card(content: bytes, folder: Path) -> Any:
    _sound_policy(folder)
    _written(folder, "policy/policy.json", content)
    return load_policy(folder / "policy")


def load_arrays(content: bytes, folder: Path) -> Any:
    _sound_policy(folder)
    _written(folder, "policy/params.npz", content)
    return load_policy(folder / "policy")


def _sound_policy(folder: Path) -> None:
    if not (folder / "policy").is_dir():
        copy_in_first_format("mlp", folder / "policy")


def load_evaluation(content: bytes, folder: Path) -> str:
    page = results_table(sections_of([read_evaluation(_written(folder, "e.json", content))]))
    page.encode()  # as printing does
    return page


def _list_runs(folder: Path) -> str:
    """The table and the JSON, as they are printed."""
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with contextlib.redirect_stdout(out):
        runs, complaints = list_runs(folder)
        runs_command._print_table(folder, runs, complaints)
        assert runs_command.run([str(folder), "--json"]) == 0
    if complaints:  # what is damaged is named, and the others are listed
        raise ConfigError(complaints[0].reason)
    return str(runs)


def _sound_run(folder: Path, **damaged: bytes) -> Path:
    sound = {
        "config.json": as_json(to_dict(CONFIG)),
        "metrics.jsonl": b"".join(as_json(row) + b"\n" for row in ROWS),
        "eval.json": as_json(evaluation()),
    }
    for name, content in sound.items():
        _written(folder, f"runs/a/{name}", damaged.get(name.partition(".")[0], content))
    return folder / "runs"


def list_with_settings(content: bytes, folder: Path) -> str:
    return _list_runs(_sound_run(folder, config=content))


def list_with_metrics(content: bytes, folder: Path) -> str:
    return _list_runs(_sound_run(folder, metrics=content))


def list_with_test(content: bytes, folder: Path) -> str:
    return _list_runs(_sound_run(folder, eval=content))


def curves_of_metrics(content: bytes, folder: Path) -> Any:
    return _bands(_sound_run(folder, metrics=content) / "a"), _run_title([_read_run(folder / "runs" / "a")])


def curves_of_settings(content: bytes, folder: Path) -> Any:
    return _bands(_sound_run(folder, config=content) / "a")


def curves_of_csv(content: bytes, folder: Path) -> Any:
    return _bands(_written(folder, "curves.csv", content))


def _bands(source: Path) -> Any:
    methods = methods_of(read_curves([source]))
    return {name: band_of([curve.returns for curve in curves]) for name, curves in methods.items()}


def sweeps_result(content: bytes, folder: Path) -> str:
    row = result_row(TRIAL, _sound_run(folder, eval=content) / "a", "done", "")
    return in_words(TRIAL, row)


def sweeps_metrics(content: bytes, folder: Path) -> str:
    row = result_row(TRIAL, _sound_run(folder, metrics=content) / "a", "done", "")
    return in_words(TRIAL, row)


SETTINGS = to_dict(CONFIG)
with tempfile.TemporaryDirectory() as _folder:
    _policy = copy_in_first_format("mlp", Path(_folder) / "policy")
    CARD = json.loads((_policy / "policy.json").read_text())
    ARRAYS = (_policy / "params.npz").read_bytes()
LOADERS: dict[str, tuple[Load, st.SearchStrategy[Any]]] = {
    "from_dict(TrainConfig)": (load_settings, st.one_of(damaged_data(SETTINGS), damaged_data(SETTINGS), ANYTHING)),
    "train --resume: config.json": (load_stored_settings, json_files(SETTINGS)),
    "sweep: config.json": (load_sweeps_settings, json_files(SETTINGS)),
    "load_policy: policy.json": (load_card, json_files(CARD)),
    "load_policy: params.npz": (load_arrays, damaged_bytes(ARRAYS) | st.binary(max_size=60)),
    "table: evaluation": (load_evaluation, json_files(evaluation())),
    "runs: config.json": (list_with_settings, json_files(SETTINGS)),
    "runs: metrics.jsonl": (list_with_metrics, line_files(ROWS)),
    "runs: eval.json": (list_with_test, json_files(evaluation())),
    "learning curves: metrics.jsonl": (curves_of_metrics, line_files(ROWS)),
    "learning curves: config.json": (curves_of_settings, json_files(SETTINGS)),
    "learning curves: .csv": (curves_of_csv, damaged_bytes(CURVES) | st.binary(max_size=60)),
    "sweep: eval.json": (sweeps_result, json_files(evaluation() | {"seed": RUN_TEST_SEED})),
    "sweep: metrics.jsonl": (sweeps_metrics, line_files(ROWS)),
}


@dataclasses.dataclass
class Tally:
    """What became of the inputs of one loader."""

    tried: int = 0
    read: int = 0
    refused: int = 0
    uncaught: Counter[str] = dataclasses.field(default_factory=Counter)
    """By exception and the line that raised it."""
    examples: dict[str, tuple[Any, str]] = dataclasses.field(default_factory=dict)
    """For each, an input and its traceback."""
    seconds: float = 0.0

    def add(self, load: Load, content: Any, folder: Path) -> None:
        """Tries one."""
        self.tried += 1
        try:
            load(content, folder)
            self.read += 1
        except ConfigError:
            self.refused += 1
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            kind = f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}"
            self.uncaught[kind] += 1
            self.examples.setdefault(kind, (content, "".join(traceback.format_exception(error)[-6:])))


def fuzz(name: str, examples: int, start: int = 0) -> Tally:
    """Throws so many inputs at a loader; the same again for the same ``start``."""
    load, inputs = LOADERS[name]
    tally = Tally()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:

        @seed(start)
        @settings(
            max_examples=examples,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(inputs)
        def throw(content: Any) -> None:
            tally.add(load, content, Path(folder))

        throw()
    tally.seconds = time.monotonic() - began
    return tally


def main(words: list[str]) -> int:
    """Throws at all loaders, and prints the table. 1 where anything but ``ConfigError`` came back."""
    parser = argparse.ArgumentParser(description="Throws damaged files at every loader.")
    parser.add_argument("--examples", type=int, default=100_000, help="inputs in all, shared evenly")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="loaders whose name has this in it")
    asked = parser.parse_args(words)
    names = [name for name in LOADERS if asked.only in name]
    each = -(-asked.examples // len(names))
    print("| loader | inputs | read | refused | uncaught | s |\n|---|---|---|---|---|---|")
    tallies = {}
    for name in names:
        tally = tallies[name] = fuzz(name, each, asked.seed)
        numbers = (tally.tried, tally.read, tally.refused, tally.uncaught.total())
        print(f"| {name} | {' | '.join(f'{number:,}' for number in numbers)} | {tally.seconds:.0f} |", flush=True)
    uncaught = sum(tally.uncaught.total() for tally in tallies.values())
    print(f"| all | {sum(tally.tried for tally in tallies.values()):,} | | | {uncaught:,} | |")
    for name, tally in tallies.items():
        for kind, count in tally.uncaught.most_common(SHOWN):
            content, said = tally.examples[kind]
            print(f"\n{name}: {count} x {kind}\n  {ascii(content)[:400]}\n{said}")
    return 1 if uncaught else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
