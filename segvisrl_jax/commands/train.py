"""``segvisrl train``: one training run and everything that it leaves behind."""

import contextlib
import math
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from segvisrl_jax.cli import FAILURE, INTERRUPTED, parse
from segvisrl_jax.commands.options import AUTO, PRESETS, with_auto
from segvisrl_jax.config import (
    BOOKKEEPING,
    IMAGE_OBSERVATIONS,
    RUN_TEST_SEED,
    ConfigError,
    PresetName,
    TrainConfig,
    flatten,
    from_dict,
    is_disk_trouble,
    one_line,
    option_words,
    preset_config,
    program,
    read_json,
    replace_fields,
    require,
    require_folder_can_be_made,
    to_dict,
)

SHOW_CURSOR = "\x1b[?25h"
SAID_AGAIN = (  # where it was changed when the run went on
    "steps", "evaluation.every_decisions", "evaluation.num_slots", "checkpoint_every_updates", "max_bad_updates",
    "num_devices", "loggers",
)  # fmt: skip
TEST_EPISODES = 200  # driven after training, on scenes that neither training nor the choice of the policy saw


def run(options: Sequence[str]) -> int:
    """Parses, trains, evaluates, draws."""
    config = parse_config(options)
    require_folder_can_be_made(Path(config.runs_dir), "runs_dir")

    from segvisrl_jax.training.loop import DivergedError, train

    is_first = config.process_id == 0
    if not config.resume and is_first:
        print(differences_from_paper(config))
        print(rocks_in_scenes(config))
        print(observation_memory(config))
    going_on = f"Go on with:\n  {resume_command(config)}"
    try:
        with _told_where_memory_ends(config):
            result = train(config, when_late=lambda said: _end_now(f"{said} {going_on}"))
    except DivergedError as error:
        print(f"segvisrl train: {error}", file=sys.stderr)
        return FAILURE
    if not is_first:
        return 0 if result.finished else INTERRUPTED
    if result.not_on_disk:
        print(f"segvisrl train: could not be written: {'; '.join(result.not_on_disk)}. {going_on}", file=sys.stderr)
        return FAILURE
    if not result.finished:
        print(f"Stopped and saved after {result.decisions:,} decisions. {going_on}")
        return INTERRUPTED
    if result.told_to_stop:
        print(_without_products(config))
        return INTERRUPTED
    return _leave_products(config, result.run_dirs)


def resume_command(config: TrainConfig) -> str:
    """The command that goes on with a run, or with all seeds: with what was said since the run began, too."""
    words: list[Any] = ["train", "--resume", "--runs-dir", config.runs_dir, "--run", config.run_name]
    if config.num_seeds > 1:
        words += ["--seed", config.seed, "--num-seeds", config.num_seeds]
    began = (config.resume and _stored_config(config.runs_dir, config.runs[0].run_name)) or config
    now, then = (flatten(to_dict(one)) for one in (config, began))
    words += [word for name in SAID_AGAIN if now[name] != then[name] for word in option_words(name, now[name])]
    return f"{program()} {shlex.join(map(str, words))}"


def _end_now(said: str) -> None:
    """Ends the process from whichever thread, whatever the others do; the terminal gets its cursor back."""
    try:
        sys.stdout.write((SHOW_CURSOR if sys.stdout.isatty() else "") + f"\n{said}\n")
        sys.stdout.flush()
    finally:  # the terminal may be gone, or know no such letter
        os._exit(INTERRUPTED)


def parse_config(options: Sequence[str]) -> TrainConfig:
    """The resolved settings: preset, then options; a run that goes on starts from its own settings instead."""
    words = _without_auto([word for option in options for word in _as_tyro_reads(option)])
    arch, preset = _value(words, "--arch", "cnn_lstm"), _value(words, "--preset", AUTO)
    if "--resume" in words:
        runs_dir, name = _value(words, "--runs-dir", "runs"), _value(words, "--run", "")
        if _value(words, "--num-seeds", "1") != "1":
            name += f"-seed{_value(words, '--seed', '0')}"  # the first of them; the option itself takes its place
        base = _stored_config(runs_dir, name)
        if base is not None:
            asked, should = _value(words, "--arch", base.arch), f"{base.arch!r}, as when {name} was started"
            require(asked == base.arch, "arch", asked, should)  # else its other settings would be told not to fit
            return parse(TrainConfig, words, "train", base, with_auto())
    require(words[-1:] != ["--preset"], "--preset", "nothing", "followed by one of " + ", ".join(PRESETS))
    require(preset in PRESETS, "--preset", preset, "one of " + ", ".join(PRESETS))
    if preset == AUTO:
        should = "named where processes train together, e.g. gpu"
        require("--coordinator" not in words, "--preset", AUTO, should)  # JAX is not to be asked before they have met
        preset = preset_for_this_machine()
    base = preset_config(arch, preset)
    if "--env.scene.num-rocks" in words and "--env.scene.random-num-rocks-max" not in words:
        base = replace_fields(base, random_num_rocks_max=0, rocks=None)  # what is said counts, not the preset's choice
    return parse(TrainConfig, words, "train", base, with_auto())


