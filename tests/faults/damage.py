"""Files made worse in every way that disks and people know: what must never be loaded without a word."""

import os
import random
from collections.abc import Callable, Iterator
from pathlib import Path

NUM_FLIPS = int(os.environ.get("NUM_FLIPS", "1"))  # bits of each file that are flipped, one at a time
Damage = Callable[[Path, Path], None]


def truncate(file: Path, other: Path) -> None:
    """Leaves the first half."""
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])


def empty(file: Path, other: Path) -> None:
    """Leaves nothing."""
    file.write_bytes(b"")


def delete(file: Path, other: Path) -> None:
    """Leaves no file."""
    file.unlink()


def swap(file: Path, other: Path) -> None:
    """Puts the same file of another run in its place."""
    file.write_bytes(other.read_bytes())


def flip(seed: int) -> Damage:
    """Flips one bit."""

    def damage(file: Path, other: Path) -> None:
        whole = bytearray(file.read_bytes())
        bit = random.Random(f"{seed} {file.name}").randrange(8 * len(whole))
        whole[bit // 8] ^= 1 << bit % 8
        file.write_bytes(whole)

    return damage


DAMAGES: dict[str, Damage] = {"truncated": truncate, "emptied": empty, "deleted": delete, "swapped": swap} | {
    f"bit {i} flipped": flip(i) for i in range(NUM_FLIPS)
}


def cases(folder: Path, others: Path) -> Iterator[tuple[str, str]]:
    """(a file's name in the folder, a kind of damage) for every file and kind that changes something.

    Args:
        folder: what is going to be damaged.
        others: a folder of the same kind from another run; its file of the same name is what is swapped in.
    """
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        name, size = file.relative_to(folder).as_posix(), file.stat().st_size
        twin = others / name
        for kind in DAMAGES:
            changes_nothing = size == 0 and kind != "deleted"
            has_no_other = kind == "swapped" and not (twin.is_file() and twin.read_bytes() != file.read_bytes())
            if not changes_nothing and not has_no_other:
                yield name, kind
