"""``segvisrl table``: evaluations side by side in one markdown table, where they drove the same scenes.

This file reads and checks; ``report/table.py`` formats.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.options import one_or_more
from segvisrl_jax.config import (
    ConfigError,
    EnvConfig,
    TaskConfig,
    TrainConfig,
    from_dict,
    is_finite,
    is_plain_text,
    program,
    read_json,
    require,
    require_file_can_be_written,
)
from segvisrl_jax.report.table import Evaluation, results_table
from segvisrl_jax.training.output import write_output
from segvisrl_jax.training.statistics import wilson_interval

OUTCOMES = ("success", "collision", "fall", "timeout", "unstable")
INTERVALS = ("success_ci95", "collision_ci95", "fall_ci95", "timeout_ci95")
LISTS = ("outcome", "num_decisions", "path_length_m", "shortest_path_m", "min_clearance_m", "goal_bearing_deg")
SAME_SCENE = {"shortest_path_m": 0.0021, "goal_bearing_deg": 0.021}
"""How far two files may be apart in what depends on the scene alone: two units of their last digit."""
REWARDS = ("progress_reward_per_m", "collision_reward", "fall_reward", "timeout_reward")
WORLD = ("gravity_m_s2", "top_speed_m_s", "wheel_friction")  # settings of physics that change the task


@dataclass(frozen=True)
class TableOptions:
    """Makes the results table from evaluations that `segvisrl eval --json` wrote on the same test scenes."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional, one_or_more("EVAL.json")]
    """Evaluations, or folders of them. Other numbers of rocks go to tables of their own."""
    output: Path | None = None
    """Where to write it, .md; default: print it."""

    def __post_init__(self) -> None:
        require(len(self.files) > 0, "EVAL.json", "none given", "at least one file that segvisrl eval --json wrote")
        if self.output is not None:
            should = "a name that ends in .md, in a folder that exists"
            require(self.output.suffix == ".md", "--output", str(self.output), should)
            require_file_can_be_written(self.output, "--output", should)


def run(options: Sequence[str]) -> int:
    """Parses, reads, checks, writes."""
    asked = parse(TableOptions, options, "table")
    page = results_table(sections_of([read_evaluation(path) for path in _paths(asked.files)]))
    if asked.output is None:
        print(page, end="")
    else:
        write_output(asked.output, page)
        print(asked.output)
    return 0


def _paths(given: Sequence[Path]) -> list[Path]:
    paths: list[Path] = []
    for path in given:
        inside = [path] if path.suffix == ".json" else sorted(path.glob("*.json"))
        if not inside:
            has_runs = any(path.glob("*/eval.json"))
            written = f"{program()} eval ... --json {path}/NAME.json writes one"
            hint = f"{path}/*/eval.json are those of runs" if has_runs else written
            raise ConfigError(f"{path}: holds no evaluation; {hint}")
        paths += inside
    return paths


def read_evaluation(path: Path) -> Evaluation:
    """Reads what ``segvisrl eval --json`` wrote, and checks that it is whole and agrees with itself.

    Raises:
        ConfigError: where it cannot be read or does not; one line that names the file.
    """
    try:
        data = read_json(path)
        require(isinstance(data, dict), "content", type(data).__name__, "an object")
        evaluation = evaluation_of(str(path), data)
        _require_numbers(data)
        _require_agreement(data)
    except KeyError as error:
        raise ConfigError(f"{path}: has no {error}; should be a file that this version's segvisrl eval wrote") from None
    except (OSError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:300]
        raise ConfigError(f"{path}: should be a file that segvisrl eval --json wrote ({reason})") from None
    return evaluation


def evaluation_of(file: str, data: dict[str, Any]) -> Evaluation:
    """What ``segvisrl eval`` found, as the table takes it; ``file`` is what messages call it."""
    training = data["training_config"]
    if training is not None:
        require(isinstance(training, dict), "training_config", training, "an object or null")
        require(type(training["steps"]) is int, "training_config.steps", training["steps"], "a whole number")
        require(bool(training["preset"]), "training_config.preset", training["preset"], "a name")
        require(type(data["training_seed"]) is int, "training_seed", data["training_seed"], "a whole number")
        from_dict(TrainConfig, training)  # refuses settings that this version does not have
    return Evaluation(
        file=file,
        method=_text(data, "method"),
        source=_text(data, "source"),
        training_seed=data["training_seed"],
        training_config=training,
        episodes=_count(data, "episodes", 1),
        seed=_count(data, "seed", 0),
        engine=_text(data, "physics_engine"),
        renderer=None if data["renderer"] is None else _text(data, "renderer"),
        config=from_dict(EnvConfig, data["config"]),
        outcome=tuple(data["per_episode"]["outcome"]),
        numbers=data,
    )


def _text(data: dict[str, Any], name: str) -> str:
    require(is_plain_text(data[name]), name, data[name], "text without control characters")
    return data[name]


def _count(data: dict[str, Any], name: str, least: int) -> int:
    require(type(data[name]) is int and data[name] >= least, name, data[name], f"a whole number, at least {least}")
    return data[name]


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and is_finite(value)


