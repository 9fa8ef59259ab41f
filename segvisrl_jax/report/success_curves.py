"""Success and collision over a setting of the environment, from evaluations: which of them make a line, and the figure.

Reads no files: the evaluations come checked (``commands/table.py``).
"""

import dataclasses
import difflib
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter
from matplotlib.transforms import ScaledTranslation, Transform

from segvisrl_jax.config import CameraConfig, ConfigError, flatten, require, to_dict
from segvisrl_jax.report.figures import SHARP_DOTS_PER_INCH, clear_frame, save_figure
from segvisrl_jax.report.lines import BAND_ALPHA, POINTS_PER_INCH, LineEnd, method_colours, name_ends
from segvisrl_jax.report.recipe import WHO_COMPUTES
from segvisrl_jax.report.table import NAMES, Evaluation

CEILING = "planner"
AXIS_NAMES = {
    "scene.num_rocks": "rocks on the map",
    "camera.scale": "downsampling of the 1920 x 1080 image, per axis",
}
UNITS = {"_m_s2": "m/s²", "_m_s": "m/s", "_m": "m", "_s": "s", "_deg": "°", "_px": "px", "_per_m": "1/m"}
OF_THE_WORLD = ("scene.", "task.", "physics.", "conditions.")
NOT_OF_THE_WORLD = ("physics.engine", "physics.num_threads", "physics.timestep_s")
"""Settings of those parts that a method may have of its own, as it may have its rewards and its camera."""
MOST_TICKS = 12
MOST_DISTINCTIONS = 3  # settings in the name of a line
SIDE_SHARE = 0.04  # of an axis, free on both sides of the values
ASIDE_PT = 4.0  # between methods, so that points at the same place are all seen


