"""A small video of depth images and masks, for tests."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

CAMERA = {"fx": 90.0, "fy": 95.0, "cx": 31.5, "cy": 23.5}


def write_video(home: Path, names: Sequence[str] = ("f1", "f2", "f10")) -> Path:
    """A block that comes 100 mm nearer from frame to frame, before a wall."""
    for kind in ("depth", "mask"):
        (home / kind).mkdir(parents=True)
    for number, name in enumerate(names):
        depth = np.full((48, 64), 2000, np.uint16)
        mask = np.zeros((48, 64), np.uint8)
        mask[10:30, 20:50] = 255
        depth[mask > 0] = 900 - 100 * number
        Image.fromarray(depth).save(home / "depth" / f"{name}.png")
        Image.fromarray(mask).save(home / "mask" / f"{name}.png")
    (home / "intrinsics.json").write_text(json.dumps(CAMERA))
    return home
