"""The order of frames by their names."""

from __future__ import annotations

import re
from pathlib import Path


def natural_order(name: str) -> tuple[tuple[tuple[bool, int, str], ...], str]:
    """Sort key that counts runs of digits as numbers: frame2 comes before frame10."""
    words = re.findall(r"[0-9]+|[^0-9]+", name)
    numbers = ((False, int(w), "") if w.isdecimal() else (True, 0, w) for w in words)
    return tuple(numbers), name


def in_natural_order(files: dict[str, Path]) -> dict[str, Path]:
    """Files by name, 2 before 10."""
    return {name: files[name] for name in sorted(files, key=natural_order)}
