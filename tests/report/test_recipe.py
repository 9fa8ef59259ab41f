"""Two runs of one method with different seeds have one recipe; whatever changes what is learnt makes another."""

import pytest

from segvisrl_jax.config import flatten, preset_config, replace_fields, to_dict
from segvisrl_jax.report.recipe import WHO_COMPUTES, recipe

CONFIG = preset_config("cnn_lstm", "cpu")


@pytest.mark.parametrize(
    "changed",
    [
        {"seed": 3},
        {"run": "other", "runs_dir": "elsewhere"},
        {"rocks": None, "episodes": 10},
        {"num_devices": 2, "coordinator": "h:1", "num_processes": 2, "process_id": 1, "max_bad_updates": 3},
        {"loggers": ("wandb",), "checkpoint_every_updates": 1, "resume": True},
        {"engine": "native", "num_threads": 2, "renderer": "gl"},
    ],
)
def test_bookkeeping_makes_no_other_method(changed):
    assert recipe(replace_fields(CONFIG, **changed)) == recipe(CONFIG)


@pytest.mark.parametrize("changed", [{"learning_rate": 1e-3}, {"steps": 1000}, {"scale": 20.0}, {"num_rocks": 8}])
def test_what_is_learnt_from_does(changed):
    assert recipe(replace_fields(CONFIG, **changed)) != recipe(CONFIG)


def test_who_computes_are_settings_that_exist():
    assert set(WHO_COMPUTES) <= flatten(to_dict(CONFIG)).keys()
