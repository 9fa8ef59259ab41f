"""Learning curves: thinned without a bias, grouped by method, and the same from their CSV as from the runs."""

import json

import imageio.v3 as iio
import matplotlib.figure
import numpy as np
import pytest

from segvisrl_jax.config import ConfigError, preset_config, replace_fields, to_dict
from segvisrl_jax.report.learning_curves import (
    POINTS,
    Series,
    band_of,
    draw_learning_curves,
    methods_of,
    read_curves,
    write_curves,
)


def write_run(
    folder, arch="mlp", seed=0, num_updates=30, returns=lambda n: 10.0 * n, success=lambda n: 0.5, **settings
):
    folder.mkdir()
    config = replace_fields(preset_config(arch, "smoke"), seed=seed, run=folder.name, **settings)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    rows = [{"step": 100 * n, "episode/return": returns(n)} for n in range(1, num_updates + 1)]
    for row in rows[9::10]:
        row["evaluation/success"] = success(row["step"] // 100)
    rows[0]["episode/return"] = None  # no episode has ended
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_a_long_run_is_thinned_to_means_and_its_evaluations_are_kept(tmp_path):
    [curve] = read_curves([write_run(tmp_path / "run", num_updates=1001)])
    assert curve.arch == "mlp"
    assert POINTS / 2 <= len(curve.returns.values) <= POINTS
    np.testing.assert_allclose(curve.returns.values, curve.returns.decisions / 10)  # a line stays itself
    assert curve.returns.decisions[0] == np.mean([200, 300, 400, 500, 600])
    np.testing.assert_array_equal(curve.success.decisions, 1000 * np.arange(1, 101))


def test_the_csv_gives_the_same_curves_and_the_same_file_again(tmp_path):
    runs = [write_run(tmp_path / f"run{seed}", seed=seed, returns=lambda n: np.pi * n) for seed in (0, 1)]
    curves = read_curves(runs)
    path = write_curves(curves, tmp_path / "new" / "curves.csv")
    again = read_curves([path])
    for ours, theirs in zip(curves, again, strict=True):
        assert (ours.arch, ours.recipe, ours.run, ours.seed) == (theirs.arch, theirs.recipe, theirs.run, theirs.seed)
        np.testing.assert_allclose(ours.returns, theirs.returns, rtol=1e-5)
        np.testing.assert_array_equal(ours.success, theirs.success)
    text = path.read_text()
    assert write_curves(again, path).read_text() == text
    assert len(text) < 6000


def test_seeds_of_one_method_are_together_and_other_settings_apart(tmp_path):
    runs = [
        write_run(tmp_path / "a", seed=0),
        write_run(tmp_path / "b", seed=1, checkpoint_every_updates=7, engine="mjx"),
        write_run(tmp_path / "c", seed=0, learning_rate=0.5),
        write_run(tmp_path / "d", arch="cnn"),
    ]
    groups = {name: [curve.run for curve in group] for name, group in methods_of(read_curves(runs)).items()}
    assert groups == {"mlp (a, b)": ["a", "b"], "mlp (c)": ["c"], "cnn": ["d"]}
    write_run(tmp_path / "twin", seed=1)
    with pytest.raises(ConfigError, match=r"twin: should be left out: .*b holds mlp with seed 1 too"):
        read_curves([*runs, tmp_path / "twin"])


def test_a_band_goes_from_the_worst_to_the_best_seed_where_all_have_numbers():
    runs = [
        Series(np.array([1.0, 3.0]), np.array([0.0, 2.0])),
        Series(np.array([0.0, 2.0, 4.0]), np.array([5.0, 5.0, 5.0])),
        Series(np.array([1.0, 2.0, 3.0]), np.array([3.0, 3.0, 3.0])),
    ]
    band = band_of(runs)
    np.testing.assert_array_equal(band.decisions, [1, 2, 3])
    np.testing.assert_array_equal(band.low, [0, 1, 2])
    np.testing.assert_array_equal(band.median, [3, 3, 3])
    np.testing.assert_array_equal(band.high, [5, 5, 5])


def test_the_figure_shows_medians_bands_and_names(tmp_path, monkeypatch):
    figures = []
    save = matplotlib.figure.Figure.savefig
    keep = lambda figure, *words, **options: (figures.append(figure), save(figure, *words, **options))  # noqa: E731
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", keep)
    runs = [write_run(tmp_path / f"run{s}", seed=s, success=lambda n, s=s: 0.1 * s) for s in range(3)]
    runs.append(write_run(tmp_path / "raw", arch="cnn_lstm_raw", num_updates=9))  # no evaluation yet
    assert iio.imread(draw_learning_curves(read_curves(runs), tmp_path / "curves.png")).shape[1] > 1000
    returns, success = figures[0].axes
    assert [text.get_text() for text in success.texts] == ["mlp, 3 seeds"]
    assert [text.get_text() for text in returns.texts] == ["cnn_lstm_raw"]
    np.testing.assert_allclose(success.lines[0].get_ydata(), 0.1)
    band = success.collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (0.0, 0.2)
    assert returns.get_xscale() == "linear"
    long = write_run(tmp_path / "long", arch="cnn", num_updates=500)
    draw_learning_curves(read_curves([*runs, long]), tmp_path / "curves.png")
    assert figures[1].axes[0].get_xscale() == "log"


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="none given"):
        read_curves([])
    with pytest.raises(ConfigError, match=r"config\.json"):
        read_curves([tmp_path])
    with pytest.raises(ConfigError, match="a run with episodes"):
        read_curves([write_run(tmp_path / "empty", num_updates=1)])
    (tmp_path / "empty" / "config.json").write_text("{")
    with pytest.raises(ConfigError, match="not a run's settings"):
        read_curves([tmp_path / "empty"])
    for name, text in {
        "absent": None,
        "other": "a,b\n1,2\n",
        "none": "",
        "bad": "arch,recipe,run,seed\nx,y,z,w\n",
    }.items():
        if text is not None:
            (tmp_path / f"{name}.csv").write_text(text)
        with pytest.raises(ConfigError, match=f"{name}.csv"):
            read_curves([tmp_path / f"{name}.csv"])
