"""The names that settings may take."""

from typing import Literal

Arch = Literal["cnn_lstm", "cnn", "cnn_lstm_raw", "mlp", "mlp_rocks"]
ObservationKind = Literal["segmentation", "rgb", "state", "state_and_rocks"]
RendererName = Literal["auto", "scanline", "gl", "warp"]
EngineName = Literal["auto", "native", "mjx"]
PresetName = Literal["paper", "cpu", "gpu", "smoke"]
LoggerName = Literal["wandb", "mlflow"]

ARCH_OBSERVATION: dict[str, ObservationKind] = {
    "cnn_lstm": "segmentation",
    "cnn": "segmentation",
    "cnn_lstm_raw": "rgb",
    "mlp": "state",
    "mlp_rocks": "state_and_rocks",
}
"""What each architecture reads."""
IMAGE_OBSERVATIONS: tuple[ObservationKind, ...] = ("segmentation", "rgb")
"""Those that are images; the others are vectors."""
