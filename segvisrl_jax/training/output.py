"""Files that a user asked for: whole, or as they were before."""

from pathlib import Path

from segvisrl_jax.config import NotWrittenError
from segvisrl_jax.training.manifest import replace_file


def write_output(path: Path, content: str | bytes) -> None:
    """Writes a file whole in place of an older one; what is no plain file (``/dev/stdout``, a pipe) is written to.

    Raises:
        NotWrittenError: where it cannot be; an older file is as it was, and nothing half-written is left.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        if path.exists() and (not path.is_file() or path.is_relative_to("/dev")):
            path.write_bytes(data)
        else:
            replace_file(path.resolve(), lambda file: file.write(data))
    except BrokenPipeError:
        raise
    except OSError as error:
        raise NotWrittenError(error.errno, error.strerror or str(error), str(path)) from error
