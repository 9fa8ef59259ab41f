"""How architectures learn: runs, thinned to a few hundred points, as a small CSV file and as a figure.

The CSV holds all that the figure is drawn from, so that it can be drawn again without the runs' folders.
"""

import csv
import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from segvisrl_jax.config import ConfigError, TrainConfig, from_dict, is_plain_text, read_json, require
from segvisrl_jax.report.figures import SHARP_DOTS_PER_INCH, clear_frame, save_figure
from segvisrl_jax.report.lines import BAND_ALPHA, LineEnd, method_colours, name_ends
from segvisrl_jax.report.recipe import recipe
from segvisrl_jax.training.metrics import METRICS_FILE, STEP_KEY
from segvisrl_jax.training.metrics_rows import MOST_DECISIONS, read_rows
from segvisrl_jax.training.output import write_output

POINTS = 200  # of a run's return at most: more than a figure can show
LOG_FROM = 4.0  # the longest run over the shortest, from which on decisions are on a logarithmic axis
RETURN_KEY, SUCCESS_KEY = "episode/return", "evaluation/success"
COLUMNS = ("arch", "recipe", "run", "seed", "decisions", "return", "success")


class Series(NamedTuple):
    """One number of a run over its training decisions, ascending, without gaps."""

    decisions: Float[np.ndarray, "K"]
    values: Float[np.ndarray, "K"]


@dataclass(frozen=True)
class Curve:
    """One run, thinned."""

    source: str  # where it was read
    arch: str
    recipe: str  # equal where runs differ only in their seed
    run: str
    seed: int
    returns: Series  # of training episodes
    success: Series  # on held-out scenes, in [0, 1]


@dataclass(frozen=True)
class Band:
    """Several runs of one method: the median, and the worst and the best at every place."""

    decisions: Float[np.ndarray, "K"]
    median: Float[np.ndarray, "K"]
    low: Float[np.ndarray, "K"]
    high: Float[np.ndarray, "K"]


def read_curves(sources: Sequence[Path]) -> list[Curve]:
    """Curves of runs' folders and of CSV files that ``write_curves`` wrote.

    Raises:
        ConfigError: where one cannot be read, holds no numbers, or has the method and the seed of another.
    """
    require(len(sources) > 0, "RUN", "none given", "at least one run's folder, or a .csv that this script wrote")
    curves: list[Curve] = []
    for source in sources:
        curves += _csv_curves(source) if source.suffix == ".csv" else [_run_curve(source)]
    seen: dict[Any, Curve] = {}
    for curve in curves:
        twin = seen.setdefault((curve.arch, curve.recipe, curve.seed), curve)
        if twin is not curve:
            raise ConfigError(
                f"{curve.source}: should be left out: {twin.source} holds {curve.arch} with seed {curve.seed} too"
            )
    return curves


def _run_curve(run_dir: Path) -> Curve:
    config_file = run_dir / "config.json"
    require(config_file.is_file(), "RUN", str(run_dir), f"a run's folder, with {config_file.name} and {METRICS_FILE}")
    try:
        config = from_dict(TrainConfig, read_json(config_file))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{config_file}: not a run's settings ({error})") from None
    try:
        rows = read_rows(run_dir)
    except ConfigError as error:
        raise ConfigError(f"{run_dir}: {error}") from None
    returns, success = _series(rows, RETURN_KEY), _series(rows, SUCCESS_KEY)
    require(len(returns.values) > 0, "RUN", str(run_dir), f"a run with episodes ({RETURN_KEY}) in {METRICS_FILE}")
    name = run_dir.resolve().name
    return Curve(str(run_dir), config.arch, _recipe(config), name, config.seed, _thinned(returns), success)


def _recipe(config: TrainConfig) -> str:
    """A digest of all settings that make the method."""
    return hashlib.sha256(json.dumps(recipe(config), sort_keys=True).encode()).hexdigest()[:8]


def _series(rows: Sequence[dict[str, Any]], key: str) -> Series:
    known = [(row[STEP_KEY], row[key]) for row in rows if isinstance(row.get(key), (int, float))]
    pairs = np.array([pair for pair in known if math.isfinite(pair[1])], float).reshape(-1, 2)
    return Series(pairs[:, 0], pairs[:, 1])


