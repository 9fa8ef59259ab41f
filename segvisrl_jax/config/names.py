"""The names that settings may take."""

from typing import Literal

Arch = Literal["cnn_lstm", "cnn", "cnn_lstm_raw", "mlp"]
ObservationKind = Literal["segmentation", "rgb", "state"]
RendererName = Literal["auto", "scanline", "gl", "warp"]
EngineName = Literal["auto", "native", "mjx"]
PresetName = Literal["paper", "cpu", "gpu", "smoke"]

ARCH_OBSERVATION: dict[str, ObservationKind] = {
    "cnn_lstm": "segmentation",
    "cnn": "segmentation",
    "cnn_lstm_raw": "rgb",
    "mlp": "state",
}
"""What each architecture reads."""
