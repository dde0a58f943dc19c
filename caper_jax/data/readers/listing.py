"""Lists of frames: the text files of splits, and the order of names."""

from __future__ import annotations

import re
from pathlib import Path

from caper_jax.errors import CaperError

# A word of a list of frames: it has a number in it, or is the name of an annotation.
_FRAME = re.compile(r"\S*\d\S*|\S+\.json")


def natural_order(name: str) -> tuple[tuple[tuple[bool, int, str], ...], str]:
    """Sort key that counts runs of digits as numbers: frame2 comes before frame10."""
    words = re.findall(r"[0-9]+|[^0-9]+", name)
    numbers = ((False, int(w), "") if w.isdecimal() else (True, 0, w) for w in words)
    return tuple(numbers), name


def in_natural_order(files: dict[str, Path]) -> dict[str, Path]:
    """Files by name, 2 before 10."""
    return {name: files[name] for name in sorted(files, key=natural_order)}


def read_list(path: Path) -> list[str]:
    """The words of a text file, which names one frame a line.

    Raises:
      CaperError: the file is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig").split()
    except UnicodeDecodeError as error:
        raise CaperError(
            f"{path}: not a text file in UTF-8 ({error.reason}); save it as such"
        ) from error


def list_splits(folder: Path) -> list[str]:
    """Names, without their endings, of the text files that list frames; others may lie beside.

    What lists frames is told by its first line; an empty file lists none.
    """
    return sorted(path.stem for path in folder.glob("*.txt") if _lists_frames(path))


def _lists_frames(path: Path) -> bool:
    if not path.is_file():
        return False
    # A list in another encoding still is one, and read_list says what is wrong with it.
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        line = next((line for line in file if line.strip()), "")
    return all(_FRAME.fullmatch(word) for word in line.split())
