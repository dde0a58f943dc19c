"""ArtImage: rendered RGB-D images of one PartNet object each (OMAD).

Layout of a root folder, read unchanged::

    camera_intrinsic.json                    Open3D pinhole camera
    <category>/train.txt, test.txt           lines NNNNNN.json
    <category>/train/annotations/NNNNNN.json, depth/*.png, category_mask/*.png, color/*.jpg
    <category>/urdf/rest_state.json, <id>/   the objects (artimage_models.py)

Frames of every split lie under train/. Any category of this project may stand in a root; its
parts, tree and joints are the category's. PartNet units are read as meters. Frames come out in
this project's conventions; artimage_frames.py says what could not be verified of that.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.data.images import read_depth, read_intrinsics, read_labels
from caper_jax.data.readers.annotated import (
    check_image_size,
    checked_annotation,
    labeled_frame,
    ordered_links,
    pose_of_links,
)
from caper_jax.data.readers.artimage_models import RestModel, read_model
from caper_jax.data.readers.listing import list_splits, read_list
from caper_jax.data.types import Frame, NoFramesError
from caper_jax.errors import CaperError

FORMAT = "artimage"
ALL = "all"
# Objects of the official test split; public loaders read a frame for a split when both the text
# file and this list say so.
TEST_OBJECTS = {
    "laptop": (10040, 10885, 11242, 11030, 11156),
    "eyeglasses": (101300, 101859, 102586, 102590, 102596, 102612),
    "dishwasher": (11700, 12530, 12559, 12580),
    "drawer": (46123, 45841, 46440),
    "scissors": (10449, 10502, 10569, 10907),
}
# A state of the files and the one that the transformations give may differ by this much.
_STATE_TOLERANCE = {"revolute": np.radians(1.0), "prismatic": 0.01}
_URDF_ID = re.compile(rb'"urdf_id"\s*:\s*"?([\w.-]+)')


class ArtImageDataset:
    """The images of one category, one ``Frame`` each.

    An image that shows too little for a cloud has no points: to an evaluation, a failure.
    AxisMap frames from several threads at once is safe.

    Attributes:
      category, format, split, mask_source, names: see ``Dataset``; names are the annotations'
        without their suffix, e.g. ``000123``.
    """

    format = FORMAT
    mask_source = "annotated part masks"
    _annotations = "train/annotations/*.json"  # in the category's folder

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
          root: the folder that holds the categories' folders.
          category: name of the category to read.
          split: "train" or "test" for the frames of <split>.txt; None or "all" for all.
          num_points: points per frame.
          official_split: keep only frames of the objects that the official split puts in
            ``split``, as public loaders do; without text file, these alone decide.

        Raises:
          CaperError: no such folder, a split it does not have, or names without annotation.
        """
        self.root = Path(root)
        self.category: Category = categories.get(category)
        self.split = split or ALL
        self._num_points = num_points
        self._home = self._find_home()
        self._camera = self._camera_file()
        read_intrinsics(self._camera)
        self._intrinsics = lru_cache(maxsize=4)(read_intrinsics)
        self._model = lru_cache(maxsize=None)(self._read_model)
        # Frame name -> annotation file.
        self._files = self._list_frames()
        if official_split:
            self._keep_official()
        elif self.split != ALL:
            self._keep_listed(self._read_list())
        if not self._files:
            raise NoFramesError(f"{self._home}: split {self.split!r} holds no frame")
        self.names: Sequence[str] = list(self._files)

    @classmethod
    def categories_in(cls, root: Path) -> list[str]:
        """Registered categories that a root holds."""
        return [name for name in categories.names() if any((root / name).glob(cls._annotations))]

    @staticmethod
    def splits_in(root: Path, category: str) -> list[str]:
        """Splits that a root lists frames of, for one category."""
        return list_splits(root / category)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        name = self.names[index]
        path = self._files[name]
        annotation = read_annotation(path)
        instance = annotation["instances"][0]
        keys = ("transformation",)
        links = ordered_links(instance, self.category.num_parts, str(path), first=0, keys=keys)
        urdf_id = str(instance["urdf_id"])
        model = self._model(urdf_id)
        links = [links[link] for link in model.links]
        truth = pose_of_links(model, links, self.category, str(path), scaled=False)
        self._check_states(links, model, truth.joint_state, path)

        depth_path = path.parent.parent / annotation["depth_path"]
        mask_path = path.parent.parent / annotation["depth_path"].replace("depth", "category_mask")
        depth, labels = read_depth(depth_path), read_labels(mask_path)
        check_image_size(depth_path, depth, annotation, path)
        check_image_size(mask_path, labels, annotation, path)
        # Background carries a label that is no part (255 in the sample data).
        part_of_label = np.full(max(int(labels.max()), self.category.num_parts) + 1, -1)
        part_of_label[list(model.links)] = np.arange(self.category.num_parts)
        parts = part_of_label[np.maximum(labels, 0)]
        intrinsics = self._intrinsics(self._camera, depth.shape)
        return labeled_frame(name, depth, parts, intrinsics, truth, self._num_points, urdf_id)

    def _find_home(self) -> Path:
        """The category's folder."""
        home = self.root / self.category.name
        if not (home / "train").is_dir():
            present = sorted(p.parent.name for p in self.root.glob("*/train"))
            raise CaperError(
                f"{self.root}: no {self.format} folder of {self.category.name!r} (it lacks "
                f"{self.category.name}/train/); it holds {', '.join(present) or 'none'}"
            )
        return home

    def _camera_file(self) -> Path:
        return self.root / "camera_intrinsic.json"

    def _read_model(self, urdf_id: str) -> RestModel:
        return read_model(self._home / "urdf", urdf_id, self.category)

    def _list_frames(self) -> dict[str, Path]:
        return {path.stem: path for path in sorted(self._home.glob(self._annotations))}

    def _read_list(self) -> list[str]:
        """Lines of the split's text file."""
        path = self._home / f"{self.split}.txt"
        if not path.is_file():
            raise CaperError(
                f"{self._home}: no split {self.split!r} (no {path.name}); it has "
                f"{', '.join([ALL, *list_splits(self._home)])}"
            )
        return read_list(path)

    def _keep_listed(self, lines: list[str]) -> None:
        """Keeps the frames that a text file lists, in its order."""
        found = {}
        missing = []
        for line in lines:
            frames = self._frames_of(line)
            found.update({name: self._files[name] for name in frames})
            if not frames:
                missing.append(line)
        if missing:
            raise CaperError(
                f"{self._home / self.split}.txt: names {missing[0]!r}, which has no annotation"
                + (f" ({len(missing)} such lines)" if len(missing) > 1 else "")
            )
        self._files = found

    def _frames_of(self, line: str) -> list[str]:
        """Names of the frames that a line of a text file means."""
        name = line.removesuffix(".json")
        return [name] if name in self._files else []

    def _keep_official(self) -> None:
        """Keeps frames whose object the official split puts in this one."""
        tests = self._test_objects()
        if self.category.name not in tests or self.split not in ("train", "test"):
            raise CaperError(
                f"the official split of {self.format} has train and test of "
                f"{', '.join(sorted(tests))}, not {self.split!r} of {self.category.name!r}"
            )
        if (self._home / f"{self.split}.txt").is_file():
            self._keep_listed(self._read_list())
        wanted = {str(urdf_id) for urdf_id in tests[self.category.name]}
        self._files = {
            name: path
            for name, path in self._files.items()
            if (object_of(path) in wanted) == (self.split == "test")
        }

    def _test_objects(self) -> dict[str, tuple[int, ...]]:
        return TEST_OBJECTS

    def _check_states(
        self, links: list[dict[str, Any]], model: RestModel, states: np.ndarray, path: Path
    ) -> None:
        """Refuses states (deg, m) that contradict the transformations: wrong unit or sign."""
        for j, joint in enumerate(self.category.joints):
            value = links[j + 1].get("state")
            if value is None:
                continue
            where = f"{path}: state of link {model.links[j + 1]}"
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise CaperError(f"{where} must be a number, got {value!r}")
            stated = np.radians(value) if joint.type == "revolute" else value
            difference = model.signs[j] * stated - float(states[j])
            if joint.type == "revolute":
                difference = (difference + np.pi) % (2 * np.pi) - np.pi
            if not abs(difference) <= _STATE_TOLERANCE[joint.type]:
                found = model.signs[j] * float(states[j])
                found = np.degrees(found) if joint.type == "revolute" else found
                unit = "degrees" if joint.type == "revolute" else "meters"
                raise CaperError(
                    f"{where} is {value:g}, but its transformation gives {found:.4g} {unit}"
                )


def read_annotation(path: Path) -> dict[str, Any]:
    """The content of an annotation with exactly one instance.

    Raises:
      CaperError: missing or broken file, or one that lacks a key.
    """
    content = checked_annotation(path, ("width", "height"), ("urdf_id",))
    if len(content["instances"]) != 1:
        raise CaperError(f"{path}: {len(content['instances'])} instances, expected exactly one")
    return content


def object_of(path: Path) -> str:
    """urdf_id of an annotation, found without reading its polygons as numbers.

    Raises:
      CaperError: the file states none.
    """
    match = _URDF_ID.search(path.read_bytes())
    if match is None:
        raise CaperError(f"{path}: no annotation, it lacks 'urdf_id'")
    return match[1].decode()
