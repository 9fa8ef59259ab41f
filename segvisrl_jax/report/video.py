"""Videos: frames of captioned panes, a top view drawn without OpenGL, and MP4 or GIF files.

Images are uint8 RGB arrays (H, W, 3). This file draws with PIL and runs no simulation.
"""

import functools
import itertools
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as iio
import numpy as np
from imageio.plugins.pyav import PyAVPlugin
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from segvisrl_jax.config import require
from segvisrl_jax.report import layout
from segvisrl_jax.report.layout import SceneMap
from segvisrl_jax.training.output import write_output

Frame = UInt8[np.ndarray, "H W 3"]

BACKGROUND, TEXT, FAINT = "#16181d", "#f2f2f2", "#9aa0aa"
MARGIN_PX, CAPTION_PX = 10, 26
TITLE_PX = 40
OVERSAMPLING = 2  # the top view is drawn this much larger and shrunk: smooth edges
ROVER_SIZE_M = (0.5, 0.4)  # length over the wheels, width over the wheels, rounded up to be seen
MAP_MARGIN_M = 0.6  # around the map, so that a fall over the edge is seen
SCALE_BAR_M = 5.0
MUCH_LARGER = 1.5  # from here on an enlarged image shows its pixels
MPEG_BLOCK_PX = 2  # yuv420p halves the colour planes: sizes must be even


class Pane(NamedTuple):
    """One image of a frame and what stands above it."""

    image: Frame
    caption: str = ""


def write_video(path: Path, frames: Iterable[Frame], fps: float | int) -> Path:
    """Writes frames to an MP4 (H.264, yuv420p, index in front: for browsers) or a looping GIF.

    Args:
        path: ends in ``.mp4`` or ``.gif``; its folder is made if it is missing.
        frames: images of one size, as an array (T, H, W, 3) or one after another. An MP4 repeats
            the last row or column of odd sizes.
        fps: frames per second.

    Raises:
        ConfigError: for another suffix, a rate that is not positive, or no frames.
    """
    path = Path(path)
    require(path.suffix in (".mp4", ".gif"), "path", str(path), "a name that ends in .mp4 or .gif")
    require(fps > 0, "fps", fps, "positive")
    remaining = iter(frames)
    begin = list(itertools.islice(remaining, 1))
    require(len(begin) == 1, "frames", "none", "at least one")
    path.parent.mkdir(parents=True, exist_ok=True)
    write = _write_mp4 if path.suffix == ".mp4" else _write_gif
    with tempfile.TemporaryDirectory() as folder:  # FFmpeg goes back to a file's beginning, by its name
        made = Path(folder) / f"video{path.suffix}"
        write(made, itertools.chain(begin, remaining), float(fps))
        write_output(path, made.read_bytes())
    return path


def _write_mp4(path: Path, frames: Iterable[Frame], fps: float) -> None:
    options = {"movflags": "+faststart"}
    with iio.imopen(path, "w", plugin=PyAVPlugin, options=options) as file:
        file.init_video_stream("libx264", fps=fps, pixel_format="yuv420p")
        for frame in frames:
            odd = [(0, -size % MPEG_BLOCK_PX) for size in frame.shape[:2]]
            file.write_frame(np.pad(frame, [*odd, (0, 0)], mode="edge"))


def _write_gif(path: Path, frames: Iterable[Frame], fps: float) -> None:
    images = (Image.fromarray(frame).quantize(dither=Image.Dither.NONE) for frame in frames)
    first = next(images)
    first.save(path, save_all=True, append_images=images, duration=round(1000 / fps), loop=0)


def compose_frame(columns: Sequence[Sequence[Pane]], width_px: int = 1200, title: str = "") -> Frame:
    """Lays panes out in columns of equal height that fill the frame's width.

    Args:
        columns: panes from left to right, and from top to bottom in each column. Panes of a
            column get one width; images keep their aspect. Small ones are enlarged unsmoothed.
        width_px: width of the frame. Its height follows from the panes' shapes, and so is the same
            for all frames of a video.
        title: what stands on top; "" leaves the line out.

    Returns:
        The frame, with even sizes.
    """
    require(len(columns) > 0 and all(columns), "columns", len(columns), "at least one, none empty")
    widths, height = _column_widths(columns, width_px)
    top = TITLE_PX if title else 0
    size = (width_px + width_px % 2, top + height + (top + height) % 2)
    frame = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(frame)
    draw.text((MARGIN_PX, TITLE_PX / 2), title, TEXT, _font(20), anchor="lm")
    left = MARGIN_PX
    for column, width in zip(columns, widths, strict=True):
        _draw_column(frame, draw, column, left, top, width)
        left += width + MARGIN_PX
    return np.asarray(frame)


def _column_widths(columns: Sequence[Sequence[Pane]], width_px: int) -> tuple[list[int], int]:
    """Widths at which all columns are equally high and fill the frame, and that height.

    A column of width w is w s + k high: s sums its images' height / width, k its captions and gaps.
    """
    slope = np.array([sum(p.image.shape[0] / p.image.shape[1] for p in c) for c in columns])
    fixed = np.array([len(c) * (CAPTION_PX + MARGIN_PX) for c in columns])
    available = width_px - MARGIN_PX * (len(columns) + 1)
    height = (available + (fixed / slope).sum()) / (1 / slope).sum()
    widths = np.floor((height - fixed) / slope).astype(int)
    should = f"more than {width_px}: too many panes for this width"
    require(bool((widths > 0).all()), "width_px", width_px, should)
    return widths.tolist(), round(height)


