# %% [markdown]
# # The viewer's page
# Opens `segvisrl view` in Chromium without a window, lets `cnn_lstm` drive for some seconds, and takes a picture.
#
# `python experiments/view_picture.py [OUTPUT_FOLDER]`, by default figures; needs the extra `view`, selenium, and
# Chromium with chromedriver. It takes about a minute. Writes view.png.

# %%
import shutil
import sys
import threading
import time
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from selenium import webdriver

from segvisrl_jax.commands.view import ViewOptions, open_viewer
from segvisrl_jax.view.stage import rock_name

IS_SCRIPT = "__file__" in globals()
OUTPUT = Path(sys.argv[1]) if IS_SCRIPT and len(sys.argv) > 1 else Path("figures")
OUTPUT.mkdir(parents=True, exist_ok=True)
SCENE, NUM_ROCKS, DRIVEN_S = 28, 16, 27
WINDOW_PX = (1480, 1000)
SETTLING_S = 8  # for the last images to arrive, and for a processor to draw what a graphics card draws at once
CLOSE_NOTE = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(one => one.click())"

# %% The page, and a browser that looks at it
viewer = open_viewer(ViewOptions(scene=SCENE, num_rocks=NUM_ROCKS, port=0))
stop = threading.Event()
loop = threading.Thread(target=viewer.run, args=(stop,), daemon=True)
loop.start()
options = webdriver.ChromeOptions()
options.binary_location = shutil.which("chromium") or shutil.which("google-chrome") or ""
size = "--window-size={},{}".format(*WINDOW_PX)
for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader", size):
    options.add_argument(word)
browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
browser.get(f"http://127.0.0.1:{viewer.server.get_port()}")

# %% It drives; the loop ends between two frames, and the page keeps what it shows
while loop.is_alive() and viewer.session.time_s < DRIVEN_S and not viewer.session.is_over:
    time.sleep(0.05)
stop.set()
loop.join()
scene = viewer.session.scene
picked = rock_name(int(np.argmin(np.linalg.norm(np.asarray(scene.rock_xy_m - scene.goal_xy_m), axis=1))))
viewer.stage.pick(picked)
viewer.panel.show_picked(picked)
browser.execute_script(CLOSE_NOTE)
time.sleep(SETTLING_S)
picture = Image.open(BytesIO(browser.get_screenshot_as_png())).convert("RGB")
picture.save(OUTPUT / "view.png", optimize=True)
browser.quit()
viewer.close()
print(OUTPUT / "view.png")
