"""A small clean root in every format, by its name on the command line."""

from __future__ import annotations

from pathlib import Path

from _helpers import captra_roots, roots

# Format -> (category that the root shows, function that writes the root and returns its path).
FORMATS = {
    "artimage": ("laptop", roots.artimage),
    "caper": ("box", lambda folder: roots.caper(folder / "box_test.h5")),
    "captra": ("laptop", captra_roots.captra),
    "pm-videos": ("laptop", roots.pm_videos),
    "reart-videos": ("box", roots.reart_videos),
    "reartmix": ("box", roots.reartmix),
}


def write_root(format: str, folder: Path) -> Path:
    """A root in a folder that exists."""
    return FORMATS[format][1](folder)
