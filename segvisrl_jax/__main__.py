"""``python -m segvisrl_jax COMMAND ...``: the program, where ``segvisrl`` is not on the path."""

import sys

from segvisrl_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