def _require_numbers(data: dict[str, Any]) -> None:
    """What the table prints is there and of the right kind."""
    for name in (*OUTCOMES, "spl"):
        require(_is_number(data[name]) and 0 <= data[name] <= 1, name, data[name], "a share in [0, 1]")
    for name in INTERVALS:
        require(len(data[name]) == 2 and all(map(_is_number, data[name])), name, data[name], "two numbers")
    for name in ("path_ratio", "mean_time_s", "min_clearance_m"):
        require(data[name] is None or _is_number(data[name]), name, data[name], "a number or null")
    require(_is_number(data["wall_clock_s"]), "wall_clock_s", data["wall_clock_s"], "a number")
    versions = data["versions"]
    is_sound = isinstance(versions, dict) and all(map(is_plain_text, (*versions, *versions.values())))
    require(is_sound, "versions", versions, "an object of names and texts")
    _text(data, "command")
    _text(data, "device")


def _require_agreement(data: dict[str, Any]) -> None:
    """Every episode is recorded, and the shares are those of the record."""
    episodes, record = data["episodes"], data["per_episode"]
    for name in LISTS:
        require(isinstance(record[name], list), f"per_episode.{name}", type(record[name]).__name__, "a list")
        length = len(record[name])
        require(length == episodes, f"per_episode.{name}", f"{length} values", f"as long as episodes = {episodes}")
    for name in OUTCOMES:
        counted = record["outcome"].count(name) / episodes
        require(abs(data[name] - counted) < 1e-9, name, data[name], f"{counted}, as per_episode.outcome has it")
    for name in INTERVALS:
        interval = wilson_interval(record["outcome"].count(name.removesuffix("_ci95")), episodes)
        require(np.allclose(data[name], interval, atol=1e-6), name, data[name], f"{interval}, Wilson's 95 % interval")
    others = set(map(str, record["outcome"])) - set(OUTCOMES)
    require(not others, "per_episode.outcome", ", ".join(sorted(others)), f"one of {', '.join(OUTCOMES)}")
    for name in SAME_SCENE:
        is_sound = all(value is None or _is_number(value) for value in record[name])
        require(is_sound, f"per_episode.{name}", "other things", "numbers or null")


def sections_of(evaluations: Sequence[Evaluation]) -> list[list[Evaluation]]:
    """Evaluations by number of rocks, fewest first; each section's drove the same scenes.

    Raises:
        ConfigError: where they did not, or where two files hold the same method with the same training seed.
    """
    sections: dict[int, list[Evaluation]] = {}
    for evaluation in evaluations:
        sections.setdefault(evaluation.config.scene.num_rocks, []).append(evaluation)
    for section in sections.values():
        seen: dict[Any, Evaluation] = {}
        for evaluation in section:
            _require_same_scenes(section[0], evaluation)
            twin = seen.setdefault((evaluation.variant, evaluation.training_seed), evaluation)
            if twin is not evaluation:
                seed = f" with training seed {twin.training_seed}" if twin.training_seed is not None else ""
                raise ConfigError(f"{evaluation.file}: should be left out: {twin.file} holds {twin.method}{seed} too")
    return [sections[num_rocks] for num_rocks in sorted(sections)]


def _require_same_scenes(first: Evaluation, other: Evaluation) -> None:
    """Same settings of everything that is not the method's own, and the same scenes to the millimetre."""
    ours, theirs = _rules(other), _rules(first)
    for name, value in ours.items():
        should = f"{theirs[name]!r}, as in {first.file}: methods are compared on the same scenes"
        require(value == theirs[name], f"{other.file}: {name}", value, should)
    for name, tolerance in SAME_SCENE.items():
        apart = _distance(other.numbers["per_episode"][name], first.numbers["per_episode"][name])
        if np.any(apart > tolerance):
            number = int(np.argmax(apart > tolerance))
            raise ConfigError(
                f"{other.file}: {name} of scene {number} differs from {first.file}: should be the same scenes"
            )


def _rules(evaluation: Evaluation) -> dict[str, Any]:
    """Which scenes were driven, and by which rules."""
    return {"seed": evaluation.seed, "episodes": evaluation.episodes, **rules_of(evaluation.config)}


def rules_of(config: EnvConfig) -> dict[str, Any]:
    """Settings of a world that scenes and outcomes depend on: not the rewards, nor what computes."""
    task = [f.name for f in dataclasses.fields(TaskConfig) if f.name not in REWARDS]
    return {
        **{f"scene.{name}": value for name, value in dataclasses.asdict(config.scene).items()},
        **{f"conditions.{name}": value for name, value in dataclasses.asdict(config.conditions).items()},
        **{f"task.{name}": getattr(config.task, name) for name in task},
        **{f"physics.{name}": getattr(config.physics, name) for name in WORLD},
    }


def _distance(ours: list[float | None], theirs: list[float | None]) -> np.ndarray:
    """|a - b|: 0 where both are None, infinite where one is."""
    a, b = (np.array([np.nan if v is None else v for v in values], float) for values in (ours, theirs))
    apart = np.where(np.isnan(a) & np.isnan(b), 0.0, np.abs(a - b))
    return np.where(np.isnan(apart), np.inf, apart)
