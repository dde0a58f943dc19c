"""Videos of one's own: folders of depth images and masks, without ground truth.

Layout of one video::

    <video>/depth/*.png        16-bit millimeters (or as ``read_depth`` takes them)
    <video>/mask/*.png         not black on the object; of the same name as the depth image
    <video>/intrinsics.json    the camera, as ``read_intrinsics`` takes it

A root is one such folder, or a folder of several. Frames come in the natural order of their names
(2 before 10). A frame without a mask, or with a black one, does not show the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.data.clouds import MIN_POINTS, cloud_from_depth
from caper_jax.data.images import read_depth, read_intrinsics, read_mask
from caper_jax.data.readers.listing import natural_order
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError

FORMAT = "folder"
_DEPTH, _MASK, _CAMERA = "depth", "mask", "intrinsics.json"


class DepthFolder:
    """The frames of all videos of a root; names are ``<video>/<file>``, e.g. kitchen/000012.

    A frame that shows too little for a cloud has no points: the object is not in it.

    Attributes:
      category, format, split, mask_source, names: see ``Dataset``.
    """

    format = FORMAT
    split = "all"
    mask_source = "mask images"

    def __init__(
        self,
        root: str | Path,
        category: str,
        num_points: int = 1024,
        depth_scale: float | None = None,
    ):
        """Lists the frames and reads the cameras; images are read when a frame is.

        Args:
          root: a video, or a folder of videos.
          category: what the videos show.
          num_points: points per frame.
          depth_scale: meters per unit of the depth images, see ``read_depth``.

        Raises:
          CaperError: no such folder, no video in it, a video without depth images, masks or a
            camera, or a mask without a depth image.
        """
        self.root = Path(root)
        self.category: Category = categories.get(category)
        self._num_points = num_points
        self._scale = depth_scale
        self._files: dict[str, Path] = {}
        self._videos: dict[str, list[int]] = {}
        for home in _homes(self.root):
            files = _depth_images(home)
            read_intrinsics(home / _CAMERA)
            first, name = len(self._files), _name(home)
            self._videos[name] = list(range(first, first + len(files)))
            self._files |= {f"{name}/{file.stem}": file for file in files}
        self.names: Sequence[str] = list(self._files)

    def videos(self) -> dict[str, list[int]]:
        """Name of every video -> indices of its frames, in the order of time."""
        return self._videos

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        name = self.names[index]
        path = self._files[name]
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
            points = cloud_from_depth(depth, mask, intrinsics, self._num_points).points
        return Frame(name=name, points=points, depth=depth, mask=mask, intrinsics=intrinsics)


def is_depth_folder(root: str | Path) -> bool:
    """Whether a folder is a video of this layout, or holds one."""
    root = Path(root)
    return root.is_dir() and bool(_folders(root))


def _folders(root: Path) -> list[Path]:
    if (root / _DEPTH).is_dir():
        return [root]
    inside = [folder for folder in root.iterdir() if (folder / _DEPTH).is_dir()]
    return sorted(inside, key=lambda folder: natural_order(folder.name))


def _homes(root: Path) -> list[Path]:
    """The videos of a root, in natural order; at least one."""
    if not root.is_dir():
        raise CaperError(f"{root}: no such folder")
    homes = _folders(root)
    if not homes:
        raise CaperError(
            f"{root}: no video of depth images (it has no folder {_DEPTH}/, nor has a folder in it)"
        )
    return homes


def _name(home: Path) -> str:
    """The name of a folder, as given: links of different names may lead to folders of the same."""
    return home.resolve().name if home.name in ("", "..") else home.name


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
