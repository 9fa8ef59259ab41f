"""What several commands take on their command lines."""

from pathlib import Path
from typing import Annotated

import tyro

from segvisrl_jax.config import run_folder

RunFolder = Annotated[
    Path,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="RUN",
        instance_from_str=lambda words: run_folder(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda path: [str(path)],
    ),
]
"""A run's folder, or its name where it is in ``runs/``."""
