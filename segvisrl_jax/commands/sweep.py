"""``segvisrl sweep``: one training for each combination of scale, architecture and seed; a table and a plot."""

import csv
import itertools
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from segvisrl_jax.cli import parse
from segvisrl_jax.config import Arch, PresetName, preset_config, replace_fields, require

COLUMNS = (
    "arch",
    "scale",
    "seed",
    "status",
    "success",
    "success_low",
    "success_high",
    "collision",
    "timeout",
    "spl",
    "decisions_per_second",
)
FAILURE = 1


@dataclass(frozen=True)
class SweepOptions:
    """Trains every combination in a process of its own; finished ones are not run again, failed ones are reported."""

    scales: tuple[float, ...] = (20.0, 40.0, 60.0)
    archs: tuple[Arch, ...] = ("cnn_lstm",)
    seeds: tuple[int, ...] = (0,)
    preset: PresetName = "cpu"
    steps: int | None = None
    """Training decisions of each run; default: the preset's."""
    output: Path = Path("runs/sweep")
    """Folder of the runs, results.csv and success_by_scale.png."""
    args: str = ""
    """More options of ``segvisrl train`` for every run, in one string."""

    def __post_init__(self) -> None:
        for name in ("scales", "archs", "seeds"):
            require(len(getattr(self, name)) > 0, f"--{name}", getattr(self, name), "at least one value")
        for arch, scale in itertools.product(self.archs, self.scales):
            replace_fields(preset_config(arch, self.preset), scale=scale)


def run(options: Sequence[str]) -> int:
    """Parses, trains one after another, writes table and plot."""
    asked = parse(SweepOptions, options, "sweep")
    asked.output.mkdir(parents=True, exist_ok=True)
    combinations = list(itertools.product(asked.archs, asked.scales, asked.seeds))
    rows = []
    for number, (arch, scale, seed) in enumerate(combinations, start=1):
        print(f"[{number}/{len(combinations)}] {arch}, scale {scale:g}, seed {seed}", flush=True)
        rows.append(_train_one(asked, arch, scale, seed))
        _write_table(asked.output / "results.csv", rows)
    return _report(asked, rows)


def _train_one(asked: SweepOptions, arch: str, scale: float, seed: int) -> dict[str, Any]:
    name = f"{arch}-scale{scale:g}-seed{seed}"
    run_dir = asked.output / name
    row: dict[str, Any] = {"arch": arch, "scale": scale, "seed": seed}
    if not (run_dir / "eval.json").is_file():
        words = [sys.executable, "-m", "segvisrl_jax.cli", "train", "--run", name, "--runs-dir", str(asked.output)]
        if (run_dir / "config.json").is_file():
            words.append("--resume")
        else:
            words += ["--arch", arch, "--preset", asked.preset, "--seed", str(seed), "--env.camera.scale", str(scale)]
            words += ["--steps", str(asked.steps)] if asked.steps else []
            words += asked.args.split()
        with (asked.output / f"{name}.log").open("a") as log:
            code = subprocess.run(words, stdout=log, stderr=subprocess.STDOUT, check=False).returncode
        if code < 0 or code == 130:
            raise KeyboardInterrupt
        if code:
            return {**row, "status": f"failed ({code})"}
    return {**row, "status": "done", **_scores(run_dir)}


def _scores(run_dir: Path) -> dict[str, Any]:
    from segvisrl_jax.training.metrics import read_metrics

    result = json.loads((run_dir / "eval.json").read_text())
    low, high = result["success_ci95"]
    last = read_metrics(run_dir)[-1]
    decisions, seconds = last["step"], last["time/seconds"]
    kept = {name: result[name] for name in ("success", "collision", "timeout", "spl")}
    return {**kept, "success_low": low, "success_high": high, "decisions_per_second": decisions / seconds}


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def _report(asked: SweepOptions, rows: list[dict[str, Any]]) -> int:
    from segvisrl_jax.report.figures import success_by_scale

    done = [row for row in rows if row["status"] == "done"]
    for row in rows:
        score = f"success {100 * row['success']:.1f} %" if row["status"] == "done" else row["status"]
        print(f"  {row['arch']:<13} scale {row['scale']:>5g}  seed {row['seed']}  {score}")
    if done:
        success_by_scale(done, asked.output / "success_by_scale.png")
    print(f"  {asked.output / 'results.csv'}")
    failed = len(rows) - len(done)
    if failed:
        print(f"{failed} of {len(rows)} runs failed; their logs are in {asked.output}", file=sys.stderr)
    return FAILURE if failed else 0
