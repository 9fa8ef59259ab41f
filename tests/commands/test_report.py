"""The report page: complete in itself, says what was driven, and a browser shows all of it at any width."""

import json
import shutil
import time
from html.parser import HTMLParser
from pathlib import Path

import jax
import pytest

from segvisrl_jax.agent.networks import make_network
from segvisrl_jax.cli import main
from segvisrl_jax.config import preset_config, replace_fields, to_dict
from segvisrl_jax.env.rover_env import observation_shape
from segvisrl_jax.training.checkpoint import save_policy

SECTIONS = ["results", "learning", "paths", "outcomes", "failures", "input", "settings", "machine", "again"]
VOID = {"meta", "link", "img", "br", "line", "circle"}
MOST_BYTES = 12e6


def write_run(folder: Path, arch: str, seed: int = 0, has_metrics: bool = True, **settings) -> Path:
    """A run's folder as training leaves it, with an untrained policy whose episodes end soon."""
    small = {"max_decisions": 5, "channels": (2,), "blocks_per_stage": 0, "feature_size": 8, "lstm_size": 8}
    config = replace_fields(preset_config(arch, "smoke"), seed=seed, run=folder.name, **small, **settings)
    network = make_network(arch, config.network, observation_shape(config.env))
    save_policy(folder / "policy", config, network.init(jax.random.key(seed)), {})
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    rows = [{"step": 100 * n, "episode/return": 9.0 * n, "evaluation/success": 0.1 * n} for n in range(1, 6)]
    rows[-1]["time/seconds"] = 75.0
    if has_metrics:
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    runs = [write_run(folder / "blind", "mlp"), write_run(folder / "seeing<b>", "cnn_lstm", has_metrics=False)]
    words = [*map(str, runs), "-o", str(folder / "page.html"), "--episodes", "2", "--num-rocks", "3", "--videos", "2"]
    assert main(["report", *words]) == 0
    return folder / "page.html"


class Outline(HTMLParser):
    """Tags in their order, whether they close where they should, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.open: list[str] = []
        self.words = ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words += f" {data}"

    def named(self, *names) -> list[dict]:
        return [attributes for tag, attributes in self.tags if tag in names]


def test_the_page_needs_no_other_file_and_no_script(page):
    text = page.read_text()
    outline = Outline(text)
    assert len(text) < MOST_BYTES
    assert not outline.named("script", "iframe", "object", "base")
    links = [a[key] for _, a in outline.tags for key in ("src", "href", "poster", "xlink:href") if key in a]
    assert len(links) > 10
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "@import" not in text
    assert "url(http" not in text
    ids = [a["id"] for _, a in outline.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert {link[1:] for link in links if link.startswith("#")} <= set(ids)


def test_sections_stand_in_their_order_and_say_what_was_driven(page):
    outline = Outline(page.read_text())
    assert [a["id"] for a in outline.named("section")] == SECTIONS
    words = " ".join(outline.words.split())
    assert "2 runs on the same test scenes" in words
    assert "reaches the goal in 0 of 2 test scenes" in words
    assert "2 test scenes (seed 0) with 3 rocks" in words
    assert "seeing<b>" in words  # escaped
    assert "metrics.jsonl): seeing<b>" in words
    assert "4 episodes of the trained policies failed; shown are 2" in words
    assert "What went wrong" in words
    assert "27.0" not in words
    assert "74.4 to 96.5" not in words  # the paper's 27 of 30, which were among 4 rocks
    assert "in 1 minutes" in words
    assert "env.task.max_decisions 5 100" in words
    assert "segvisrl eval --run" in words
    assert "--seed 0 --env.task.max-decisions 5 --network.channels 2" in words
    assert "P controller" not in words  # its world has other rules


def test_pictures_have_texts_and_videos_are_quiet(page):
    outline = Outline(page.read_text())
    assert all(a["alt"] for a in outline.named("img"))
    assert len(outline.named("img")) == 3  # camera, segmentation, input of cnn_lstm
    assert all(a.get("aria-label") for a in outline.named("svg"))
    videos = outline.named("video")
    assert len(videos) == 2
    for video in videos:
        assert {"muted", "loop", "playsinline", "controls"} <= set(video)
        assert video["preload"] == "metadata"
        assert video["src"].startswith("data:video/mp4;base64,")


@pytest.fixture(scope="module")
def browser():
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    binary = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not (binary and driver):
        pytest.skip("no chromium with chromedriver on the path (Debian: chromium and chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(word)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield chrome
    chrome.quit()


SIZES = """
for (const one of document.querySelectorAll('details')) one.open = true;
return [...document.querySelectorAll('img, svg, video')].map(one => {
  one.scrollIntoView();
  const box = one.getBoundingClientRect();
  const loads = one.tagName === 'IMG' ? one.complete && one.naturalWidth > 0 : true;
  return [one.tagName, box.width, box.height, one.checkVisibility() && loads];
});
"""
READY = "return [...document.querySelectorAll('video')].every(one => one.readyState >= 1 && !one.error)"
OVERFLOW = "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
BACKGROUND = "return getComputedStyle(document.body).backgroundColor"


@pytest.mark.parametrize("width", [375, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_shows_everything(page, browser, width, scheme):
    metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    browser.get(page.as_uri())
    sizes = browser.execute_script(SIZES)
    assert {tag.upper() for tag, *_ in sizes} == {"IMG", "SVG", "VIDEO"}
    for tag, across, high, is_visible in sizes:
        assert across > 8, tag
        assert high > 8, tag
        assert is_visible, tag
    until = time.monotonic() + 20
    while not browser.execute_script(READY) and time.monotonic() < until:
        time.sleep(0.1)
    assert browser.execute_script(READY)
    assert browser.execute_script(OVERFLOW) == 0
    red = int(browser.execute_script(BACKGROUND).removeprefix("rgb(").split(",")[0])
    assert (red > 200) == (scheme == "light")
    assert browser.get_log("browser") == []


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nowhere"], ["nowhere", "policy/policy.json"]),
        (["a", "b/a"], ["RUN", "different names"]),
        (["a", "-o", "page.pdf"], ["--output", "page.pdf", ".html"]),
        (["a", "--episodes", "0"], ["--episodes", "0"]),
        (["a", "--videos", "7"], ["--videos", "7", "[0, 6]"]),
    ],
)
def test_mistakes_get_one_line(words, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["report", *words]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    for part in says:
        assert part in line
    assert list(tmp_path.iterdir()) == []


def test_runs_that_may_not_be_compared_are_refused(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, twin = (write_run(Path(name), "mlp") for name in ("first", "twin"))
    assert main(["report", str(first), str(twin)]) == 2
    assert "twin" in (said := capsys.readouterr().err)
    assert "first is the same method with seed 0 too" in said
    other = write_run(Path("other"), "mlp", seed=1, goal_radius_m=0.5)
    assert main(["report", str(first), str(other)]) == 2
    assert "other: task.goal_radius_m = 0.5: should be 1.0, as in first" in capsys.readouterr().err
