"""ReArtMix and ReArt-Videos (dataset2 of KPA-Tracker): real RGB-D frames of ReArt-48 objects.

Layout of a root folder of ReArtMix, frames with several objects each, read unchanged::

    camera_intrinsic.json    Open3D pinhole camera
    urdf_metas.json          boxes of the parts, joint axes and pivots of every model
    annotations/<scene>/NNNNNN.json, depth/<scene>/NNNNNN.png, color/<scene>/NNNNNN.jpg
    train.txt, test.txt      lines ``<scene>/NNNNNN_<instance>``

of ReArt-Videos::

    Data/camera_intrinsic.json
    Data/new_anno_test/<category>/<video>/*.json          annotations
    Data/new_anno_test/flag/<category>/train.txt, test.txt  lines <annotation>.json (any video)
    Data/{depth,color,category_mask}/<path in the annotation>
    URDF/<category>/<id>/mobility_for_unity_align.urdf, model_pts.pkl  [whole, part 1, ..., part K]

No data of ReArt-Videos could be read; its layout is what the public loader opens. Joint states are
those that the transformations give: the unit in the files (radians) is not relied on.

The files keep a uniform scale s in every transformation, ``[s R | t]``, and hold the parts at a
state of their own; frames come out in this project's conventions (meters, rest-canonical frames,
positive states open). The files store boxes of parts in one frame at one pose; z is up and the flat
face of things that lie. What that pose is follows for each category from the boxes, axes and pivots
of the 43 public models, and stands with the category as its ``ReArtConversion``; only boxes could
be checked against annotated images.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Len
from pydantic import PlainValidator

from caper_jax import categories
from caper_jax.arrays import checked_array, finite_array
from caper_jax.articulation.category import Category
from caper_jax.articulation.conversions import AxisMap, ReArtConversion, StoredObject
from caper_jax.articulation.kinematics import forward_kinematics_float64
from caper_jax.data import safe_pickle
from caper_jax.data.images import check_values, read_depth, read_json_as
from caper_jax.data.readers.annotations import (
    Annotation,
    Instance,
    Model,
    OutlinedLink,
    check_image_size,
    labeled_frame,
    ordered_links,
    polygon_labels,
    pose_of_parts,
)
from caper_jax.data.readers.artimage import SingleAnnotation, object_named_in
from caper_jax.data.readers.artimage_models import ALIGNED, moving_joints
from caper_jax.data.readers.base import ALL, DatasetReader, Schema, in_natural_order, read_list
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError

_CATEGORY_ID = re.compile(rb'"category_id"\s*:\s*(\d+)')
# A joint is named base_link_link1_joint or base|revolute|link1.
_JOINT_NAME = r"link(\d+)(?:_joint)?$"
# joint_xyz and joint_rpy name the axes in another order than corner_pts and transformation.
_JOINT_ORDER = [1, 2, 0]


def _corners(box: Any) -> np.ndarray:
    """[2, 3] corners of a box, in lists of any depth."""
    return finite_array(box, (2, 3))


_Vectors = list[Annotated[list[float], Len(3, 3)]]


class _MixedInstance(Instance):
    id: int
    category_id: int


class _MixedAnnotation(Annotation):
    instances: list[_MixedInstance]


class _Meta(Schema):
    """A model in urdf_metas.json; parts count from 1, corner_pts begin with the whole object."""

    id: int
    category_name: str
    corner_pts: list[Annotated[np.ndarray, PlainValidator(_corners)]]
    joint_rpy: _Vectors
    joint_xyz: _Vectors
    joint_parents: list[int]
    joint_children: list[int]
    joint_types: list[str]


class _Metas(Schema):
    urdf_metas: list[dict[str, Any]]


class _ReArtReader(DatasetReader):
    """What both datasets share."""

    mask_source = "annotated polygons"
    family = "reart"
    depth_folder: Path

    def frame_of(
        self, name: str, annotation: Annotation, instance: Instance, path: Path, where: str
    ) -> Frame:
        """One frame of an instance; ``where`` names it in errors of the annotation ``path``."""
        numbers = [link.get("link_category_id") for link in instance.links]
        first = 0 if 0 in numbers else 1  # counted from 1 in ReArt-48, from 0 in some copies
        links = ordered_links(instance, OutlinedLink, self.category.num_parts, first, where)
        model: Model = self._model(instance.urdf_id)
        parts = [link.transformation for link in links]
        truth = pose_of_parts(model, parts, self.category, where, scaled=True)
        depth_path = self.depth_folder / annotation.depth_path
        depth = read_depth(depth_path)
        check_image_size(depth_path, depth, annotation, path)
        labels = polygon_labels(links, depth.shape)
        camera = self.intrinsics_for(depth)
        return labeled_frame(name, depth, labels, camera, truth, self.num_points, instance.urdf_id)


class ReArtMixDataset(_ReArtReader):
    """Every annotated instance of one category; names are the lines of train.txt: scene6/000003_0.

    Other categories in the images are left out. Annotations are read beforehand: those that cannot
    be, ``on_broken`` takes.
    """

    format = "reartmix"
    title = "ReArtMix"

    @classmethod
    def categories_in(cls, root: Path) -> list[str]:
        """Those that annotations show; urdf_metas.json names all categories in every root."""
        known = {
            str(cls.conversion_of(categories.registered(name)).category_id).encode(): name
            for name in cls.known_categories()
        }
        present: set[bytes] = set()
        for path in sorted((root / "annotations").glob("**/*.json")):
            # Annotations are long (polygons) and often show the same categories.
            present |= set(_CATEGORY_ID.findall(path.read_bytes())) & set(known)
            if len(present) == len(known):
                break
        return sorted(known[number] for number in present)

    @classmethod
    def split_folder(cls, root: Path, category: Category) -> Path:
        return root  # lists of all categories together

    def open(self) -> None:
        self.depth_folder = self.root / "depth"
        for name in ("annotations", "depth"):
            self.need_folder(self.root / name)
        self.use_camera(self.root / "camera_intrinsic.json")
        path = self.root / "urdf_metas.json"
        metas = read_json_as(path, _Metas).urdf_metas
        names = self.conversion.names
        ours = [(i, meta) for i, meta in enumerate(metas) if meta.get("category_name") in names]
        if not ours:
            raise CaperError(f"{path}: describes no {self.category.name}")
        self._metas = {
            str(meta.get("id")): check_values(_Meta, meta, f"{path}: urdf_metas.{i}")
            for i, meta in ours
        }
        self._annotation = lru_cache(maxsize=4)(_read_annotation)

    def list_frames(self) -> dict[str, Path]:
        """Of all annotations, or of those that the split's file names."""
        folder = self.root / "annotations"
        files = sorted(folder.glob("**/*.json"))
        listed = self.root / f"{self.split}.txt"
        if self.split != ALL and listed.is_file():
            images = dict.fromkeys(line.rpartition("_")[0] for line in read_list(listed))
            files = [folder / f"{image}.json" for image in images]
        frames: dict[str, Path] = {}
        self._passed_over: set[str] = set()  # of other categories, or in broken files
        for path in files:
            image = path.relative_to(folder).with_suffix("").as_posix()
            annotation = self.unless_broken(_read_annotation, path)
            if annotation is None:
                self._passed_over.add(image)
                continue
            for instance in annotation.instances:
                name = f"{image}_{instance.id}"
                if instance.category_id == self.conversion.category_id:
                    frames[name] = path
                else:
                    self._passed_over.add(name)
        return frames

    def frames_of_line(self, line: str) -> list[str] | None:
        passed_over = {line, line.rpartition("_")[0]} & self._passed_over
        return [] if passed_over else super().frames_of_line(line)

    def read_model(self, object_id: str) -> Model:
        path = self.root / "urdf_metas.json"
        if object_id not in self._metas:
            raise CaperError(f"{path}: lacks a {self.category.name} with the id {object_id}")
        meta = self._metas[object_id]
        return rest_model(meta, self.category, self.conversion, f"{path}, model {object_id}")

    def read_frame(self, name: str, path: Path) -> Frame:
        annotation = self._annotation(path)
        number = int(name.rpartition("_")[2])
        instance = next(i for i in annotation.instances if i.id == number)
        return self.frame_of(name, annotation, instance, path, f"{path}, instance {number}")