def _draw_column(
    frame: Image.Image,
    draw: ImageDraw.ImageDraw,
    panes: Sequence[Pane],
    left: int,
    top: int,
    width: int,
) -> None:
    for pane in panes:
        rows, columns = pane.image.shape[:2]
        height = round(width * rows / columns)
        draw.text((left, top + CAPTION_PX / 2), pane.caption, TEXT, _font(15), anchor="lm")
        image = Image.fromarray(pane.image).resize((width, height), _smoothing(width / columns))
        frame.paste(image, (left, top + CAPTION_PX))
        top += CAPTION_PX + height + MARGIN_PX


def _smoothing(enlargement: float) -> Image.Resampling:
    """Shrinks by averages, enlarges a little smoothly, and shows the pixels of what is small."""
    if enlargement <= 1:
        return Image.Resampling.BOX
    return Image.Resampling.NEAREST if enlargement >= MUCH_LARGER else Image.Resampling.BICUBIC


def top_view_frame(
    scene: SceneMap,
    trail_xy_m: Float[np.ndarray, "T 2"],
    yaw_rad: float,
    size_px: int = 600,
) -> Frame:
    """The scene from above, x to the right and y up, with the rover at the end of its trail.

    Args:
        scene: what is drawn.
        trail_xy_m: where the rover has been, in order; the last row is where it is.
        yaw_rad: its heading, from x towards y.
        size_px: side of the square image.
    """
    require(len(trail_xy_m) > 0, "trail_xy_m", "no points", "at least where the rover is")
    view = _View(scene.map_half_size_m + MAP_MARGIN_M, size_px * OVERSAMPLING)
    image = _background(view, scene)
    draw = ImageDraw.Draw(image)
    trail = view.pixels(trail_xy_m)
    if len(trail) > 1:
        draw.line(trail, layout.PATHS[0], width=round(view.metre_px * 0.12), joint="curve")
    _draw_rover(draw, view, trail_xy_m[-1], yaw_rad)
    return np.asarray(image.reduce(OVERSAMPLING))


class _View(NamedTuple):
    """From metres to pixels."""

    half_size_m: float
    size_px: int

    @property
    def metre_px(self) -> float:
        return self.size_px / (2 * self.half_size_m)

    def pixels(self, xy_m: Float[np.ndarray, "T 2"]) -> list[tuple[float, float]]:
        """Points as PIL wants them: columns and rows."""
        scaled = (np.asarray(xy_m, float) * [1, -1] + self.half_size_m) * self.metre_px
        return [(float(x), float(y)) for x, y in scaled]

    def box(self, centre_m: Float[np.ndarray, "2"], radius_m: float) -> list[tuple[float, float]]:
        """Corners of the square around a circle."""
        return self.pixels(np.array(centre_m) + radius_m * np.array([[-1.0, 1.0], [1.0, -1.0]]))


def _background(view: _View, scene: SceneMap) -> Image.Image:
    """All that does not move."""
    image = Image.new("RGB", (view.size_px, view.size_px), BACKGROUND)
    draw = ImageDraw.Draw(image)
    middle = np.zeros(2)
    draw.rectangle(view.box(middle, scene.map_half_size_m), layout.GROUND)
    thin = max(1, round(view.metre_px * 0.05))
    draw.ellipse(view.box(scene.goal_xy_m, scene.goal_radius_m), "#b5ddd0", layout.GOAL, thin)
    draw.ellipse(view.box(scene.goal_xy_m, 0.25), layout.GOAL)
    for centre in scene.rock_xy_m:
        limit = view.box(centre, scene.collision_radius_m)
        draw.ellipse(limit, "#f0cdb5", layout.COLLISION, thin)
    for centre, radius in zip(scene.rock_xy_m, scene.rock_radius_m, strict=True):
        draw.ellipse(view.box(centre, float(radius)), layout.ROCK)
    _draw_scale_bar(draw, view, scene.map_half_size_m)
    return image


def _draw_scale_bar(draw: ImageDraw.ImageDraw, view: _View, half_size_m: float) -> None:
    """A bar of 5 m (less on a small map) in the lower left corner."""
    length = min(SCALE_BAR_M, half_size_m)
    start = np.array([-half_size_m + 0.05 * half_size_m] * 2)
    ends = view.pixels(start + np.array([[0.0, 0.0], [length, 0.0]]))
    draw.line(ends, layout.ROCK, width=max(2, view.size_px // 200))
    middle = ((ends[0][0] + ends[1][0]) / 2, ends[0][1] - view.size_px / 100)
    draw.text(middle, f"{length:g} m", layout.ROCK, _font(view.size_px // 40), anchor="mb")


def _draw_rover(draw: ImageDraw.ImageDraw, view: _View, xy_m: Float[np.ndarray, "2"], yaw_rad: float) -> None:
    """A rectangle of the rover's size, and a wedge ahead of it."""
    length, width = ROVER_SIZE_M
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    body = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length / 2, width / 2]
    nose = np.array([[length, 0], [length / 2, width / 2], [length / 2, -width / 2]])
    draw.polygon(view.pixels(body @ turn + xy_m), layout.PATHS[0], "white", 2)
    draw.polygon(view.pixels(nose @ turn + xy_m), "white")


@functools.lru_cache
def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size_px)
