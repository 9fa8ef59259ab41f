"""Pictures and videos of the report page as ``data:`` addresses: nothing on the page is a file of its own."""

import base64
import io
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from segvisrl_jax.report.episode import HOLD_FRAMES, Episode, EpisodeView
from segvisrl_jax.report.video import write_video
from segvisrl_jax.types import RoverState
from segvisrl_jax.vision.classes import PALETTE, SegmentationClass

Frame = UInt8[np.ndarray, "H W 3"]
Observe = Callable[[RoverState], Any]

FRAMES_PER_SECOND = 8
JPEG_QUALITY = 85
STEPS_BETWEEN_LOOKS = 4  # decisions, in the search for a moment with something to see


class Clip(NamedTuple):
    """A video and its last frame, as addresses, and the frame's size."""

    video: str
    poster: str
    width_px: int
    height_px: int


def film(view: EpisodeView, observe: Observe | None, episode: Episode, title: str) -> Clip:
    """An episode's video (H.264, the last frame held), frame by frame what ``segvisrl demo`` shows.

    Args:
        view: of the environment in which the episode was recorded.
        observe: from a state to the policy's image; None where it is given none.
        episode: recorded.
        title: what stands in every frame, before time and outcome.
    """
    last: list[Frame] = []

    def frames() -> Iterator[Frame]:
        for step in range(len(episode.xy_m)):
            state = episode.state(step)
            seen = None if observe is None else np.asarray(observe(state))
            last[:] = [view(state, episode.xy_m[: step + 1], seen, title)]
            yield last[0]
        yield from last * HOLD_FRAMES

    with tempfile.TemporaryDirectory() as folder:
        path = write_video(Path(folder) / "clip.mp4", frames(), FRAMES_PER_SECOND)
        video = _address("video/mp4", path.read_bytes())
    return Clip(video, jpeg(last[0]), last[0].shape[1], last[0].shape[0])


def jpeg(image: Frame) -> str:
    """A photograph-like image as an address."""
    return _image(image, "jpeg", quality=JPEG_QUALITY)


def png(image: Frame) -> str:
    """An image of few colours as an address, exact."""
    return _image(image, "png", optimize=True)


def _image(image: Frame, kind: str, **options: Any) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, kind, **options)
    return _address(f"image/{kind}", buffer.getvalue())


def _address(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


class Picture(NamedTuple):
    """One step of the preprocessing."""

    source: str
    caption: str
    width_px: int
    height_px: int


def telling_moment(view: EpisodeView, episodes: Sequence[Episode]) -> RoverState:
    """Of the episodes' states, looked at every few decisions, the one that shows most of both rocks and goal."""

    def worth(state: RoverState) -> int:
        image = np.asarray(view.segmented(state))
        kinds = (SegmentationClass.ROCK, SegmentationClass.GOAL)
        return min(int((image == PALETTE[kind]).all(-1).sum()) for kind in kinds)

    states = [one.state(step) for one in episodes for step in range(0, len(one.xy_m), STEPS_BETWEEN_LOOKS)]
    return max(states, key=worth)


def preprocessing_pictures(view: EpisodeView, state: RoverState, eyes: Mapping[str, Observe]) -> list[Picture]:
    """The camera's image, its segmentation, and what each policy is given in that state.

    Args:
        view: whose camera looks.
        state: where the rover is. Unbatched.
        eyes: from a state to a policy's image, by the names of the methods that are given it.
    """
    views = [
        ("Camera, in colour", jpeg, np.asarray(view.coloured(state))),
        ("Segmentation, four classes", png, np.asarray(view.segmented(state))),
    ]
    views += [(f"Input of {name}", png, np.asarray(observe(state))) for name, observe in eyes.items()]
    return [Picture(encode(image), name, image.shape[1], image.shape[0]) for name, encode, image in views]