def _stored_config(runs_dir: str, run_name: str) -> TrainConfig | None:
    file = Path(runs_dir) / run_name / "config.json"
    if not run_name or not file.is_file():
        return None
    try:
        stored = from_dict(TrainConfig, read_json(file))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: not a run's settings ({error})") from None
    # The folder is where the run is now, not where it began; processes are those that go on.
    return replace_fields(stored, runs_dir=runs_dir, coordinator="", num_processes=1, process_id=0)


def preset_for_this_machine() -> PresetName:
    """What ``--preset auto`` takes: gpu where JAX has an accelerator, else cpu."""
    import jax

    from segvisrl_jax.cpu import make_callbacks_safe

    make_callbacks_safe()  # before the next line starts JAX's backends
    return "cpu" if jax.default_backend() == "cpu" else "gpu"


def _as_tyro_reads(word: str) -> list[str]:
    """``--some_option=value`` as ``--some-option``, ``value``."""
    if not word.startswith("--"):
        return [word]
    option, equals, value = word.partition("=")
    return [option.replace("_", "-"), *([value] if equals else [])]


def _value(words: Sequence[str], option: str, default: str) -> str:
    """The word behind the last use of an option."""
    found = [i for i, word in enumerate(words[:-1]) if word == option]
    return words[found[-1] + 1] if found else default


def _without_auto(words: list[str]) -> list[str]:
    """Without ``--preset auto``: it means that none is said, where it comes last, and nothing where another does."""
    dropped = (AUTO,) if _value(words, "--preset", "") != AUTO else PRESETS
    places = [i for i, word in enumerate(words[:-1]) if word == "--preset" and words[i + 1] in dropped]
    return [word for i, word in enumerate(words) if i not in places and i - 1 not in places]


def differences_from_paper(config: TrainConfig) -> str:
    """One block: what of these settings is not the paper's."""
    paper = flatten(to_dict(preset_config(config.arch, "paper")))
    ours = flatten(to_dict(config))
    apart = (*BOOKKEEPING, "seed", "preset")
    rows = [
        f"  {name:<34} {_short(value):>12}   paper {_short(paper[name])}"
        for name, value in ours.items()
        if value != paper[name] and name not in apart and not name.startswith("evaluation.")
    ]
    title = f"{config.arch}, preset {config.preset}, seed {config.seed}: "
    if not rows:
        return title + "the paper's settings."
    return "\n".join([title + "differs from the paper's settings in", *rows])


def rocks_in_scenes(config: TrainConfig) -> str:
    """One line: how many there are in which scenes."""
    scene, validation = config.env.scene, config.evaluation.rocks
    trained = f"0 to {scene.random_num_rocks_max}" if scene.random_num_rocks_max else str(scene.num_rocks)
    judged = scene.num_rocks if validation is None else validation
    return f"  rocks: {trained} in training, {judged} in validation scenes, {scene.num_rocks} in test scenes"


def observation_memory(config: TrainConfig) -> str:
    """One line: what the observations of a batch take, so that nobody finds out by running out."""
    from segvisrl_jax.env.rover_env import observation_shape

    shape = observation_shape(config.env)
    size = math.prod(shape) * (1 if config.env.obs in IMAGE_OBSERVATIONS else 4)
    total = size * config.ppo.decisions_per_update / 1e6
    if config.ppo.redraw_observations:
        return f"  observations: {total:,.1f} MB a batch, drawn again when needed (not stored)"
    return f"  observations: {total:,.1f} MB a batch, stored"


