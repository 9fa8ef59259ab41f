"""What the report page chooses to show, and the commands and colours that it prints."""

import shlex
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from segvisrl_jax.commands.train import parse_config
from segvisrl_jax.config import EnvConfig, preset_config, replace_fields, to_dict
from segvisrl_jax.report.page import paper_shares
from segvisrl_jax.report.page_figures import inline_svg, theme_colour
from segvisrl_jax.report.page_methods import (
    closest_calls,
    compared_methods,
    failures_of,
    maps_worth_drawing,
    summary,
    worst_episodes,
)
from segvisrl_jax.report.page_settings import settings_of, train_command
from segvisrl_jax.report.table import Evaluation
from segvisrl_jax.training.statistics import wilson_interval

NAMES = {"S": "success", "C": "collision", "F": "fall", "T": "timeout"}


def evaluation(name, method, ends, clearances=None, seed=0, spl=0.9):
    """An evaluation whose episodes ended as the letters say."""
    outcome = tuple(NAMES[end] for end in ends)
    count = outcome.count("success")
    record = {
        "min_clearance_m": clearances or [1.5] * len(ends),
        "path_length_m": [12.0] * len(ends),
    }
    numbers = {
        "success": count / len(ends),
        "success_ci95": list(wilson_interval(count, len(ends))),
        "spl": spl,
        "per_episode": record,
    }
    config = None if method == "p" else to_dict(replace_fields(preset_config(method, "cpu"), seed=seed))
    return Evaluation(
        file=name,
        method=method,
        source=name,
        training_seed=None if method == "p" else seed,
        training_config=config,
        episodes=len(ends),
        seed=0,
        engine="native",
        renderer=None,
        config=EnvConfig(obs="state"),
        outcome=outcome,
        numbers=numbers,
    )


def test_failures_are_shown_in_turn_of_runs_and_kinds():
    some = [evaluation("a", "mlp", "CCTS"), evaluation("b", "mlp_rocks", "SSCS"), evaluation("p", "p", "CCCC")]
    failures = failures_of(some)
    assert len(failures) == 4
    shown = [(pick.evaluation.file, pick.scene, pick.outcome.name) for pick in worst_episodes(failures)]
    assert shown == [("a", 0, "COLLISION"), ("b", 2, "COLLISION"), ("a", 2, "TIMEOUT"), ("a", 1, "COLLISION")]


def test_closest_calls_are_of_different_scenes_and_of_trained_policies():
    some = [
        evaluation("a", "mlp", "SSSS", [0.9, 0.6, None, 0.8]),
        evaluation("b", "mlp_rocks", "SSSS", [2.0, 0.5, 3.0, 0.7]),
        evaluation("p", "p", "SSSS", [0.51] * 4),
    ]
    assert [(pick.evaluation.file, pick.scene) for pick in closest_calls(some)] == [("b", 1), ("b", 3), ("a", 0)]
    assert [pick.scene for pick in closest_calls([evaluation("a", "mlp", "SS", [None, None])])] == []


def test_methods_are_named_ranked_and_summed_up():
    seeds = [evaluation(f"m{seed}", "mlp", ends, seed=seed) for seed, ends in enumerate(("SSSC", "SSSS", "SCCC"))]
    methods = compared_methods([*seeds, evaluation("p", "p", "SSCC"), evaluation("r", "mlp_rocks", "SSSS")])
    assert [method.name for method in methods] == ["mlp_rocks", "mlp", "P controller"]
    assert [one.row.median.file for one in methods] == ["r", "m0", "p"]
    assert summary(methods) == (
        "The best of 2 methods is mlp_rocks, which reaches the goal in 4 of 4 test scenes, 100.0 % (95 % interval "
        "51.0 to 100.0 %); the paper's P controller, which sees no rocks, reaches it in 2."
    )
    level = compared_methods([evaluation("a", "mlp", "SS"), evaluation("b", "cnn", "SS", spl=0.8)])
    assert "100.0 %), as cnn does on longer paths." in summary(level)
    assert summary(methods[1:2]).startswith("mlp reaches the goal in 3 of 4")
    assert [case.scene for case in maps_worth_drawing(methods)] == [2, 3, 0]
    assert [case.scene for case in maps_worth_drawing([compared_methods([evaluation("a", "mlp", "TT")])[0]])] == [0]
    twice = replace(seeds[0], renderer="gl", file="other")
    assert [one.name for one in compared_methods([seeds[0], twice])] == ["mlp (m0)", "mlp (other)"]


def test_the_paper_stands_beside_its_own_scenes_only():
    ours = [evaluation("a", "cnn_lstm", "SS"), evaluation("m", "mlp", "SS"), evaluation("p", "p", "SS")]
    methods = {one.name: one for one in compared_methods(ours)}
    assert paper_shares(methods["cnn_lstm"].paper)["success"] == 0.9
    assert [methods["mlp"].paper, methods["mlp"].failed_in_paper] == [None, True]
    denser = compared_methods([replace(one, config=replace_fields(one.config, num_rocks=3)) for one in ours])
    assert [(one.paper, one.failed_in_paper) for one in denser] == [(None, False)] * 3


@pytest.mark.parametrize(
    ("arch", "preset", "changes"),
    [
        ("mlp", "cpu", {}),
        ("cnn_lstm", "gpu", {"learning_rate": 3e-4, "rocks": None, "bounded_mean": False, "steps": 1000}),
        ("cnn_lstm", "cpu", {"num_rocks": 8}),
        ("cnn_lstm", "cpu", {"num_rocks": 8, "random_num_rocks_max": 0}),
        ("mlp_rocks", "paper", {"mlp_sizes": (64, 32), "bounded_mean": True, "renderer": "gl", "seed": 7}),
    ],
)
def test_the_printed_command_gives_the_same_settings(arch, preset, changes):
    config = replace_fields(preset_config(arch, preset), run="x", **changes)
    words = shlex.split(train_command(config, "x"))
    assert words[:2] == ["segvisrl", "train"]
    assert parse_config(words[2:]) == config


def test_settings_that_differ_from_the_papers_come_first():
    config = replace_fields(preset_config("cnn_lstm", "paper"), learning_rate=5e-4, bounded_mean=True, seed=3)
    differing, same = settings_of(config)
    assert {(one.name, one.value, one.paper) for one in differing} == {
        ("ppo.learning_rate", "0.0005", "0.0003"),
        ("network.bounded_mean", "yes", "no"),
    }
    assert "env.scene.num_rocks" in {one.name for one in same}
    assert all(one.value == one.paper for one in same)


def test_figures_become_inline_svg_with_colours_of_the_page():
    figures = []
    for _ in range(2):
        figure = Figure(figsize=(2, 2))
        axes = figure.add_subplot()
        axes.plot(np.arange(3), color="#0072b2", marker="o")
        axes.set_title("a title")
        figures.append(figure)
    one, two = (inline_svg(figure, name, "<it>") for figure, name in zip(figures, "ab", strict=True))
    assert one.startswith("<svg")
    assert 'aria-label="&lt;it&gt;"' in one
    assert theme_colour("#0072B2") == "var(--c-0072b2, #0072B2)"
    assert "var(--c-0072b2, #0072b2)" in one
    assert "a title</text>" in one  # text, not outlines
    assert 'id="a-' in one
    assert "url(#a-" in one
    assert 'id="a-' not in two
    assert "<metadata" not in one
    assert "width=" not in one[: one.index(">")]