def _thinned(series: Series) -> Series:
    """Means over groups of neighbours, as few to a group as leave ``POINTS``."""
    group = -(-len(series.values) // POINTS)
    parts = np.arange(0, len(series.values), group)
    counts = np.diff([*parts, len(series.values)])
    return Series(*(np.add.reduceat(column, parts) / counts for column in series))


def write_curves(curves: Sequence[Curve], path_csv: Path) -> Path:
    """Writes ``COLUMNS``: a row for every place where a run has a number, the others' cells empty."""
    path_csv.parent.mkdir(parents=True, exist_ok=True)
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    writer.writerow(COLUMNS)
    for curve in curves:
        returns, success = (dict(zip(*series, strict=True)) for series in (curve.returns, curve.success))
        for decisions in sorted({*returns, *success}):
            numbers = [_cell(returns.get(decisions)), _cell(success.get(decisions))]
            cells = [curve.arch, curve.recipe, curve.run, curve.seed, f"{decisions:.0f}", *numbers]
            writer.writerow(cells)
    write_output(path_csv, written.getvalue())
    return path_csv


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _csv_curves(path: Path) -> list[Curve]:
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        runs: dict[tuple[str, str, str, int], list[dict[str, Any]]] = {}
        for row in rows:
            numbers = {name: float(row[name]) for name in ("return", "success") if row[name]}
            key = (row["arch"], row["recipe"], row["run"], int(row["seed"]))
            decisions = float(row["decisions"])
            require(0 <= decisions <= MOST_DECISIONS, "decisions", decisions, f"in [0, {MOST_DECISIONS:.0e}]")
            require(all(map(is_plain_text, key[:3])), "arch, recipe, run", key[:3], "text without control characters")
            runs.setdefault(key, []).append({STEP_KEY: decisions, **numbers})
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise ConfigError(f"{path}: should be a .csv with {', '.join(COLUMNS)} ({error})") from None
    require(len(runs) > 0, "RUN", str(path), "a .csv that holds at least one run")
    curves = [
        Curve(str(path), *key, _series(lines, "return"), _series(lines, "success")) for key, lines in runs.items()
    ]
    has_returns = all(len(curve.returns.values) > 0 for curve in curves)
    require(has_returns, "RUN", str(path), "a .csv with returns of every run")
    return curves


def methods_of(curves: Sequence[Curve]) -> dict[str, list[Curve]]:
    """Runs that differ only in their seed, together; by their architecture, with their own names if several have it."""
    groups: dict[tuple[str, str], list[Curve]] = {}
    for curve in curves:
        groups.setdefault((curve.arch, curve.recipe), []).append(curve)
    archs = [arch for arch, _ in groups]
    named = {}
    for (arch, _), group in groups.items():
        runs = ", ".join(curve.run for curve in group)
        named[arch if archs.count(arch) == 1 else f"{arch} ({runs})"] = group
    return named


def band_of(runs: Sequence[Series]) -> Band:
    """Median, worst and best of several runs, each read between its points on a straight line.

    Goes from where the last of them begins to where the first of them ends, so that every place has all runs.
    """
    begin, end = max(run.decisions[0] for run in runs), min(run.decisions[-1] for run in runs)
    places = np.unique(np.concatenate([run.decisions for run in runs]))
    places = places[(places >= begin) & (places <= end)]
    values = np.array([np.interp(places, *run) for run in runs])
    return Band(places, np.median(values, axis=0), values.min(axis=0), values.max(axis=0))


def draw_learning_curves(curves: Sequence[Curve], path_png: Path) -> Path:
    """Draws return of training episodes and held-out success over training decisions, a colour for each method.

    Lines are medians over seeds, bands reach from the worst to the best seed; points are evaluations.
    """
    methods = methods_of(curves)
    colours = method_colours([group[0].arch for group in methods.values()])
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    returns, success = figure.subplots(1, 2)
    named = []
    for (name, group), colour in zip(methods.items(), colours, strict=True):
        label = name if len(group) == 1 else f"{name}, {len(group)} seeds"
        drawn = draw_band(returns, [curve.returns for curve in group], colour, label)
        named.append(draw_band(success, [curve.success for curve in group], colour, label, marker="o") or drawn)
    returns.set_title("Return of training episodes", loc="left", fontsize=11)
    success.set_title("Held-out scenes: success", loc="left", fontsize=11)
    success.set_ylim(-0.02, 1.02)
    success.yaxis.set_major_formatter(PercentFormatter(1.0))
    for axes in (returns, success):
        finish_decisions_axis(axes, curves)
    if any(len(group) > 1 for group in methods.values()):
        figure.supxlabel("Lines: median over seeds; bands: from the worst to the best seed.", fontsize=9, color="0.4")
    for axes in (returns, success):
        name_ends(axes, [end for place, end in filter(None, named) if place is axes])
    return save_figure(figure, path_png, SHARP_DOTS_PER_INCH)


def finish_decisions_axis(axes: Axes, curves: Sequence[Curve]) -> None:
    """Labels the axis of training decisions, logarithmic where the runs' lengths differ much, and clears the frame."""
    ends = [curve.returns.decisions[-1] for curve in curves]
    is_log = max(ends) >= LOG_FROM * min(ends)
    axes.set_xlabel("training decisions")
    axes.set_xscale("log") if is_log else axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    clear_frame(axes)


def draw_band(
    axes: Axes, runs: Sequence[Series], colour: str, label: str, marker: str = ""
) -> tuple[Axes, LineEnd] | None:
    """One method in one panel: where its line ends; None where no run has such numbers."""
    known = [run for run in runs if len(run.values) > 0]
    band = band_of(known) if known else None
    if band is None or len(band.decisions) == 0:
        return None
    axes.fill_between(band.decisions, band.low, band.high, color=colour, alpha=BAND_ALPHA, lw=0)
    axes.plot(band.decisions, band.median, color=colour, lw=1.8, marker=marker, ms=4, mec="white", mew=0.6, label=label)
    return axes, LineEnd(band.decisions[-1], band.median[-1], label, colour)