def _read_annotation(path: Path) -> _MixedAnnotation:
    annotation = read_json_as(path, _MixedAnnotation)
    ids = [instance.id for instance in annotation.instances]
    twice = {number for number in ids if ids.count(number) > 1}
    if twice:  # a frame is named by it
        raise CaperError(f"{path}: {ids.count(min(twice))} instances have the id {min(twice)}")
    return annotation


class ReArtVideosDataset(_ReArtReader):
    """The frames of all videos of one category; names are ``<video>/<annotation>``."""

    format = "reart-videos"
    title = "ReArt-Videos"
    has_official_split = True
    has_videos = True

    @classmethod
    def categories_in(cls, root: Path) -> list[str]:
        folder = root / "Data" / "new_anno_test"
        return [
            name
            for name in cls.known_categories()
            if any((folder / cls._folder(categories.registered(name))).glob("*/*.json"))
        ]

    @classmethod
    def split_folder(cls, root: Path, category: Category) -> Path:
        return root / "Data" / "new_anno_test" / "flag" / cls._folder(category)

    @classmethod
    def _folder(cls, category: Category) -> str:
        return cls.conversion_of(category).names[0]

    def open(self) -> None:
        self.depth_folder = self.root / "Data" / "depth"
        self._annotations = self.root / "Data" / "new_anno_test" / self._folder(self.category)
        self.need_folder(self._annotations)
        self.use_camera(self.root / "Data" / "camera_intrinsic.json")

    def list_frames(self) -> dict[str, Path]:
        paths = self._annotations.glob("*/*.json")
        return in_natural_order({f"{path.parent.name}/{path.stem}": path for path in paths})

    def object_of(self, path: Path) -> str:
        return object_named_in(path)

    def read_frame(self, name: str, path: Path) -> Frame:
        annotation = read_json_as(path, SingleAnnotation)
        return self.frame_of(name, annotation, annotation.instances[0], path, str(path))

    def read_model(self, object_id: str) -> Model:
        """From clouds and a URDF, as if urdf_metas.json described it."""
        home = self.root / "URDF" / self._folder(self.category) / object_id
        path, urdf = home / "model_pts.pkl", home / ALIGNED
        clouds = check_values(list, safe_pickle.load(path), str(path))
        corners = []
        for number, cloud in enumerate(clouds):
            points = np.asarray(cloud)[:, :3] if np.ndim(cloud) == 2 else cloud
            points = checked_array(f"{path}: cloud {number}", points, (None, 3))
            corners.append(np.stack([points.min(0), points.max(0)]))
        if len(clouds) != 1 + self.category.num_parts:
            raise CaperError(
                f"{path}: holds {len(clouds)} clouds, expected the whole object and "
                f"{self.category.num_parts} parts"
            )
        joints = moving_joints(urdf, _JOINT_NAME)
        meta = _Meta(
            id=0,
            category_name=self.category.name,
            corner_pts=corners,
            joint_rpy=[joint.axis.tolist() for joint in joints],
            joint_xyz=[joint.origin[:3, 3].tolist() for joint in joints],
            # Public loaders take every joint to be mounted on the root.
            joint_parents=[1] * len(joints),
            joint_children=list(range(2, len(joints) + 2)),
            joint_types=[joint.kind for joint in joints],
        )
        return rest_model(meta, self.category, self.conversion, str(urdf))


