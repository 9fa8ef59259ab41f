"""``segvisrl view``: mistakes get one line; in a real browser the page drives, listens to keys, and lets one drag."""

import functools
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from segvisrl_jax.cli import main
from segvisrl_jax.commands import view
from segvisrl_jax.types import Outcome

pytest.importorskip("viser", reason='viser is not installed: pip install "segvisrl_jax[view]"')

from segvisrl_jax.view.panel import state_table

ROOT = Path(__file__).parents[2]
PATIENCE_S = 90  # drawing 3-D without a GPU is slow beside other work
WINDOW_PX = (1000, 640)
SETTLING_S = 1.5  # until a browser shows what it was sent


def wait_for(is_so, what: str) -> None:
    until = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < until, what
        time.sleep(0.05)


@pytest.fixture(scope="module")
def viewer():
    """A page whose loop runs, as the command's does."""
    opened = view.open_viewer(view.ViewOptions(scene=7, num_rocks=3, port=0))
    stop = threading.Event()
    loop = threading.Thread(target=opened.run, args=(stop,))
    loop.start()
    yield opened
    stop.set()
    loop.join()
    opened.close()


def url(viewer) -> str:
    return f"http://127.0.0.1:{viewer.server.get_port()}"


@pytest.mark.slow
def test_the_page_is_served_and_nothing_drives_while_nobody_looks(viewer):
    page = urllib.request.urlopen(url(viewer)).read()
    assert b"<script" in page
    assert viewer.session.time_s == 0


def chromium_and_driver() -> tuple[str, str]:
    pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    binary = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not (binary and driver):
        pytest.skip("no chromium with chromedriver on the path (Debian: chromium and chromium-driver)")
    return binary, driver


@pytest.fixture(scope="module")
def browser(viewer):
    binary, driver = chromium_and_driver()
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = binary
    size = "--window-size={},{}".format(*WINDOW_PX)
    for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader", size):
        options.add_argument(word)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    chrome.get(url(viewer))
    wait_for(lambda: viewer.session.time_s >= 1, "the browser looks")
    yield chrome
    chrome.quit()


def keys(browser, *pressed: str, held_s: float = 0.0) -> None:
    from selenium.webdriver import ActionChains

    chain = ActionChains(browser)
    for key in pressed:
        chain.key_down(key).pause(held_s).key_up(key)
    chain.perform()


CANVAS = """
const box = [...document.querySelectorAll('canvas')].map(one => one.getBoundingClientRect())
  .reduce((most, one) => one.width * one.height > most.width * most.height ? one : most);
return [box.left, box.top, box.width, box.height];
"""


def on_page(viewer, browser, xyz_m) -> np.ndarray:
    """Where a point of the scene is on the page, in CSS pixels (x, y)."""
    [client] = viewer.server.get_clients().values()
    left, top, width, height = browser.execute_script(CANVAS)
    place = np.array(xyz_m) + viewer.stage.offset_m - client.camera.position
    w, x, y, z = client.camera.wxyz  # x to the right, y down, z ahead
    right, down, ahead = Rotation.from_quat([x, y, z, w]).as_matrix().T @ place
    focal_px = height / 2 / np.tan(client.camera.fov / 2)
    return np.array([left + width / 2 + focal_px * right / ahead, top + height / 2 + focal_px * down / ahead])


def mouse(browser, *places) -> None:
    """Presses at the first place, goes over the others, lets go at the last."""
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.action_builder import ActionBuilder

    builder = ActionBuilder(browser, duration=100)
    pointer = builder.pointer_action
    for number, (x, y) in enumerate(places):
        pointer.move_to_location(round(x), round(y))
        pointer.pause(0.5)
        if number == 0:
            pointer.pointer_down()
            pointer.pause(0.3)
    pointer.pointer_up()
    builder.perform()
    ActionChains(browser).reset_actions()


def camera_place(viewer) -> np.ndarray:
    [client] = viewer.server.get_clients().values()
    return np.array([*client.camera.position, *client.camera.look_at])


@pytest.mark.slow
def test_the_policy_drives_while_a_browser_looks(viewer, browser):
    seen, began_s = viewer.panel.seen.image, viewer.session.time_s
    wait_for(lambda: viewer.session.time_s >= began_s + 4, "the policy drives")
    assert viewer.session.policy_drove
    assert not np.array_equal(viewer.panel.seen.image, seen)
    picture = np.asarray(Image.open(BytesIO(browser.get_screenshot_as_png())).convert("RGB"))
    colours, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
    assert len(colours) > 500
    assert counts.max() < 0.7 * counts.sum()
    severe = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert severe == []


