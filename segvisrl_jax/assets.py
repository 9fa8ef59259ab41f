"""Where the files that ship beside the code are: inside the wheel, or at the top of a checkout."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
DEFAULT_POLICY = "cnn_lstm"  # of those in pretrained/: drives where nobody says who


def asset_dir(name: str) -> Path:
    """The folder ``mjcf`` or ``pretrained``.

    Raises:
        FileNotFoundError: where neither the installed package nor a checkout holds it.
    """
    for place in (_PACKAGE / name, _PACKAGE.parent / name):
        if place.is_dir():
            return place
    raise FileNotFoundError(f"{name}/ is missing beside {_PACKAGE}; install segvisrl_jax again")
