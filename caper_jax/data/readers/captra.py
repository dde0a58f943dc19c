"""CAPTRA's SAPIEN data: rendered depth of moving PartNet-Mobility objects, single and in videos.

Layout of a root folder, read unchanged::

    urdf/<category>/<instance>/mobility.urdf      the objects (captra_models.py)
    render/<category>/<instance>/<track>/cloud/<frame>.npz, gt/<frame>.pkl      for training
    render_seq/<category>/<instance>/<track>/...  videos, for tests

Categories are ``glasses``, ``scissors``, ``laptop`` and ``drawers`` there. An .npz holds one
pickled dictionary ``all_dict``: camera_matrix [3, 3], depth (OpenGL's z-buffer, 0 to 1, 1 where
there is nothing), seg (number of the link; higher ones are ground and robot), near and far. A
.pkl holds ``camera_pose`` and, by number of the link, ``link_pose``: (position, quaternion wxyz)
in the world, of a camera that looks along x with y to its left and z up. Pickles are read without
running what they name (safe_pickle.py).

The layout is what the public loader opens; no data of it could be read. Not verified are: that
frames of render/ are numbered apart from those of render_seq/ (they are told apart here), that
every object stands upright in its URDF with y up, and its rest pose, which the files do not state
and captra_models.py finds. Lengths are PartNet's, read as meters.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.data import safe_pickle
from caper_jax.data.readers.annotated import labeled_frame, pose_of_links
from caper_jax.data.readers.artimage_models import RestModel
from caper_jax.data.readers.captra_models import read_model
from caper_jax.data.readers.listing import in_natural_order
from caper_jax.data.types import Frame, NoFramesError
from caper_jax.errors import CaperError, unknown_name

FORMAT = "captra"
ALL = "all"
# Objects of the official test split.
TEST_OBJECTS = {
    "eyeglasses": (101839, 101848, 101860, 101326, 101868, 102591, 102596, 103028),
    "scissors": (10559, 10564, 11029),
    "laptop": (10101, 10270, 10356, 11156, 11405, 11581),
    "drawer": (46440, 46123),
}
_FOLDERS = {
    "eyeglasses": "glasses",
    "scissors": "scissors",
    "laptop": "laptop",
    "drawer": "drawers",
}
_PLACES = {"train": "render", "test": "render_seq"}
_ARRAYS = {"camera_matrix": 2, "depth": 2, "seg": 2, "near": 0, "far": 0}
# Axes of the files' camera (ahead, left, up) -> OpenCV's (right, down, ahead).
_CAMERA_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


class CaptraDataset:
    """The frames of one category; names are ``<instance>/<track>/<frame>``, e.g. 10040/0/17.

    A frame that shows too little for a cloud has no points: to an evaluation, a failure.
    AxisMap frames from several threads at once is safe.

    Attributes:
      category, format, split, mask_source, names: see ``Dataset``; where both folders are read,
        names begin with theirs: ``render_seq/10040/0/17``.
    """

    format = FORMAT
    mask_source = "simulated segmentation"

    def __init__(
        self,
        root: str | Path,
        category: str,
        split: str | None = None,
        num_points: int = 1024,
        official_split: bool = False,
    ):
        """Lists the frames; clouds, poses and objects are read when a frame is.

        Args:
          root: the folder that holds urdf/ and render/ or render_seq/.
          category: our name of the category to read.
          split: "train" for render/, "test" for render_seq/; None or "all" for both.
          num_points: points per frame.
          official_split: keep only frames of the objects that the official split puts in
            ``split``.

        Raises:
          CaperError: not such a folder, or a split or category that it does not have.
        """
        self.root = Path(root)
        self.category: Category = categories.get(category)
        if self.category.name not in _FOLDERS:
            raise unknown_name("CAPTRA category", self.category.name, _FOLDERS)
        self.split = split or ALL
        if self.split not in (ALL, *_PLACES):
            raise unknown_name("split of CAPTRA", self.split, (ALL, *_PLACES))
        self._num_points = num_points
        self._folder = _FOLDERS[self.category.name]
        self._urdfs = self.root / "urdf" / self._folder
        if not self._urdfs.is_dir():
            raise CaperError(
                f"{self.root}: no CAPTRA folder of {self.category.name!r} (it lacks "
                f"urdf/{self._folder}/)"
            )
        self._model = lru_cache(maxsize=None)(self._read_model)
        self._files = self._list_frames()
        if official_split:
            self._keep_official()
        if not self._files:
            raise NoFramesError(f"{self.root}: split {self.split!r} holds no {self.category.name}")
        self.names: Sequence[str] = list(self._files)

    @staticmethod
    def categories_in(root: Path) -> list[str]:
        """Our names of the categories that a root holds."""
        return [
            name
            for name, folder in _FOLDERS.items()
            if (root / "urdf" / folder).is_dir()
            and any((root / place / folder).is_dir() for place in _PLACES.values())
        ]

    @staticmethod
    def splits_in(root: Path, category: str) -> list[str]:
        """Splits that a root holds of a category."""
        folder = _FOLDERS.get(category, category)
        return [split for split, place in _PLACES.items() if (root / place / folder).is_dir()]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        name = self.names[index]
        cloud = self._files[name]
        instance = cloud.parts[-4]
        model = self._model(instance)
        poses = self._read_poses(cloud.parent.parent / "gt" / f"{cloud.stem}.pkl")
        links = [{"transformation": poses[link]} for link in model.links]
        truth = pose_of_links(model, links, self.category, str(cloud), scaled=False)
        depth, seg, intrinsics = _read_image(cloud)
        part_of_link = np.full(self.category.num_parts + 1, -1)
        part_of_link[list(model.links)] = np.arange(self.category.num_parts)
        known = (seg >= 0) & (seg < self.category.num_parts) & (depth > 0)
        parts = part_of_link[np.where(known, seg, -1)]
        return labeled_frame(name, depth, parts, intrinsics, truth, self._num_points, instance)

    def videos(self) -> dict[str, list[int]]:
        """Name of every track of render_seq/ -> indices of its frames, in the order of time."""
        videos: dict[str, list[int]] = {}
        for index, (name, path) in enumerate(self._files.items()):
            if path.parts[-6] == _PLACES["test"]:
                videos.setdefault(name.rpartition("/")[0], []).append(index)
        return videos

    def _list_frames(self) -> dict[str, Path]:
        """Name -> cloud, tracks and frames in the order of their numbers."""
        files = {}
        for place in _PLACES.values() if self.split == ALL else (_PLACES[self.split],):
            for path in (self.root / place / self._folder).glob("*/*/cloud/*.npz"):
                name = f"{path.parts[-4]}/{path.parts[-3]}/{path.stem}"
                files[f"{place}/{name}" if self.split == ALL else name] = path
        return in_natural_order(files)

    def _keep_official(self) -> None:
        """Keeps frames whose object the official split puts in this one."""
        if self.split not in _PLACES:
            raise CaperError(f"the official split has train and test, not {self.split!r}")
        tests = {str(number) for number in TEST_OBJECTS[self.category.name]}
        self._files = {
            name: path
            for name, path in self._files.items()
            if (path.parts[-4] in tests) == (self.split == "test")
        }

    def _read_model(self, instance: str) -> RestModel:
        return read_model(self._urdfs / instance, self.category)

    def _read_poses(self, path: Path) -> list[np.ndarray]:
        """[4, 4] of every link, link -> camera (OpenCV)."""
        content = safe_pickle.load(path)
        try:
            camera = _matrix(content["camera_pose"], f"{path}: camera_pose")
            links = [
                _matrix(content["link_pose"][link], f"{path}: link_pose {link}")
                for link in range(self.category.num_parts)
            ]
        except (KeyError, IndexError, TypeError) as error:
            raise CaperError(f"{path}: lacks {error}") from error
        world_to_camera = _CAMERA_AXES @ np.linalg.inv(camera)
        return [world_to_camera @ link for link in links]


def _matrix(pose: Any, where: str) -> np.ndarray:
    """[4, 4] of (position [3], quaternion [4] wxyz)."""
    try:
        position, quaternion = (np.asarray(value, np.float64) for value in pose)
    except (TypeError, ValueError) as error:
        raise CaperError(f"{where} must be a position and a quaternion, got {pose!r}") from error
    length = np.linalg.norm(quaternion)
    if position.shape != (3,) or quaternion.shape != (4,) or not abs(length - 1) < 1e-3:
        raise CaperError(f"{where} must be 3 numbers and a unit quaternion of 4, got {pose!r}")
    w, x, y, z = quaternion / length
    hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += 2 * (w * hat + hat @ hat)
    matrix[:3, 3] = position
    return matrix


def _read_image(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [H, W] float32 meters (0: nothing), link of every pixel [H, W], intrinsics [3, 3]."""
    content = safe_pickle.load_npz(path, "all_dict")
    arrays = {}
    for key, axes in _ARRAYS.items():
        if not isinstance(content, dict) or key not in content:
            raise CaperError(f"{path}: all_dict lacks {key!r}")
        array = np.asarray(content[key])
        numbers = array.dtype.kind in "fiu" and array.size and np.isfinite(array).all()
        if array.ndim != axes or not numbers:
            raise CaperError(
                f"{path}: {key} must hold finite numbers with {axes} axes, got {array.dtype} "
                f"{array.shape}"
            )
        arrays[key] = array.astype(np.float64)
    buffer, seg, camera = arrays["depth"], arrays["seg"], arrays["camera_matrix"]
    near, far = float(arrays["near"]), float(arrays["far"])
    if seg.shape != buffer.shape:
        raise CaperError(f"{path}: depth is {buffer.shape} but seg {seg.shape}")
    if camera.shape != (3, 3) or camera[0, 0] <= 0 or camera[1, 1] <= 0:
        raise CaperError(f"{path}: camera_matrix is no [3, 3] pinhole matrix, got {camera}")
    if not 0 < near < far or buffer.min() < 0 or buffer.max() > 1:
        raise CaperError(
            f"{path}: depth must be a z-buffer from 0 to 1 between 0 < near < far, got "
            f"{buffer.min():g} to {buffer.max():g} between {near:g} and {far:g}"
        )
    depth = np.where(buffer < 1, near * far / (far + buffer * (near - far)), 0.0)
    return depth.astype(np.float32), seg.astype(np.int64), camera
