"""ArtImage (OMAD) and PM-Videos (dataset1 of KPA-Tracker): rendered frames of PartNet objects.

Layout of a root folder of ArtImage, read unchanged::

    camera_intrinsic.json                    Open3D pinhole camera
    <category>/train.txt, test.txt           lines NNNNNN.json
    <category>/train/annotations/NNNNNN.json, depth/*.png, category_mask/*.png, color/*.jpg
    <category>/urdf/rest_state.json, <id>/   the objects (artimage_models.py)

Frames of every split lie under train/. Any category of this project may stand in a root; its
parts, tree and joints are the category's. PartNet units are read as meters. Frames come out in
this project's conventions; artimage_models.py says what could not be verified of that.

In PM-Videos the frames of a video lie in a folder of their own, <category>/train/<video>/, lines
are NNNNNN.json (any video) or <video>/NNNNNN.json, and annotations carry ``sort_part``, the link
that moves in the video.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Len

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.articulation.conversions import ArtImageConversion
from caper_jax.data.images import read_depth, read_json_as, read_labels
from caper_jax.data.readers.annotations import (
    Annotation,
    Instance,
    Link,
    Model,
    check_image_size,
    labeled_frame,
    ordered_links,
    pose_of_parts,
)
from caper_jax.data.readers.artimage_models import read_model
from caper_jax.data.readers.base import DatasetReader, in_natural_order
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError

# A state of the files and the one that the transformations give may differ by this much.
_STATE_TOLERANCE = {"revolute": (1.0, "degrees"), "prismatic": (0.01, "meters")}
_URDF_ID = re.compile(rb'"urdf_id"\s*:\s*"?([\w.-]+)')


class SingleAnnotation(Annotation):
    """An image of one object; ``sort_part`` is the link that moves in a video."""

    instances: Annotated[list[Instance], Len(1, 1)]
    sort_part: int | None = None


def object_named_in(path: Path) -> str:
    """urdf_id of an annotation, without reading polygons as numbers; CaperError without one."""
    match = _URDF_ID.search(path.read_bytes())
    if match is None:
        raise CaperError(f"{path}: no annotation, it lacks 'urdf_id'")
    return match[1].decode()


class ArtImageDataset(DatasetReader):
    """The images of one category; names are the annotations' without suffix, e.g. ``000123``."""

    format = "artimage"
    mask_source = "annotated part masks"
    family = "artimage"
    has_official_split = True
    _annotations = "train/annotations/*.json"  # in the category's folder

    @classmethod
    def conversion_of(cls, category: Category) -> ArtImageConversion:
        return category.datasets.get("artimage") or ArtImageConversion()  # type: ignore[return-value]

    @classmethod
    def categories_in(cls, root: Path) -> list[str]:
        return [name for name in categories.names() if any((root / name).glob(cls._annotations))]

    @classmethod
    def split_folder(cls, root: Path, category: Category) -> Path:
        return root / category.name

    def open(self) -> None:
        self._home = self.root / self.category.name
        present = sorted(path.parent.name for path in self.root.glob("*/train"))
        self.need_folder(self._home / "train", f"; it holds {', '.join(present) or 'none'}")
        self.use_camera(self.root / "camera_intrinsic.json")

    def list_frames(self) -> dict[str, Path]:
        return {path.stem: path for path in sorted(self._home.glob(self._annotations))}

    def object_of(self, path: Path) -> str:
        return object_named_in(path)

    def read_model(self, object_id: str) -> Model:
        return read_model(self._home / "urdf", object_id, self.category, self.conversion)

    def read_frame(self, name: str, path: Path) -> Frame:
        annotation = read_json_as(path, SingleAnnotation)
        instance = annotation.instances[0]
        links = ordered_links(instance, Link, self.category.num_parts, first=0, where=str(path))
        model: Model = self._model(instance.urdf_id)
        links = [links[link] for link in model.links]
        parts = [link.transformation for link in links]
        truth = pose_of_parts(model, parts, self.category, str(path), scaled=False)
        self._check_states(links, model, truth.joint_state, path)

        depth_path = path.parent.parent / annotation.depth_path
        mask_path = path.parent.parent / annotation.depth_path.replace("depth", "category_mask")
        depth, masks = read_depth(depth_path), read_labels(mask_path)
        check_image_size(depth_path, depth, annotation, path)
        check_image_size(mask_path, masks, annotation, path)
        # Background carries a label that is no part (255 in the sample data).
        part_of_label = np.full(max(int(masks.max()), self.category.num_parts) + 1, -1)
        part_of_label[list(model.links)] = np.arange(self.category.num_parts)
        labels = part_of_label[np.maximum(masks, 0)]
        camera = self.intrinsics_for(depth)
        return labeled_frame(name, depth, labels, camera, truth, self.num_points, instance.urdf_id)

    def _check_states(
        self, links: list[Link], model: Model, states: np.ndarray, path: Path
    ) -> None:
        """Refuses states (deg, m) that contradict the transformations: wrong unit or sign."""
        for j, joint in enumerate(self.category.joints):
            stated = links[j + 1].state
            if stated is None:
                continue
            tolerance, unit = _STATE_TOLERANCE[joint.type]
            given = model.signs[j] * float(states[j])
            difference = stated - given
            if joint.type == "revolute":
                given = np.degrees(given)
                difference = (stated - given + 180) % 360 - 180
            if not abs(difference) <= tolerance:
                raise CaperError(
                    f"{path}: state of link {model.links[j + 1]} is {stated:g}, but its "
                    f"transformation gives {given:.4g} {unit}"
                )


class PmVideosDataset(ArtImageDataset):
    """The frames of all videos of one category; names are ``<video>/<frame>``: 00001/000034."""

    format = "pm-videos"
    title = "pm-videos"
    has_videos = True
    _annotations = "train/*/annotations/*.json"

    def list_frames(self) -> dict[str, Path]:
        paths = self._home.glob(self._annotations)
        return in_natural_order({f"{path.parent.parent.name}/{path.stem}": path for path in paths})

    def moving_part(self, index: int) -> int | None:
        """The part that moves in the video of frame ``index`` (``sort_part``); None if not stated.

        Raises:
          CaperError: a link that is none of the category's, or a broken annotation.
        """
        path = self._files[self.names[index]]
        annotation = read_json_as(path, SingleAnnotation)
        link = annotation.sort_part
        if link is None:
            return None
        if not 0 <= link < self.category.num_parts:
            raise CaperError(
                f"{path}: sort_part must be a link from 0 to {self.category.num_parts - 1}, got "
                f"{link}"
            )
        return self._model(annotation.instances[0].urdf_id).links.index(link)