# The objects.


def rest_model(meta: _Meta, category: Category, conversion: ReArtConversion, where: str) -> Model:
    """Brings one model to its rest pose, and boxes and joints to our frame.

    Args:
      meta: its entry in urdf_metas.json.
      category: gives the parts, their tree and the types of joints.
      conversion: of that category.
      where: file and model, for errors.

    Raises:
      CaperError: a model that does not fit the category, or boxes and axes unlike those that the
        conversion was made for.
    """
    stored = _stored_object(meta, category, conversion, where)
    axes = np.array(conversion.axes)
    states = np.full(category.num_joints, -conversion.stored_state(stored))
    tree = category.joint_types, category.parents
    rest = forward_kinematics_float64(np.eye(4), stored.axis, stored.pivot, states, *tree)
    # Measured axes are off by up to 6 deg; what is built square turns about the ideal one.
    ideal_axis = np.tile(conversion.opening, (category.num_joints, 1))
    ideal = forward_kinematics_float64(
        np.eye(4), ideal_axis, np.zeros_like(stored.pivot), states, *tree
    )

    extents = stored.high - stored.low
    middles = np.einsum("kij,kj->ki", rest[:, :3, :3], (stored.low + stored.high) / 2)
    center = (middles + rest[:, :3, 3]) @ axes.T
    if conversion.square_at_rest:
        # The box that, as the file stores it, has the bounds in the file.
        bounds_of = np.abs(axes @ ideal[:, :3, :3]).swapaxes(-1, -2)
        size = np.linalg.solve(bounds_of, extents[..., None])[..., 0]
    else:
        size = (np.abs(axes @ rest[:, :3, :3]) @ extents[..., None])[..., 0]
    if np.min(size) <= 0:
        raise CaperError(f"{where}: no closed {category.name} has the boxes {extents.tolist()}")
    axis_map = AxisMap(axes, tuple(range(category.num_parts)), np.ones(category.num_joints))
    return Model.of_rest(stored, rest, axis_map, size, center)


def _stored_object(
    meta: _Meta, category: Category, conversion: ReArtConversion, where: str
) -> StoredObject:
    """Boxes and joints of one model, checked against the category."""
    parts = category.num_parts
    corners = np.array(meta.corner_pts[1:]).reshape(-1, 2, 3)
    ends = zip(meta.joint_parents, meta.joint_children, strict=False)
    tree = [(parent - 1, child - 1) for parent, child in ends]
    expected = [(joint.parent, j + 1) for j, joint in enumerate(category.joints)]
    types = tuple(meta.joint_types)
    counts = {len(meta.joint_rpy), len(meta.joint_xyz), category.num_joints}
    if (
        len(corners) != parts
        or tree != expected
        or types != category.joint_types
        or len(counts) > 1
    ):
        raise CaperError(
            f"{where}: {len(corners)} parts with {types} joints {tree}, but {category.name} has "
            f"{parts} parts with {category.joint_types} joints {expected}"
        )
    axis = np.asarray(meta.joint_rpy, np.float64)[:, _JOINT_ORDER]
    pivot = np.asarray(meta.joint_xyz, np.float64)[:, _JOINT_ORDER]
    axis /= np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-12)
    # Which way an axis points is the files' own matter: states come from poses.
    share = axis @ np.array(conversion.opening)
    if not (np.abs(share) > np.sqrt(0.5)).all():
        raise CaperError(f"{where}: joint axis {axis[0]} lies across the one of other models")
    return StoredObject(corners.min(1), corners.max(1), axis * np.sign(share)[:, None], pivot)
