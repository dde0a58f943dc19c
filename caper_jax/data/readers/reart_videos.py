"""ReArt-Videos (dataset2 of KPA-Tracker): videos of ReArt-48 objects.

Layout of a root folder, read unchanged::

    Data/camera_intrinsic.json
    Data/new_anno_test/<category>/<video>/*.json          annotations
    Data/new_anno_test/flag/<category>/train.txt, test.txt  lines <annotation>.json (any video)
    Data/{depth,color,category_mask}/<path in the annotation>
    URDF/<category>/<id>/mobility_for_unity_align.urdf, model_pts.pkl  [whole, part 1, ..., part K]

No data of this layout could be read; the layout is what the public loader opens. The objects are
those of ReArtMix, so frames, rest poses and signs are converted as there (reartmix_models.py),
for the categories that have a conversion; transformations may carry a scale as there. Joint
states are those that the transformations give: the unit in the files (radians) is not relied on.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.data import safe_pickle
from caper_jax.data.images import read_depth, read_intrinsics
from caper_jax.data.readers.annotated import (
    check_image_size,
    labeled_frame,
    ordered_links,
    polygon_labels,
    pose_of_links,
)
from caper_jax.data.readers.artimage import ALL, object_of, read_annotation
from caper_jax.data.readers.listing import in_natural_order, list_splits, read_list
from caper_jax.data.readers.pm_videos import group_videos
from caper_jax.data.readers.public_urdf import ALIGNED, moving_joints
from caper_jax.data.readers.reartmix_models import CONVERSIONS, Model, read_model
from caper_jax.data.types import Frame, NoFramesError
from caper_jax.errors import CaperError, unknown_name

FORMAT = "reart-videos"
# Objects of the official test split.
TEST_OBJECTS = {
    "box": (0, 1),
    "stapler": (10, 11),
    "cutter": (20, 21),
    "drawer": (30, 31),
    "scissors": (40, 41),
}


class ReArtVideosDataset:
    """The frames of all videos of one category; names are ``<video>/<annotation>``.

    Attributes:
      category, format, split, mask_source, names: see ``Dataset``.
    """

    format = FORMAT
    mask_source = "annotated polygons"

    def __init__(
        self,
        root: str | Path,
        category: str,
        split: str | None = None,
        num_points: int = 1024,
        official_split: bool = False,
    ):
        """Lists the frames; annotations, images and objects are read when a frame is.

        Args:
          root: the folder that holds Data/ and URDF/.
          category: name of the category to read.
          split: "train" or "test" for the frames of flag/<category>/<split>.txt; None or "all"
            for all.
          num_points: points per frame.
          official_split: keep only frames of the objects that the official split puts in
            ``split``, as the public loader does; without text file, these alone decide.

        Raises:
          CaperError: not such a folder, a split or category that it does not have, or a category
            whose rest pose in ReArt-48 is not known.
        """
        self.root = Path(root)
        self.category: Category = categories.get(category)
        if self.category.name not in CONVERSIONS:
            raise unknown_name("ReArt-Videos category", self.category.name, CONVERSIONS)
        self._folder = _folder(self.category.name)
        self.split = split or ALL
        self._num_points = num_points
        self._annotations = self.root / "Data" / "new_anno_test" / self._folder
        if not self._annotations.is_dir():
            raise CaperError(
                f"{self.root}: no ReArt-Videos folder of {self.category.name!r} (it lacks "
                f"Data/new_anno_test/{self._folder}/)"
            )
        self._camera = self.root / "Data" / "camera_intrinsic.json"
        read_intrinsics(self._camera)
        self._intrinsics = lru_cache(maxsize=4)(read_intrinsics)
        self._model = lru_cache(maxsize=None)(self._read_model)
        paths = self._annotations.glob("*/*.json")
        self._files = in_natural_order({f"{path.parent.name}/{path.stem}": path for path in paths})
        self._select(official_split)
        self.names: Sequence[str] = list(self._files)
        if not self.names:
            raise NoFramesError(f"{self._annotations}: split {self.split!r} holds no frame")

    @staticmethod
    def categories_in(root: Path) -> list[str]:
        """Our names of the categories that a root holds and that can be read."""
        folder = root / "Data" / "new_anno_test"
        return [name for name in CONVERSIONS if any((folder / _folder(name)).glob("*/*.json"))]

    @staticmethod
    def splits_in(root: Path, category: str) -> list[str]:
        """Splits that a root lists frames of, for one category."""
        folder = root / "Data" / "new_anno_test" / "flag" / _folder(category)
        return list_splits(folder)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        name = self.names[index]
        path = self._files[name]
        annotation = read_annotation(path)
        instance = annotation["instances"][0]
        where, keys = str(path), ("transformation", "segmentation")
        numbers = [link.get("link_category_id") for link in instance["links"]]
        first = 0 if 0 in numbers else 1  # ReArt-48 counts from 1
        links = ordered_links(instance, self.category.num_parts, where, first, keys)
        urdf_id = str(instance["urdf_id"])
        model = self._model(urdf_id)
        truth = pose_of_links(model, links, self.category, where, scaled=True)
        depth_path = self.root / "Data" / "depth" / annotation["depth_path"]
        depth = read_depth(depth_path)
        check_image_size(depth_path, depth, annotation, path)
        labels = polygon_labels(links, depth.shape, where)
        intrinsics = self._intrinsics(self._camera, depth.shape)
        return labeled_frame(name, depth, labels, intrinsics, truth, self._num_points, urdf_id)

    def videos(self) -> dict[str, list[int]]:
        """Name of every video -> indices of its frames, in the order of time."""
        return group_videos(list(self.names))

    def _select(self, official: bool) -> None:
        """Keeps the frames of the split."""
        listed = self.root / "Data" / "new_anno_test" / "flag" / self._folder / f"{self.split}.txt"
        if self.split != ALL and (listed.is_file() or not official):
            if not listed.is_file():
                raise CaperError(f"{self.root}: no split {self.split!r} (no {listed})")
            wanted = {line.removesuffix(".json") for line in read_list(listed)}
            missing = wanted - {path.stem for path in self._files.values()} - set(self._files)
            if missing:
                raise CaperError(f"{listed}: names {min(missing)!r}, which has no annotation")
            self._files = {n: p for n, p in self._files.items() if n in wanted or p.stem in wanted}
        if official:
            if self.split not in ("train", "test"):
                raise CaperError(f"the official split has train and test, not {self.split!r}")
            tests = {str(urdf_id) for urdf_id in TEST_OBJECTS[self.category.name]}
            self._files = {
                name: path
                for name, path in self._files.items()
                if (object_of(path) in tests) == (self.split == "test")
            }

    def _read_model(self, urdf_id: str) -> Model:
        home = self.root / "URDF" / self._folder / urdf_id
        path = home / "model_pts.pkl"
        clouds = safe_pickle.load(path)
        expected = 1 + self.category.num_parts
        if not isinstance(clouds, (list, tuple)) or len(clouds) != expected:
            raise CaperError(f"{path}: expected a list of {expected} clouds (whole, then parts)")
        corners = []
        for number, cloud in enumerate(clouds):
            points = np.asarray(cloud)
            if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind not in "fiu":
                raise CaperError(f"{path}: cloud {number} must be [N, 3], got {points.shape}")
            if len(points) == 0 or not np.isfinite(points).all():
                raise CaperError(f"{path}: cloud {number} is empty or not finite")
            corners.append([points[:, :3].min(0), points[:, :3].max(0)])

        urdf = home / ALIGNED
        joints = moving_joints(urdf, _child)
        meta = {
            "corner_pts": corners,
            "joint_rpy": [joint.axis for joint in joints],
            "joint_xyz": [joint.origin for joint in joints],
            # Public loaders take every joint to be mounted on the root.
            "joint_parents": [1] * len(joints),
            "joint_children": [joint.child + 1 for joint in joints],
            "joint_types": [joint.kind for joint in joints],
        }
        if not joints:
            raise CaperError(f"{urdf}: no joint moves")
        return read_model(meta, self.category, CONVERSIONS[self.category.name], str(urdf))


def _folder(category: str) -> str:
    return {"scissors": "scissor"}.get(category, category)


def _child(name: str) -> int | None:
    """Part that a joint named base_link_link1_joint, or base|revolute|link1, moves."""
    match = re.search(r"link(\d+)(_joint)?$", name)
    return None if match is None else int(match[1])
