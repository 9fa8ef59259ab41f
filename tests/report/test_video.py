"""Videos decode to what was written; frames and top views show what they should, in place."""

import av
import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image, ImageColor

from segvisrl_jax.config import ConfigError
from segvisrl_jax.report import layout
from segvisrl_jax.report.layout import SceneMap
from segvisrl_jax.report.video import Pane, compose_frame, top_view_frame, write_video
from segvisrl_jax.vision.classes import PALETTE


def moving_square(num_frames=12, height=90, width=160):
    frames = np.full((num_frames, height, width, 3), PALETTE[1])
    for index in range(num_frames):
        frames[index, 20:52, 8 * index : 8 * index + 32] = PALETTE[2]
    return frames


def test_mp4_decodes_to_the_same_frames(tmp_path):
    frames = moving_square()
    path = write_video(tmp_path / "made" / "episode.mp4", frames, fps=5)
    decoded = iio.imread(path, plugin="pyav")
    assert decoded.shape == frames.shape
    difference = np.abs(decoded.astype(int) - frames)
    assert difference.mean() < 4
    middle = difference[:, 30:42]  # inside the square, away from edges, which lose half their colour
    for index, row in enumerate(middle):
        assert row[:, 8 * index + 8 : 8 * index + 24].max() < 16


def test_mp4_opens_in_a_browser(tmp_path):
    path = write_video(tmp_path / "episode.mp4", moving_square(), fps=5)
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate == 5
        assert stream.frames == 12
    data = path.read_bytes()
    assert 0 < data.find(b"moov") < data.find(b"mdat")  # the index is in front: starts while it loads


def test_odd_sizes_are_padded_and_frames_may_come_one_by_one(tmp_path):
    frames = moving_square(3, 91, 161)
    path = write_video(tmp_path / "odd.mp4", (frame for frame in frames), fps=4)
    assert iio.imread(path, plugin="pyav").shape == (3, 92, 162, 3)


def test_gif_keeps_colours_and_speed(tmp_path):
    frames = moving_square()
    path = write_video(tmp_path / "episode.gif", frames, fps=5)
    with Image.open(path) as image:
        assert image.n_frames == 12
        assert image.info["duration"] == 200
        assert image.info["loop"] == 0
        image.seek(7)
        np.testing.assert_allclose(np.asarray(image.convert("RGB"), int), frames[7], atol=6)


@pytest.mark.parametrize(
    ("name", "frames", "fps", "field"),
    [("a.avi", 1, 5, "path"), ("a.mp4", 1, 0, "fps"), ("a.mp4", 0, 5, "frames")],
)
def test_write_video_refuses(tmp_path, name, frames, fps, field):
    with pytest.raises(ConfigError, match=field):
        write_video(tmp_path / name, moving_square(frames), fps)
    assert not (tmp_path / name).exists()


def bounding_box(image, colour):
    """(top, left, bottom, right) of the pixels of exactly this colour."""
    rows, columns = np.nonzero((image == np.array(colour)).all(axis=-1))
    return rows.min(), columns.min(), rows.max() + 1, columns.max() + 1


def plain(height, width, colour):
    return np.full((height, width, 3), colour, np.uint8)


def test_panes_of_different_sizes_fill_a_frame():
    red, green, blue = (200, 0, 0), (0, 200, 0), (0, 0, 200)
    columns = [
        [Pane(plain(1080, 1920, red), "camera"), Pane(plain(27, 48, green), "observation")],
        [Pane(plain(600, 600, blue), "from above")],
    ]
    frame = compose_frame(columns, width_px=1000, title="An episode")
    assert frame.shape[1] == 1000
    assert frame.shape[0] % 2 == 0
    boxes = [bounding_box(frame, colour) for colour in (red, green, blue)]
    for (top, left, bottom, right), aspect in zip(boxes, (16 / 9, 16 / 9, 1), strict=True):
        assert (right - left) / (bottom - top) == pytest.approx(aspect, rel=0.01)
    assert abs(boxes[1][2] - boxes[2][2]) <= 3  # both columns end at the same height
    assert boxes[0][1] == boxes[1][1]
    assert 1000 - boxes[2][3] <= 14  # and the last one at the right margin
    assert boxes[0][2] < boxes[1][0]


def test_captions_and_title_are_written():
    image = plain(50, 100, (0, 0, 200))
    bare, captioned = (compose_frame([[Pane(image, text)]], 300) for text in ("", "camera"))
    assert bare.shape == captioned.shape
    assert (bare != captioned).any()
    assert compose_frame([[Pane(image)]], 300, title="t").shape[0] > bare.shape[0]


def test_small_images_show_their_pixels():
    image = PALETTE[np.array([[0, 1, 2, 3]] * 2)]
    frame = compose_frame([[Pane(image)]], width_px=400)
    inside = frame[100:150, 12:388].reshape(-1, 3)
    assert {tuple(pixel) for pixel in inside} == {tuple(colour) for colour in PALETTE}


@pytest.mark.parametrize("columns", [[], [[]]])
def test_compose_refuses_empty_columns(columns):
    with pytest.raises(ConfigError, match="columns"):
        compose_frame(columns)


def test_compose_refuses_what_does_not_fit():
    with pytest.raises(ConfigError, match="width_px"):
        compose_frame([[Pane(plain(10, 10, 0))]] * 20, width_px=100)


SCENE = SceneMap(np.array([-12.0, 0.0]), np.array([3.0, 4.0]), np.array([[5.0, -6.0]]), np.array([0.3]))
SIZE_PX, HALF_M = 524, 13.1  # 20 pixels a metre, with the margin around the map


def pixel(image, x, y):
    return tuple(int(value) for value in image[round((HALF_M - y) * 20), round((x + HALF_M) * 20)])


def rgb(colour):
    return ImageColor.getrgb(colour)


def test_top_view_shows_everything_where_it_is():
    trail = np.array([[-12.0, 0.0], [-8.0, 0.0], [-8.0, 5.0]])
    image = top_view_frame(SCENE, trail, 0.0, SIZE_PX)
    assert image.shape == (SIZE_PX, SIZE_PX, 3)
    assert pixel(image, 0, 0) == rgb(layout.GROUND)
    assert pixel(image, 12.9, 0) != rgb(layout.GROUND)  # beyond the edge
    assert pixel(image, 3, 4) == rgb(layout.GOAL)
    assert pixel(image, 5, -6) == rgb(layout.ROCK)
    assert pixel(image, -10, 0) == rgb(layout.PATHS[0])
    assert pixel(image, -8, 3) == rgb(layout.PATHS[0])
    circle = pixel(image, 3.8, 4)
    assert circle not in (rgb(layout.GROUND), rgb(layout.GOAL))
    assert pixel(image, 5.4, -6) not in (rgb(layout.GROUND), rgb(layout.ROCK))


@pytest.mark.parametrize("yaw_deg", [0, 90, 180, -90, 37])
def test_the_rovers_nose_points_along_its_heading(yaw_deg):
    yaw = np.radians(yaw_deg)
    image = top_view_frame(SCENE, np.zeros((1, 2)), float(yaw), SIZE_PX)
    ahead = 0.36 * np.array([np.cos(yaw), np.sin(yaw)])
    assert pixel(image, *ahead) == rgb("white")
    assert pixel(image, *(-ahead)) != rgb("white")


def test_top_view_refuses_an_empty_trail():
    with pytest.raises(ConfigError, match="trail_xy_m"):
        top_view_frame(SCENE, np.zeros((0, 2)), 0.0)