def _told_where_memory_ends(config: TrainConfig) -> contextlib.AbstractContextManager[None]:
    """Warns where memory will not be enough, and says in one line what to do where it was not.

    Of several processes, none is to ask JAX before they have met, and training itself ends all where one fails.
    """
    from segvisrl_jax.machine import memory

    if config.num_processes > 1:
        return contextlib.nullcontext()
    on_cpu = preset_for_this_machine() == "cpu"
    need, (all_bytes, free_bytes) = memory.need_of(config, on_cpu), memory.there_is(on_cpu)
    warning = memory.warning(config, need, free_bytes)
    if warning:
        print(warning)
    return memory.one_line_where_memory_ends(memory.last_words(config, need, all_bytes, on_cpu))


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


def _together(config: TrainConfig) -> Path:
    return Path(config.runs_dir) / f"{config.run_name}-learning_curves.png"


def _draw_together(config: TrainConfig, run_dirs: Sequence[Path]) -> None:
    """The learning curves of all seeds: the median and a band."""
    from segvisrl_jax.report.learning_curves import draw_learning_curves, read_curves

    print(f"All seeds: {draw_learning_curves(read_curves(run_dirs), _together(config))}")


def _without_products(config: TrainConfig) -> str:
    """What is said where a training that is over is stopped."""
    made_with = f"Its evaluation, curve and video are made with:\n  {resume_command(config)}"
    return f"The training is complete and saved. {made_with}"


def _leave_products(config: TrainConfig, run_dirs: Sequence[Path]) -> int:
    """What is made of finished runs; gives the exit code. What fails or is stopped here costs no training."""
    from segvisrl_jax.training.stop_signals import StopSignals

    again, told = resume_command(config), _without_products(config)
    missing: list[str] = []
    with StopSignals(grace_s=0.0, late=lambda at_once: _end_now(told)):
        for each, run_dir in zip(config.runs, run_dirs, strict=True):
            missing += _finish(each, run_dir)
        if config.num_seeds > 1:
            missing += _not_made({_together(config): lambda: _draw_together(config, run_dirs)}).values()
    if not missing:
        return 0
    said = f"the training is complete and saved, but not made: {'; '.join(missing)}; made with: {again}"
    print(f"segvisrl train: {said}", file=sys.stderr)
    return FAILURE


def _finish(config: TrainConfig, run_dir: Path) -> list[str]:
    """Test scenes, learning curve, video, and what to type next; gives what could not be made, and why."""
    from segvisrl_jax.commands import demo
    from segvisrl_jax.report.figures import learning_curve
    from segvisrl_jax.training.metrics import output_may_fail

    curve, video = run_dir / "learning_curve.png", run_dir / "rollout.mp4"
    made: dict[Path, Callable[[], object]] = {
        run_dir / "eval.json": lambda: _test(config, run_dir),
        curve: lambda: learning_curve([run_dir], curve),
        video: lambda: demo.record(demo.DemoOptions(run=run_dir, output=video)),
    }
    failed = _not_made(made)
    named = f"--run {shlex.quote(str(run_dir))}"
    with output_may_fail():  # other seeds may wait for theirs
        for path in (run_dir / "config.json", run_dir / "metrics.jsonl", *made, run_dir / "policy"):
            if path not in failed:
                print(f"  {path}{os.sep if path.is_dir() else ''}")
        print(f"Next:\n  {program()} eval {named} --episodes 1000\n  {program()} demo {named} --scene 1")
    return list(failed.values())


def _test(config: TrainConfig, run_dir: Path) -> None:
    """Drives test scenes with a finished run, says how well, and writes it down."""
    from segvisrl_jax.commands.eval import EvalOptions, as_json, evaluate, report_line
    from segvisrl_jax.training.metrics import output_may_fail
    from segvisrl_jax.training.output import write_output

    episodes = min(TEST_EPISODES, 5 * config.evaluation.episodes)  # fewer after a smoke test
    slots = config.evaluation.num_slots
    result = evaluate(EvalOptions(run=run_dir, episodes=episodes, seed=RUN_TEST_SEED, slots=slots))
    try:
        write_output(run_dir / "eval.json", as_json(result))
    finally:  # one may be on a full disk, and the other not
        with output_may_fail():
            print(f"\n{episodes} test scenes: {report_line(result)}")


def _not_made(products: dict[Path, Callable[[], object]]) -> dict[Path, str]:
    """Makes each file; those that could not be made, each with its name and the reason."""
    failed = {}
    for path, make in products.items():
        try:
            make()
        except ConfigError as error:
            failed[path] = f"{path} ({one_line(error)})"
        except OSError as error:
            if not is_disk_trouble(error):
                raise
            failed[path] = f"{path} ({error.strerror or error})"
    return failed
