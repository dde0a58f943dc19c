"""ReArtMix: real RGB-D frames with several articulated objects each (ReArt-48 models).

Layout of a root folder, read unchanged::

    camera_intrinsic.json    Open3D pinhole camera
    urdf_metas.json          boxes of the parts, joint axes and pivots of every model
    annotations/<scene>/NNNNNN.json, depth/<scene>/NNNNNN.png, color/<scene>/NNNNNN.jpg
    train.txt, test.txt      lines ``<scene>/NNNNNN_<instance>``

The files keep a uniform scale s in every transformation, ``[s R | t]``, and hold the parts at a
state of their own; frames come out in this project's conventions (meters, rest-canonical frames,
positive states open). What is known of rest poses and what is judged: reartmix_models.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.data.images import read_depth, read_intrinsics, read_json
from caper_jax.data.readers.annotated import (
    check_image_size,
    checked_annotation,
    labeled_frame,
    ordered_links,
    polygon_labels,
    pose_of_links,
)
from caper_jax.data.readers.listing import list_splits, read_list
from caper_jax.data.readers.reartmix_models import CONVERSIONS, Model, conversion_of, read_model
from caper_jax.data.types import Frame, NoFramesError
from caper_jax.errors import CaperError

FORMAT = "reartmix"
ALL = "all"
_CATEGORY_ID = re.compile(rb'"category_id"\s*:\s*(\d+)')
_INSTANCE_KEYS = ("id", "category_id", "urdf_id")


class ReArtMixDataset:
    """Every annotated instance of one category, one ``Frame`` each.

    An instance that shows too little for a cloud has no points: to an evaluation, a failure.

    Attributes:
      category, format, split, mask_source, names: see ``Dataset``; names are the lines of
        train.txt, e.g. ``scene6/000003_0``.
    """

    format = FORMAT
    mask_source = "annotated polygons"

    def __init__(
        self,
        root: str | Path,
        category: str,
        split: str | None = None,
        num_points: int = 1024,
        on_broken: Callable[[CaperError], None] | None = None,
    ):
        """Lists the instances; depth and polygons are read frame by frame.

        Args:
          root: the folder that holds annotations/, depth/ and urdf_metas.json.
          category: our name of the category to read (``scissors`` are ``scissor`` in the files);
            the others in the images are left out.
          split: "train" or "test" for the instances of <split>.txt; None or "all" for all.
          num_points: points per frame.
          on_broken: called with the error of every annotation that cannot be read, whose
            instances then are left out; by default the error is raised.

        Raises:
          CaperError: not a ReArtMix folder, a split it does not have, a category it does not hold
            or whose rest pose is not known, or broken files.
        """
        self.root = Path(root)
        self.category: Category = categories.get(category)
        self._conversion = conversion_of(self.category.name, "ReArtMix")
        for name in ("annotations", "depth"):
            if not (self.root / name).is_dir():
                raise CaperError(f"{self.root}: no ReArtMix folder (it lacks {name}/)")
        self.split = split or ALL
        self._num_points = num_points
        self._on_broken = on_broken
        self._camera = self.root / "camera_intrinsic.json"
        read_intrinsics(self._camera)
        self._intrinsics = lru_cache(maxsize=4)(read_intrinsics)
        self._models = self._load_models()
        self.names: Sequence[str] = self._list_names()
        self._annotation = lru_cache(maxsize=4)(self._read_annotation)

    @staticmethod
    def categories_in(root: Path) -> list[str]:
        """Our names of the categories that annotations of a root show and that can be read."""
        known = {str(c.category_id).encode(): name for name, c in CONVERSIONS.items()}
        present: set[bytes] = set()
        for path in sorted((root / "annotations").glob("**/*.json")):
            # Annotations are long (polygons) and often show the same categories.
            present |= set(_CATEGORY_ID.findall(path.read_bytes())) & set(known)
            if len(present) == len(known):
                break
        return sorted(known[number] for number in present)

    @staticmethod
    def splits_in(root: Path, category: str) -> list[str]:
        """Splits that a root lists, of all categories together."""
        return list_splits(root)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        name = self.names[index]
        image_name, _, instance_id = name.rpartition("_")
        annotation = self._annotation(image_name)
        instance = next(i for i in annotation["instances"] if i["id"] == int(instance_id))
        where = f"{self._path(image_name)}, instance {instance_id}"
        keys = ("transformation", "segmentation")
        links = ordered_links(instance, self.category.num_parts, where, first=1, keys=keys)
        if instance["urdf_id"] not in self._models:
            raise CaperError(f"{where}: urdf_id {instance['urdf_id']} is not in urdf_metas.json")
        model = self._models[instance["urdf_id"]]
        truth = pose_of_links(model, links, self.category, where, scaled=True)
        depth_path = self.root / "depth" / annotation["depth_path"]
        depth = read_depth(depth_path)
        check_image_size(depth_path, depth, annotation, self._path(image_name))
        labels = polygon_labels(links, depth.shape, where)
        intrinsics = self._intrinsics(self._camera, depth.shape)
        urdf_id = str(instance["urdf_id"])
        return labeled_frame(name, depth, labels, intrinsics, truth, self._num_points, urdf_id)

    def _load_models(self) -> dict[int, Model]:
        path = self.root / "urdf_metas.json"
        content = read_json(path)
        models = {}
        try:
            for meta in content["urdf_metas"]:
                if meta["category_name"] in self._conversion.file_names:
                    where = f"{path}, model {meta['id']}"
                    models[meta["id"]] = read_model(meta, self.category, self._conversion, where)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            if isinstance(error, CaperError):
                raise
            raise CaperError(f"{path}: unexpected content ({error!r})") from error
        if not models:
            raise CaperError(f"{path}: describes no {self.category.name}")
        return models

    def _list_names(self) -> list[str]:
        """Names of the split's instances of this category, in the order of the files."""
        folder = self.root / "annotations"
        if self.split == ALL:
            wanted = None
            images = [
                str(path.relative_to(folder).with_suffix(""))
                for path in sorted(folder.glob("**/*.json"))
            ]
        else:
            path = self.root / f"{self.split}.txt"
            if not path.is_file():
                raise CaperError(
                    f"{self.root}: no split {self.split!r} (no {path.name}); it has "
                    f"{', '.join([ALL, *list_splits(self.root)])}"
                )
            wanted = read_list(path)
            images = list(dict.fromkeys(name.rpartition("_")[0] for name in wanted))
        found: dict[str, bool] = {}
        broken: set[str] = set()
        for image in images:
            try:
                annotation = self._read_annotation(image)
            except CaperError as error:
                if self._on_broken is None:
                    raise
                self._on_broken(error)
                broken.add(image)
                continue
            for instance in annotation["instances"]:
                ours = instance["category_id"] == self._conversion.category_id
                found[f"{image}_{instance['id']}"] = ours
        if broken and wanted is not None:
            wanted = [name for name in wanted if name.rpartition("_")[0] not in broken]
        unknown = [name for name in wanted or () if name not in found]
        if unknown:
            raise CaperError(f"{path}: names {unknown[0]!r}, which no annotation describes")
        names = [name for name in wanted or found if found[name]]
        if not names:
            raise NoFramesError(
                f"{self.root}: split {self.split!r} shows no instance of {self.category.name!r}"
            )
        return names

    def _path(self, image_name: str) -> Path:
        return self.root / "annotations" / f"{image_name}.json"

    def _read_annotation(self, image_name: str) -> dict[str, Any]:
        path = self._path(image_name)
        content = checked_annotation(path, (), _INSTANCE_KEYS)
        ids = [instance["id"] for instance in content["instances"]]
        for number in ids:
            if isinstance(number, bool) or not isinstance(number, int):
                raise CaperError(
                    f"{path}: the id of an instance must be an integer, got {number!r}"
                )
            # A frame is named by it.
            if ids.count(number) > 1:
                raise CaperError(f"{path}: {ids.count(number)} instances have the id {number}")
        return content