@dataclass(frozen=True)
class Line:
    """One method: at every value of the setting, its seeds by success, worst first."""

    name: str
    method: str
    points: dict[float, tuple[Evaluation, ...]]  # ascending
    is_constant: bool  # the setting is of the camera, and the method does not look

    def median(self, value: float) -> Evaluation:
        """The median seed by success; of an even number the lower of the two in the middle, as in the table."""
        seeds = self.points[value]
        return seeds[(len(seeds) - 1) // 2]


def resolve_field(evaluations: Sequence[Evaluation], name: str) -> str:
    """The dotted name of a numeric setting in which evaluations differ, from that or from its last part.

    Raises:
        ConfigError: where there is no such setting, it is no number, or it is the same in all evaluations.
    """
    require(len(evaluations) > 0, "EVAL.json", "none given", "files that segvisrl eval --json wrote")
    settings = _settings(evaluations[0])
    found = [field for field in settings if name in (field, field.rpartition(".")[2])]
    if not found:
        near = difflib.get_close_matches(name, [word for f in settings for word in (f, f.rpartition(".")[2])], n=3)
        raise ConfigError(f"--x = {name!r}: should be a setting of the environment, {_differing(evaluations, near)}")
    field = found[0]
    require(_is_number(settings[field]), "--x", field, "a setting that is a number")
    values = {_settings(evaluation)[field] for evaluation in evaluations}
    should = f"a setting in which the files differ, {_differing(evaluations)}; it is {settings[field]!r} in all of them"
    require(len(values) > 1, "--x", field, should)
    return field


def _settings(evaluation: Evaluation) -> dict[str, Any]:
    return flatten(to_dict(evaluation.config))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _differing(evaluations: Sequence[Evaluation], near: Sequence[str] = ()) -> str:
    """What a user may have meant, or what would do."""
    every = [_settings(evaluation) for evaluation in evaluations]
    differ = [name for name, value in every[0].items() if _is_number(value) and any(o[name] != value for o in every)]
    return f"such as {', '.join(near or differ)}" if near or differ else "but these files differ in none"


def lines_of(evaluations: Sequence[Evaluation], field: str) -> list[Line]:
    """Evaluations that differ only in the setting, in the policy's seed and in how it was trained for it, as lines.

    Raises:
        ConfigError: where worlds differ in more than the setting, or two evaluations are of the same thing.
    """
    for evaluation in evaluations:
        _require_same_world(evaluations[0], evaluation, field)
    groups: dict[str, list[Evaluation]] = {}
    for evaluation in evaluations:
        groups.setdefault(_method_key(evaluation, field), []).append(evaluation)
    firsts = [group[0] for group in groups.values()]
    return [_line(group, field, _distinction(group, firsts, field)) for group in groups.values()]


def _distinction(group: Sequence[Evaluation], firsts: Sequence[Evaluation], field: str) -> str:
    """What tells a line from others of its method: its run; of several runs, the fewest settings of their training."""
    others = [first.recipe for first in firsts if first.method == group[0].method and first is not group[0]]
    if not others:
        return ""
    sources = list(dict.fromkeys(map(_source, group)))
    if len(sources) == 1:
        return sources[0]
    ours = {name: value for name, value in group[0].recipe.items() if name != f"env.{field}"}
    differing = [name for name, value in ours.items() if any(other.get(name) != value for other in others)]
    for count in range(1, MOST_DISTINCTIONS + 1):
        for names in itertools.combinations(differing, count):
            if all(any(other.get(name) != ours[name] for name in names) for other in others):
                return ", ".join(f"{name.rpartition('.')[2]} {ours[name]}" for name in names)
    return ", ".join(sources)


def _require_same_world(first: Evaluation, other: Evaluation, field: str) -> None:
    ours, theirs = _world(other), _world(first)
    for name, value in ours.items():
        should = f"{theirs[name]!r}, as in {first.file}: only {field} may differ"
        require(name == field or value == theirs[name], f"{other.file}: {name}", value, should)


def _world(evaluation: Evaluation) -> dict[str, Any]:
    """Which scenes were driven, and by which rules."""
    kept = {
        name: value
        for name, value in _settings(evaluation).items()
        if name.startswith(OF_THE_WORLD) and name not in NOT_OF_THE_WORLD and "reward" not in name
    }
    return {"seed": evaluation.seed, **kept}


def _method_key(evaluation: Evaluation, field: str) -> str:
    """Equal for evaluations that belong on one line."""
    not_ours = (field, *(name.removeprefix("env.") for name in WHO_COMPUTES))
    ours = {name: value for name, value in _settings(evaluation).items() if name not in not_ours}
    recipe = {name: value for name, value in evaluation.recipe.items() if name != f"env.{field}"}
    return json.dumps([evaluation.method, evaluation.engine, evaluation.renderer, ours, recipe], sort_keys=True)


def _source(evaluation: Evaluation) -> str:
    """A run's or a policy's own name."""
    return Path(evaluation.source).name


def _line(group: Sequence[Evaluation], field: str, source: str) -> Line:
    points: dict[float, list[Evaluation]] = {}
    for evaluation in group:
        here = points.setdefault(_settings(evaluation)[field], [])
        for twin in here:
            is_other = twin.training_seed != evaluation.training_seed
            seed = f" with training seed {twin.training_seed}" if twin.training_seed is not None else ""
            if not is_other:
                raise ConfigError(f"{evaluation.file}: should be left out: {twin.file} holds {twin.method}{seed} too")
        here.append(evaluation)
    method = group[0].method
    ranked = {value: tuple(sorted(points[value], key=lambda e: e.numbers["success"])) for value in sorted(points)}
    name = NAMES.get(method, method)
    if source:
        name = source if source.startswith(method) else f"{name} ({source})"
    is_constant = field.startswith("camera.") and group[0].renderer is None
    return Line(name, method, ranked, is_constant)


def draw_success_curves(evaluations: Sequence[Evaluation], name: str, path_png: Path) -> Path:
    """Draws success and collision over a setting, a line for each method with its Wilson 95 % intervals as a band.

    Args:
        evaluations: on scenes of the same seed, in worlds that differ in the setting alone.
        name: of the setting, dotted (``scene.num_rocks``) or its last part.
        path_png: the figure.

    Of several seeds the median one is drawn, the others are pale points. The planner is a dashed line. What does not
    look is level where the setting is of the camera.

    Raises:
        ConfigError: see ``resolve_field`` and ``lines_of``.
    """
    field = resolve_field(evaluations, name)
    lines = lines_of(evaluations, field)
    values = sorted({value for line in lines if not line.is_constant for value in line.points})
    colours = method_colours([line.method for line in lines])
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    panels = figure.subplots(1, 2)
    titles = ("Episodes that reach the goal", "Episodes that end in a collision")
    for axes, kind, title in zip(panels, ("success", "collision"), titles, strict=True):
        _set_axis(axes, field, values, evaluations)
        ends = []
        for number, (line, colour) in enumerate(zip(lines, colours, strict=True)):
            aside = ASIDE_PT / POINTS_PER_INCH * (number - (len(lines) - 1) / 2)
            place = axes.transData + ScaledTranslation(aside, 0, figure.dpi_scale_trans)
            ends.append(_draw_line(axes, line, kind, colour, values, place))
        axes.set_title(title, loc="left", fontsize=11)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        clear_frame(axes)
    intervals = {kind: _intervals(lines, kind) for kind in ("success", "collision")}
    panels[0].set_ylim((0.5, 1.01) if intervals["success"].min() > 0.5 else (-0.02, 1.02))
    panels[1].set_ylim(-0.02 * intervals["collision"].max(), 1.02 * intervals["collision"].max())
    figure.supxlabel(_legend(lines, evaluations), fontsize=9, color="0.4")
    name_ends(panels[1], ends)
    return save_figure(figure, path_png, SHARP_DOTS_PER_INCH)


def _draw_line(axes: Axes, line: Line, kind: str, colour: str, values: Sequence[float], place: Transform) -> LineEnd:
    """One method in one panel, from data to the figure by ``place``."""
    places = np.array(values if line.is_constant else list(line.points))
    drawn = [line.median(next(iter(line.points)) if line.is_constant else value) for value in places]
    shares = np.array([evaluation.numbers[kind] for evaluation in drawn])
    low, high = np.array([evaluation.numbers[f"{kind}_ci95"] for evaluation in drawn]).T
    is_ceiling = line.method == CEILING
    if len(places) == 1:
        axes.vlines(places, low, high, color=colour, alpha=2 * BAND_ALPHA, lw=3, transform=place)
    elif not is_ceiling:
        axes.fill_between(places, low, high, color=colour, alpha=BAND_ALPHA, lw=0, transform=place)
    (drawn_line,) = axes.plot(places, shares, "-o", color=colour, lw=1.8, ms=4.5, mec="white", mew=0.6, zorder=3)
    drawn_line.set(
        transform=place, linestyle="--" if is_ceiling else "-", marker="" if is_ceiling or line.is_constant else "o"
    )
    for value, seeds in line.points.items():
        if len(seeds) == 1:
            continue
        others = [seed.numbers[kind] for seed in seeds if seed is not line.median(value)]
        axes.plot([value] * len(others), others, "o", color=colour, ms=3.5, alpha=0.45, mec="none", transform=place)
    name = f"{line.name} (ceiling)" if is_ceiling else line.name
    return LineEnd(float(places[-1]), float(shares[-1]), name, colour)


def _intervals(lines: Sequence[Line], kind: str) -> Float[np.ndarray, "K 2"]:
    """All that is drawn as a band."""
    every = [evaluation for line in lines for seeds in line.points.values() for evaluation in seeds]
    return np.array([evaluation.numbers[f"{kind}_ci95"] for evaluation in every])


def _legend(lines: Sequence[Line], evaluations: Sequence[Evaluation]) -> str:
    counts = sorted({evaluation.episodes for evaluation in evaluations})
    scenes = f"{counts[0]:,}" if len(counts) == 1 else f"{counts[0]:,} to {counts[-1]:,}"
    text = f"Bands: Wilson 95 % intervals, {scenes} test scenes a point."
    if any(len(seeds) > 1 for line in lines for seeds in line.points.values()):
        text += " Lines: the median of the training seeds; pale points: the others."
    return text


def _set_axis(axes: Axes, field: str, values: Sequence[float], evaluations: Sequence[Evaluation]) -> None:
    """The scale on which the values are the more even, a tick at each, and what they are."""
    if is_geometric(values):
        least = min(value for value in values if value > 0)
        scale: dict[str, Any] = {"value": "log", "base": 2}
        if min(values) == 0:  # from 0 to the least value as far as from that to its double
            scale = {"value": "symlog", "base": 2, "linthresh": least, "linscale": 1 / 2}
        axes.set_xscale(**scale)
    forward = axes.xaxis.get_transform()
    left, right = forward.transform(np.array([min(values), max(values)], float))
    beyond = SIDE_SHARE * (right - left)
    axes.set_xlim(*forward.inverted().transform(np.array([left - beyond, right + beyond])))
    shown = values if len(values) <= MOST_TICKS else values[:: -(-len(values) // MOST_TICKS)]
    axes.set_xticks(shown, [_tick(field, value, evaluations) for value in shown], fontsize="x-small")
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda value, place: ""))
    axes.minorticks_off()
    axes.set_xlabel(axis_name(field))


def is_geometric(values: Sequence[float]) -> bool:
    """Whether the steps between values (two different ones at least) are more even as ratios than as differences.

    Values that are not positive, but for a first 0, have no ratios.
    """
    positive = np.array([value for value in values if value > 0])
    if min(values) < 0 or len(positive) < 3:
        return False
    return bool(_unevenness(np.diff(np.log(positive))) < _unevenness(np.diff(np.array(values, float))))


def _unevenness(steps: Float[np.ndarray, "K"]) -> float:
    return float(np.std(steps) / np.mean(steps))


def _tick(field: str, value: float, evaluations: Sequence[Evaluation]) -> str:
    if field != "camera.scale":
        return f"{value:g}"
    camera: CameraConfig = dataclasses.replace(evaluations[0].config.camera, scale=value)
    rows, columns = camera.observation_size_px
    return f"{value:g}\n{columns}\nx {rows}"


def axis_name(field: str) -> str:
    """A setting in words, its unit in brackets."""
    if field in AXIS_NAMES:
        return AXIS_NAMES[field]
    words = field.rpartition(".")[2]
    for ending, unit in UNITS.items():  # the longer ones first
        if words.endswith(ending):
            return f"{words.removesuffix(ending).replace('_', ' ')} [{unit}]"
    return words.replace("_", " ")
