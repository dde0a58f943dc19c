"""Videos of one's own: folders of depth images and masks, without ground truth.

Layout of one video::

    <video>/depth/*.png        16-bit millimeters (or as ``read_depth`` takes them)
    <video>/mask/*.png         not black on the object; of the same name as the depth image
    <video>/intrinsics.json    the camera, as ``read_intrinsics`` takes it
    <video>/gravity.json       optional: the way things fall, [x, y, z] in the camera's frame, or
                               {"<file>": [x, y, z]} where the camera moves

A root is one such folder, or a folder of several. Frames come in the natural order of their names
(2 before 10). A frame without a mask, or with a black one, does not show the object.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caper_jax.arrays import unit_gravity
from caper_jax.data.clouds import MIN_POINTS, cloud_from_depth
from caper_jax.data.images import read_depth, read_intrinsics, read_json, read_mask
from caper_jax.data.readers.base import ALL, DatasetReader, natural_order
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError

FORMAT = "folder"
_DEPTH, _MASK, _CAMERA, _GRAVITY = "depth", "mask", "intrinsics.json", "gravity.json"


class DepthFolder(DatasetReader):
    """The frames of all videos of a root; names are ``<video>/<file>``, e.g. kitchen/000012."""

    format = FORMAT
    title = "depth folder"
    mask_source = "mask images"
    has_videos = True
    labeled = False

    def __init__(
        self, root: str | Path, *arguments: Any, depth_scale: float | None = None, **options: Any
    ):
        """See ``DatasetReader``; ``depth_scale``: meters per unit of the depth images."""
        self._scale = depth_scale
        super().__init__(root, *arguments, **options)

    @classmethod
    def categories_in(cls, root: Path) -> list[str]:
        raise CaperError(f"{root}: depth images do not say what they show; name the category")

    def open(self) -> None:
        super().open()
        if self.split != ALL:
            raise CaperError(f"{self.root}: a folder of depth images has no splits")
        self._homes = _videos_in(self.root)
        if not self._homes:
            raise CaperError(
                f"{self.root}: no video of depth images (it has no folder {_DEPTH}/, nor has a "
                "folder in it)"
            )

    def list_frames(self) -> dict[str, Path]:
        frames = {}
        for home in self._homes:
            read_intrinsics(home / _CAMERA)
            # As given: links of different names may lead to folders of the same.
            name = home.resolve().name if home.name in ("", "..") else home.name
            frames.update({f"{name}/{file.stem}": file for file in _depth_images(home)})
        return frames

    def read_frame(self, name: str, path: Path) -> Frame:
        home = path.parent.parent
        depth = read_depth(path, self._scale)
        intrinsics = read_intrinsics(home / _CAMERA, (depth.shape[0], depth.shape[1]))
        mask_path = home / _MASK / path.name
        mask: np.ndarray = np.zeros(depth.shape, bool)
        if mask_path.exists():
            mask = read_mask(mask_path, allow_empty=True)
        if mask.shape != depth.shape:
            raise CaperError(
                f"{mask_path} is {mask.shape[1]} x {mask.shape[0]} but its depth image "
                f"{depth.shape[1]} x {depth.shape[0]}; both must come from the same (aligned) image"
            )
        points = np.zeros((0, 3), np.float32)
        if np.count_nonzero(mask & np.isfinite(depth) & (depth > 0)) >= MIN_POINTS:
            points = cloud_from_depth(depth, mask, intrinsics, self.num_points).points
        return Frame(
            name=name,
            points=points,
            depth=depth,
            mask=mask,
            intrinsics=intrinsics,
            gravity=_gravity(home / _GRAVITY, path.stem),
        )


def is_depth_folder(root: str | Path) -> bool:
    """Whether a folder is a video of this layout, or holds one."""
    root = Path(root)
    return root.is_dir() and bool(_videos_in(root))


def _gravity(path: Path, name: str) -> np.ndarray | None:
    """Unit vector for the frame of a name; None without the file, or where it lacks the frame.

    Raises:
      CaperError: something else than a direction.
    """
    if not path.is_file():
        return None
    content = read_json(path)
    vector = content.get(name) if isinstance(content, dict) else content
    if vector is None:
        return None
    try:
        return unit_gravity(vector, 1)[0]
    except CaperError as error:
        raise CaperError(f"{path}: gravity must be [x, y, z], a direction, got {vector}") from error


def _videos_in(root: Path) -> list[Path]:
    """The folders of the videos of a root, in natural order."""
    if (root / _DEPTH).is_dir():
        return [root]
    inside = [folder for folder in root.iterdir() if (folder / _DEPTH).is_dir()]
    return sorted(inside, key=lambda folder: natural_order(folder.name))


def _depth_images(home: Path) -> list[Path]:
    """Depth images of one video in natural order, checked against its masks."""
    files = sorted((home / _DEPTH).glob("*.png"), key=lambda path: natural_order(path.stem))
    if not files:
        raise CaperError(f"{home / _DEPTH}: holds no depth image *.png")
    masks = {path.name for path in (home / _MASK).glob("*.png")}
    if not masks:
        raise CaperError(f"{home / _MASK}: holds no mask *.png; say which pixels are the object")
    alone = masks - {path.name for path in files}
    if alone:
        raise CaperError(
            f"{home / _MASK / min(alone)}: has no depth image of this name in {home / _DEPTH}; a "
            "mask must be named as its depth image"
        )
    return files