@pytest.mark.slow
def test_keys_pause_drive_and_leave_the_camera_alone(viewer, browser):
    from selenium.webdriver.common.keys import Keys

    keys(browser, " ")
    wait_for(lambda: viewer.is_paused and not viewer.is_moving, "the space key pauses")
    keys(browser, "r")
    wait_for(lambda: viewer.session.time_s == 0, "R restarts")
    camera = camera_place(viewer)
    keys(browser, Keys.ARROW_LEFT, held_s=0.5)
    keys(browser, "n")
    wait_for(lambda: viewer.session.time_s == 1, "N makes one decision")
    assert not viewer.session.policy_drove
    assert np.allclose(viewer.session.command, [0.2, 1.0])
    time.sleep(SETTLING_S)
    np.testing.assert_allclose(camera_place(viewer), camera, atol=0.01)


@pytest.mark.slow
def test_a_rock_is_clicked_dragged_and_hit(viewer, browser):
    keys(browser, "r")
    wait_for(lambda: viewer.session.time_s == 0 and not viewer.is_moving, "R restarts")
    x, y = np.asarray(viewer.session.rover.physics.qpos[:2])
    place = (x + 2.0, y + 0.2)
    viewer.drag("rock 2", place)
    wait_for(lambda: np.allclose(viewer.session.scene.rock_xy_m[1], place), "the rock is moved")
    time.sleep(SETTLING_S)
    mouse(browser, on_page(viewer, browser, (*place, 0.1)))
    wait_for(lambda: viewer.stage.picked == "rock 2", "a click picks the rock")
    time.sleep(SETTLING_S)
    along_x = [on_page(viewer, browser, (x + ahead, y + 0.2, 0.0)) for ahead in (2.7, 2.0, 1.0)]
    mouse(browser, *along_x)  # the gizmo's arrow along x, by 1.7 m
    wait_for(lambda: viewer.session.rock_distance_m < 0.5, "the rock is dragged to the rover")
    keys(browser, "n")
    wait_for(lambda: viewer.session.is_over, "the next decision ends the episode")
    assert viewer.session.outcome == Outcome.COLLISION
    assert "collision" in state_table(viewer.session, viewer.is_paused)


@pytest.mark.slow
def test_widgets_change_who_drives_and_the_scene(viewer, browser):
    keys(browser, "p")
    wait_for(lambda: not viewer.panel.policy_drives, "P takes the policy off")
    boxes = browser.find_elements("css selector", "input")
    [number] = [box for box in boxes if box.get_attribute("value") == "7"]
    number.send_keys("\b8\n")
    wait_for(lambda: viewer.session.number == 8 and not viewer.session.is_over, "another scene")
    left, top, width, height = browser.execute_script(CANVAS)
    mouse(browser, (left + width / 2, top + 0.9 * height))  # keys go to the 3-D view again
    keys(browser, "n")
    wait_for(lambda: viewer.session.time_s == 1, "N makes one decision")
    assert not viewer.session.policy_drove
    assert np.array_equal(viewer.session.command, [0, 0])  # the sliders


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--port", "99999"], ["--port", "99999", "65535"]),
        (["--scene", "-1"], ["--scene", "-1"]),
        (["--host", "192.0.2.1"], ["--host", "192.0.2.1"]),
        (["--host", "no.such.host.invalid"], ["--host", "no.such.host.invalid"]),
        (["--policy", "nowhere"], ["nowhere", "policy.json"]),
        (["--policy", "cnn", "--run", "runs/x"], ["--run, --policy", "exactly one"]),
    ],
)
def test_mistakes_get_one_line(words, says, capsys):
    assert main(["view", *words]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    for part in says:
        assert part in line


def test_a_port_in_use_gets_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", "--port", str(port)]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert f"127.0.0.1:{port}" in line
    assert "in use" in line


@pytest.mark.slow
def test_ctrl_c_ends_it_quietly():
    """One line, with the address, and exit code 0."""
    command = [sys.executable, "-m", "segvisrl_jax.cli", "view", "--policy", "mlp", "--port", "0"]
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # what runs in the background ignores it
    program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    line = program.stdout.readline()
    assert line.startswith("http://127.0.0.1:"), line
    program.send_signal(signal.SIGINT)
    rest, errors = program.communicate(timeout=PATIENCE_S)
    assert (rest.strip(), errors) == ("", "")
    assert program.returncode == 0


@pytest.mark.slow
def test_the_picture_in_the_readme_can_be_taken_again(tmp_path):
    chromium_and_driver()
    command = [sys.executable, "experiments/view_picture.py", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=4 * PATIENCE_S)
    assert done.returncode == 0, done.stderr[-3000:]
    picture = np.asarray(Image.open(tmp_path / "view.png"))
    assert picture.shape[1] > 1000
    assert picture.std(axis=(0, 1)).min() > 10
