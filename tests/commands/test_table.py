"""The results table says what the evaluations' files say, and compares nothing that may not be compared."""

import copy
import json
import math
import shlex
from pathlib import Path

import jax
import numpy as np
import pytest

from segvisrl_jax.agent.networks import make_network
from segvisrl_jax.cli import main, parse
from segvisrl_jax.commands.eval import EvalOptions, as_json, command_line
from segvisrl_jax.config import preset_config, replace_fields
from segvisrl_jax.training.checkpoint import save_policy
from segvisrl_jax.training.statistics import wilson_interval

EPISODES = 36
OUTCOMES = ("success", "collision", "fall", "timeout", "unstable")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Evaluations as ``segvisrl eval`` writes them."""
    folder = tmp_path_factory.mktemp("evaluations")
    for name, words in {
        "p": ["--controller", "p", "--seed", "3"],
        "random": ["--controller", "random", "--seed", "3"],
        "p8": ["--controller", "p", "--seed", "3", "--num-rocks", "8"],
        "mlp": ["--policy", str(untrained_policy(folder / "policy", seed=7)), "--seed", "4"],  # other scenes
    }.items():
        assert main(["eval", *words, "--episodes", str(EPISODES), "--json", str(folder / f"{name}.json")]) == 0
    return folder


def untrained_policy(folder: Path, seed: int) -> Path:
    config = replace_fields(preset_config("mlp", "smoke"), seed=seed)
    params = make_network("mlp", config.network, (7,)).init(jax.random.key(seed))
    save_policy(folder, config, params, {})
    return folder


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def write(path: Path, data: dict) -> Path:
    path.write_text(as_json(data))
    return path


def with_outcomes(data: dict, outcome: list[str], **fields) -> dict:
    """A copy with other outcomes, and the shares that go with them."""
    data = {**copy.deepcopy(data), **fields}
    data["episodes"] = len(outcome)
    data["per_episode"] = {name: values[: len(outcome)] for name, values in data["per_episode"].items()}
    data["per_episode"]["outcome"] = outcome
    for kind in OUTCOMES:
        data[kind] = outcome.count(kind) / len(outcome)
        data[f"{kind}_ci95"] = list(wilson_interval(outcome.count(kind), len(outcome)))
    return data


def tables(page: str) -> list[dict[str, dict[str, str]]]:
    """Every table of the page: method -> column -> cell."""
    found: list[dict[str, dict[str, str]]] = []
    titles: list[str] = []
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if line.startswith("| method"):
            titles = cells
            found.append({})
        elif line.startswith("| ") and not line.startswith("| ---"):
            found[-1][cells[0]] = dict(zip(titles, cells, strict=True))
    return found


def made(capsys, *words) -> str:
    """The page that the command prints."""
    capsys.readouterr()
    assert main(["table", *map(str, words)]) == 0
    return capsys.readouterr().out


def refusal(capsys, *words) -> str:
    """The one line with which the command refuses."""
    capsys.readouterr()
    assert main(["table", *map(str, words)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.strip().splitlines()
    return line


def interval(share: float, bounds: list[float]) -> str:
    return f"{100 * share:.1f} [{100 * bounds[0]:.1f}, {100 * bounds[1]:.1f}]"


def shares_by_view(data: dict) -> list[str]:
    """Success in per cent of the scenes whose goal starts within the 69.4 degrees of the camera, and of the others."""
    ended: dict[bool, list[bool]] = {True: [], False: []}
    for bearing, outcome in zip(data["per_episode"]["goal_bearing_deg"], data["per_episode"]["outcome"], strict=True):
        ended[abs(bearing) <= 34.7].append(outcome == "success")
    return [f"{100 * sum(ended[seen]) / len(ended[seen]):.1f}" for seen in (True, False)]


@pytest.mark.parametrize(("name", "title"), [("p", "P controller"), ("random", "random controller"), ("mlp", "mlp")])
def test_the_numbers_of_a_row_are_those_of_the_file(folder, capsys, name, title):
    names = ("mlp",) if name == "mlp" else ("p", "random")
    (table,) = tables(made(capsys, *(folder / f"{n}.json" for n in names)))
    row, data = table[title], read(folder / f"{name}.json")
    assert row["success [95 %]"] == interval(data["success"], data["success_ci95"])
    for kind in ("collision", "fall", "timeout"):
        assert row[kind] == f"{100 * data[kind]:.1f}"
    expected = {"SPL": ("spl", 3), "path ratio": ("path_ratio", 3), "time (s)": ("mean_time_s", 1)}
    for column, (key, digits) in {**expected, "clearance (m)": ("min_clearance_m", 3)}.items():
        assert row[column] == ("-" if data[key] is None else f"{data[key]:.{digits}f}")
    assert row["goal in view : out of view"] == " : ".join(shares_by_view(data))
    first = data["per_episode"]["outcome"][:30]
    counts = "/".join(str(first.count(kind)) for kind in ("collision", "fall", "timeout"))
    trials = next(cell for column, cell in row.items() if column.startswith("first 30 scenes"))
    assert trials.startswith(f"{100 * first.count('success') / 30:.1f} [")
    assert trials.endswith(f"] ({counts})")
    assert row["seeds"] == ("1 (7)" if name == "mlp" else "-")


def test_the_p_value_is_that_of_the_scenes_which_one_solved_and_the_other_not(folder, capsys):
    (table,) = tables(made(capsys, folder / "p.json", folder / "random.json"))
    ours, theirs = (read(folder / f"{name}.json")["per_episode"]["outcome"] for name in ("random", "p"))
    only_it = sum(a == "success" != b for a, b in zip(ours, theirs, strict=True))
    only_p = sum(b == "success" != a for a, b in zip(ours, theirs, strict=True))
    pairs, fewer = only_it + only_p, min(only_it, only_p)
    expected = 2 * sum(math.comb(pairs, k) for k in range(fewer + 1)) / 2**pairs
    p_value, counts = table["random controller"]["p against P (only it : only P)"].split(" ", 1)
    assert counts == f"({only_it} : {only_p})"
    assert float(p_value) == pytest.approx(expected, rel=0.06)  # two digits are printed
    assert table["P controller"]["p against P (only it : only P)"] == "-"
    assert "p against P (only it : only P)" not in tables(made(capsys, folder / "random.json"))[0]["random controller"]


def test_the_papers_trials_stand_beside_the_papers_scenes_only(folder, capsys):
    four, eight = tables(made(capsys, folder / "p8.json", folder / "p.json"))
    title = "paper, 30 trials [95 %] (coll./fall/timeout)"
    paper = {method: row[title] for method, row in four.items()}
    assert paper == {
        "P controller": "93.3 [79, 98] (2/0/0)",
        "cnn_lstm (paper)": "90.0 [74, 97] (0/0/3)",
        "cnn (paper)": "53.3 [36, 70] (0/2/12)",
        "cnn_lstm_raw (paper)": "60.0 [42, 75] (4/0/8)",
        "mlp (paper)": "failed to learn",
    }
    assert list(eight) == ["P controller"]
    assert title not in eight["P controller"]
    assert eight["P controller"]["collision"] == f"{100 * read(folder / 'p8.json')['collision']:.1f}"


def test_several_training_seeds_are_one_row_of_the_median_with_the_worst_beside_it(folder, capsys, tmp_path):
    mlp = read(folder / "mlp.json")
    for seed, successes in ((5, 20), (6, 30), (7, 24), (8, 33)):
        outcome = ["success"] * successes + ["timeout"] * (EPISODES - successes)
        training = {**mlp["training_config"], "seed": seed}
        data = with_outcomes(mlp, outcome, training_seed=seed, training_config=training)
        write(tmp_path / f"{seed}.json", data)
    three = [tmp_path / f"{seed}.json" for seed in (6, 5, 7)]
    other = write(tmp_path / "random.json", mlp | {"method": "random", "training_seed": None, "training_config": None})
    (table,) = tables(made(capsys, *three, other))
    assert table["mlp"]["seeds"] == "3 (5, 6, 7)"
    assert table["mlp"]["success [95 %]"].startswith("66.7 [")
    assert table["mlp"]["timeout"] == "33.3"
    assert table["mlp"]["worst seed [95 %]"] == f"{interval(20 / 36, list(wilson_interval(20, 36)))} (seed 5)"
    assert table["random controller"]["worst seed [95 %]"] == "-"
    (table,) = tables(made(capsys, *three, tmp_path / "8.json"))
    assert table["mlp"]["success [95 %]"].startswith("66.7 [")  # the lower one of the two in the middle
    longer = {**mlp["training_config"], "steps": 1_000_000}
    page = made(capsys, *three, write(tmp_path / "longer.json", mlp | {"training_config": longer}))
    rows = [line for line in page.splitlines() if line.startswith("| mlp |")]
    assert "decisions trained" in page
    assert len(rows) == 2  # another training is another method
    assert sum("| 1,000,000 |" in row for row in rows) == 1


def test_what_does_not_differ_is_no_column(folder, capsys, tmp_path):
    both = made(capsys, folder / "p.json", folder / "random.json")
    assert not {"physics", "renderer", "image", "preset"} & set(tables(both)[0]["P controller"])
    other = read(folder / "random.json") | {"physics_engine": "mjx"}
    (table,) = tables(made(capsys, folder / "p.json", write(tmp_path / "r.json", other)))
    assert [table[name]["physics"] for name in ("P controller", "random controller")] == ["native, 50 ms", "mjx, 50 ms"]
    assert "renderer" not in table["P controller"]
    page = made(capsys, folder / "random.json", tmp_path / "r.json")
    assert page.count("| random controller |") == 2


def test_a_folder_is_read_and_a_page_is_written(folder, capsys, tmp_path):
    for name in ("p", "random"):
        (tmp_path / f"{name}.json").write_text((folder / f"{name}.json").read_text())
    assert made(capsys, tmp_path, "--output", tmp_path / "results.md") == f"{tmp_path / 'results.md'}\n"
    page = (tmp_path / "results.md").read_text()
    assert page == made(capsys, tmp_path / "p.json", tmp_path / "random.json")
    for name in ("p", "random"):
        data = read(folder / f"{name}.json")
        assert f"{name}.json`: `{data['command']}` (jax {data['versions']['jax']}, " in page


def test_other_scenes_are_refused(folder, capsys, tmp_path):
    line = refusal(capsys, folder / "p.json", folder / "mlp.json")
    assert f"{folder / 'mlp.json'}: seed = 4: should be 3, as in {folder / 'p.json'}" in line

    p = read(folder / "p.json")
    fewer = write(tmp_path / "fewer.json", with_outcomes(p, p["per_episode"]["outcome"][:30]))
    assert f"{fewer}: episodes = 30: should be {EPISODES}" in refusal(capsys, folder / "random.json", fewer)

    said_to_be_3 = write(tmp_path / "relabelled.json", read(folder / "mlp.json") | {"seed": 3})
    line = refusal(capsys, folder / "random.json", said_to_be_3)
    assert f"{said_to_be_3}: shortest_path_m of scene 0 differs from" in line

    for part, field, value in (("scene", "goal_distance_max_m", 14.0), ("task", "max_decisions", 50)):
        changed = copy.deepcopy(p)
        changed["config"][part][field] = value
        line = refusal(capsys, folder / "random.json", write(tmp_path / "changed.json", changed))
        assert f"changed.json: {part}.{field} = {value}" in line


def test_the_same_twice_is_refused(folder, capsys, tmp_path):
    (tmp_path / "copy.json").write_text((folder / "mlp.json").read_text())
    line = refusal(capsys, folder / "mlp.json", tmp_path / "copy.json")
    assert "copy.json: should be left out" in line
    assert "mlp with training seed 7 too" in line


def removed(name):
    return lambda data: data.pop(name)


def changed(**fields):
    return lambda data: data.update(fields)


def changed_record(**fields):
    return lambda data: data["per_episode"].update(fields)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (removed("success"), "'success'"),
        (removed("per_episode"), "'per_episode'"),
        (removed("config"), "'config'"),
        (removed("training_seed"), "'training_seed'"),
        (changed(success=0.99), "success = 0.99"),
        (changed(success=math.nan), "success = nan"),
        (changed(success_ci95=[0.9, 1.0]), "success_ci95"),
        (changed(success_ci95=3), "p.json"),
        (changed(spl="high"), "spl = 'high'"),
        (changed(seed=True), "seed = True"),
        (changed(config={"wheels": 6}), "wheels"),
        (changed(config=None), "config"),
        (changed(training_config=[]), "training_config"),
        (changed(per_episode=[]), "p.json"),
        (changed(versions=None), "versions"),
        (changed_record(outcome=["success"] * EPISODES), "per_episode.outcome"),
        (changed_record(outcome="s" * EPISODES), "per_episode.outcome"),
        (changed_record(shortest_path_m=[1.0]), "per_episode.shortest_path_m"),
        (changed_record(goal_bearing_deg=["x"] * EPISODES), "per_episode.goal_bearing_deg"),
    ],
)
def test_a_damaged_evaluation_is_refused_by_its_name(folder, capsys, tmp_path, damage, says):
    data = read(folder / "p.json")
    damage(data)
    (tmp_path / "p.json").write_text(json.dumps(data))
    line = refusal(capsys, folder / "random.json", tmp_path / "p.json")
    assert str(tmp_path / "p.json") in line
    assert says in line


@pytest.mark.parametrize("content", [b"", b"[]", b"3", b"{", b"\xff\xfe", b"# a page"])
def test_what_is_no_evaluation_is_refused_by_its_name(folder, capsys, tmp_path, content):
    (tmp_path / "x.json").write_bytes(content)
    line = refusal(capsys, folder / "p.json", tmp_path / "x.json")
    assert f"{tmp_path / 'x.json'}: should be a file that segvisrl eval --json wrote" in line


def test_half_a_file_and_no_file_are_refused_by_their_names(folder, capsys, tmp_path):
    text = (folder / "p.json").read_text()
    (tmp_path / "half.json").write_text(text[: len(text) // 2])
    assert str(tmp_path / "half.json") in refusal(capsys, tmp_path / "half.json")
    assert str(tmp_path / "none.json") in refusal(capsys, tmp_path / "none.json")


def test_a_folder_of_runs_is_told_where_their_evaluations_are(tmp_path, capsys):
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "eval.json").touch()
    assert main(["table", str(tmp_path)]) == 2
    assert f"{tmp_path}: holds no evaluation; {tmp_path}/*/eval.json are those of runs" in capsys.readouterr().err


def test_nothing_to_read_and_nowhere_to_write(folder, capsys, tmp_path):
    assert "at least one file" in refusal(capsys)
    for empty in (tmp_path, tmp_path / "missing"):
        assert f"{empty}: holds no evaluation; segvisrl eval" in refusal(capsys, empty)
    for output in (folder / "p.json", tmp_path / "missing" / "x.md"):
        assert str(output) in refusal(capsys, folder / "p.json", "--output", output)


def test_a_policys_file_tells_its_training(folder):
    data, config = read(folder / "mlp.json"), preset_config("mlp", "smoke")
    assert data["training_seed"] == data["training_config"]["seed"] == 7
    assert data["training_config"]["steps"] == config.steps
    assert "runs_dir" not in data["training_config"]  # a path of the machine it was trained on
    assert len(data["policy_sha256"]) == 64
    assert data["versions"].keys() == {"jax", "mujoco", "segvisrl_jax"}
    assert data["versions"]["jax"] == jax.__version__
    assert data["wall_clock_s"] > 0
    p = read(folder / "p.json")
    assert p["training_seed"] is p["training_config"] is p["policy_sha256"] is p["renderer"] is None
    assert p["physics_engine"] == "native"


def test_the_recorded_command_asks_for_the_same_evaluation(folder):
    asked = EvalOptions(policy="a folder/policy", episodes=50, num_rocks=8, renderer="gl", slots=7, json=Path("x.json"))
    program, command, *words = shlex.split(command_line(asked))
    assert (program, command) == ("segvisrl", "eval")
    assert parse(EvalOptions, words, "eval") == EvalOptions(
        policy="a folder/policy", episodes=50, num_rocks=8, renderer="gl", slots=7
    )
    assert command_line(EvalOptions(controller="p")) == "segvisrl eval --controller p --episodes 1000 --seed 0"
    assert read(folder / "p.json")["command"] == f"segvisrl eval --controller p --episodes {EPISODES} --seed 3"


def test_shifted_conditions_are_asked_for_recorded_and_not_mixed_with_others(folder, tmp_path, capsys):
    words = ["--conditions.left-wheel-gain", "0.7", "--conditions.randomize"]
    shifted = tmp_path / "shifted.json"
    asked = ["--controller", "p", "--episodes", str(EPISODES), "--seed", "3", *words]
    assert main(["eval", *asked, "--json", str(shifted)]) == 0
    plain, data = read(folder / "p.json"), read(shifted)
    assert data["config"].pop("conditions") == {
        **plain["config"].pop("conditions"),
        "left_wheel_gain": 0.7,
        "randomize": True,
    }
    assert data["config"] == plain["config"]
    assert data["per_episode"]["path_length_m"] != plain["per_episode"]["path_length_m"]
    assert data["per_episode"]["shortest_path_m"] == plain["per_episode"]["shortest_path_m"]
    again = shlex.split(data["command"])[2:]
    assert parse(EvalOptions, again, "eval") == parse(EvalOptions, asked, "eval")
    line = refusal(capsys, folder / "random.json", shifted)
    assert f"{shifted}: conditions.randomize = True: should be False, as in {folder / 'random.json'}" in line


def test_random_headings_are_asked_for_recorded_and_not_mixed_with_others(folder, tmp_path, capsys):
    turned = tmp_path / "turned.json"
    asked = ["--controller", "p", "--episodes", str(EPISODES), "--seed", "3", "--random-start-yaw-share", "1"]
    assert main(["eval", *asked, "--json", str(turned)]) == 0
    plain, data = read(folder / "p.json"), read(turned)
    assert data["config"]["scene"] == {**plain["config"]["scene"], "random_start_yaw_share": 1}
    assert data["per_episode"]["shortest_path_m"] == plain["per_episode"]["shortest_path_m"]
    differ = np.subtract(data["per_episode"]["goal_bearing_deg"], plain["per_episode"]["goal_bearing_deg"])
    assert np.all(np.abs(differ) > 0.1)
    again = shlex.split(data["command"])[2:]
    assert parse(EvalOptions, again, "eval") == parse(EvalOptions, asked, "eval")
    assert f"{turned}: scene.random_start_yaw_share = 1" in refusal(capsys, folder / "random.json", turned)


def test_the_record_of_a_thousand_episodes_is_below_100_kilobytes(folder):
    text = (folder / "mlp.json").read_text()
    head, record = text.split('"per_episode"')
    assert len(head) + len(record) / EPISODES * 1000 < 100_000
    assert as_json(json.loads(text)) == text
