"""What annotations of the public layouts share: links with transformations and polygons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from annotated_types import Gt, Lt
from PIL import Image, ImageDraw
from pydantic import (
    AfterValidator,
    BeforeValidator,
    PlainValidator,
    StringConstraints,
)
from scipy.spatial.transform import Rotation

from caper_jax.arrays import finite_array
from caper_jax.articulation.category import Category
from caper_jax.articulation.conversions import AxisMap, RestObject, StoredObject
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.clouds import MIN_POINTS, cloud_from_depth
from caper_jax.data.images import check_values
from caper_jax.data.readers.base import Schema
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError

_SCALE_TOLERANCE = 1e-3


LinkSchema = TypeVar("LinkSchema", bound="Link")


@dataclass(frozen=True)
class ScaledPose:
    """A transformation ``[s R | t]``: s, R [3, 3] and t [3]."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray


def scaled_pose(rows: Any) -> ScaledPose:
    """From 4 rows of 4 numbers; ValueError for anything but a scaled rotation."""
    matrix = finite_array(rows, (4, 4))
    determinant = np.linalg.det(matrix[:3, :3])
    if determinant <= 0:
        raise ValueError(f"must be a scaled rotation, has determinant {determinant:.3g}")
    scale = float(np.cbrt(determinant))
    rotation = matrix[:3, :3] / scale
    drift = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not drift <= _SCALE_TOLERANCE:
        raise ValueError(f"must be a scaled rotation, is off by {drift:.2g}")
    return ScaledPose(scale, rotation, matrix[:3, 3])


def _pairs(polygon: list[float]) -> list[float]:
    if len(polygon) % 2:
        raise ValueError("must be pairs of pixel coordinates, has an odd number")
    return polygon


def _name_of_object(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, (int, str)):
        raise ValueError("must be a number or text")
    return str(value)


# It names a folder, so nothing that could lead out of the dataset.
ObjectId = Annotated[
    str, BeforeValidator(_name_of_object), StringConstraints(pattern=r"^\w[\w.-]*$")
]
# No image is as large: what lies beyond is no pixel.
Pixel = Annotated[float, Gt(-1e6), Lt(1e6)]
Polygon = Annotated[list[Pixel], AfterValidator(_pairs)]


class Link(Schema):
    """A part in an instance.

    Attributes:
      link_category_id: which part it is.
      transformation: the part's frame in the files -> camera (OpenCV), meters.
      state: of its joint, where the file states it.
    """

    link_category_id: int
    transformation: Annotated[ScaledPose, PlainValidator(scaled_pose)]
    state: float | None = None


class OutlinedLink(Link):
    """A part with the polygons x, y, x, y, ... of its pixels."""

    segmentation: list[Polygon]


class Instance(Schema):
    """An object in an image; its links, in any order, are checked when its frame is read."""

    urdf_id: ObjectId
    links: list[dict[str, Any]]


class Annotation(Schema):
    """What an image shows.

    Attributes:
      depth_path: of the depth image, relative to a folder of the layout.
      width, height: of the image, where stated.
    """

    depth_path: str
    width: int | None = None
    height: int | None = None


@dataclass(frozen=True)
class Model:
    """One object in our rest pose and frame, at the scale of the files.

    Attributes:
      to_file_rotation: [K, 3, 3], our rest frame -> the parts' file frames.
      to_file_shift: [K, 3], likewise.
      size, center: [K, 3] boxes of the parts.
      axis: [J, 3] unit joint axes in our frame, positive opens.
      pivot: [J, 3] points on them, in our frame.
      links: part k is link ``links[k]`` of the file.
      signs: [J] our state of joint j is ``signs[j]`` times the file's.
    """

    to_file_rotation: np.ndarray
    to_file_shift: np.ndarray
    size: np.ndarray
    center: np.ndarray
    axis: np.ndarray
    pivot: np.ndarray
    links: tuple[int, ...]
    signs: np.ndarray

    @classmethod
    def of_rest(
        cls,
        rest: RestObject | StoredObject,
        poses: np.ndarray,
        axes: AxisMap,
        size: np.ndarray,
        center: np.ndarray,
    ) -> Model:
        """From an object at rest in the file's frame; the origin is the middle of all boxes.

        Args:
          rest: gives the joints.
          poses: [K, 4, 4] links' own frames -> the file's frame, at rest.
          axes: how the file's frame, parts and joints become ours.
          size, center: [K, 3] boxes of our parts along our axes, before the origin is moved.
        """
        rotation, order = axes.rotation, list(axes.order)
        joints = np.array(order[1:], int) - 1
        origin = ((center - size / 2).min(0) + (center + size / 2).max(0)) / 2
        # p_file = R_rest^T (A^T (p_ours + origin) - t_rest)
        back = poses[order, :3, :3].swapaxes(-1, -2)
        shift = rotation.T @ origin - poses[order, :3, 3]
        return cls(
            to_file_rotation=back @ rotation.T,
            to_file_shift=np.einsum("kij,kj->ki", back, shift),
            size=size,
            center=center - origin,
            axis=axes.signs[:, None] * (rest.axis[joints] @ rotation.T),
            pivot=rest.pivot[joints] @ rotation.T - origin,
            links=axes.order,
            signs=axes.signs,
        )


def ordered_links(
    instance: Instance, schema: type[LinkSchema], num_parts: int, first: int, where: str
) -> list[LinkSchema]:
    """The links of an instance, checked, in the order of the parts.

    Args:
      instance: of an annotation.
      schema: what a link must have.
      num_parts: K.
      first: the ``link_category_id`` of the root.
      where: file and instance, for errors.

    Raises:
      CaperError: a link that does not fit the schema, a part without a link, or a link too many.
    """
    links = [
        check_values(schema, link, f"{where}, link {number}")
        for number, link in enumerate(instance.links)
    ]
    numbers = [link.link_category_id - first for link in links]
    if sorted(numbers) != list(range(num_parts)):
        raise CaperError(
            f"{where}: link_category_id must be {first} to {first + num_parts - 1}, each once, got "
            f"{[link.link_category_id for link in links]}"
        )
    return [links[numbers.index(part)] for part in range(num_parts)]


def check_image_size(path: Path, image: np.ndarray, annotation: Annotation, by: Path) -> None:
    """CaperError for an image [H, W] of another size than its annotation states.

    Args:
      path: file of the image.
      image: what was read from it.
      annotation: may state a size.
      by: file of the annotation.
    """
    height, width = image.shape
    stated = annotation.width or width, annotation.height or height
    if stated != (width, height):
        raise CaperError(
            f"{path}: image of {width} x {height}, but {by} says width {stated[0]}, height "
            f"{stated[1]}"
        )


def polygon_labels(links: Sequence[OutlinedLink], shape: tuple[int, ...]) -> np.ndarray:
    """[H, W] int: part of every pixel, -1 outside; polygons include their outline."""
    canvas = Image.new("L", (shape[1], shape[0]), 0)
    draw = ImageDraw.Draw(canvas)
    for part, link in enumerate(links):
        for polygon in link.segmentation:
            if len(polygon) >= 6:
                draw.polygon(polygon, fill=part + 1)
    return np.asarray(canvas).astype(np.int64) - 1


def labeled_frame(
    name: str,
    depth: np.ndarray,
    labels: np.ndarray,
    intrinsics: np.ndarray,
    truth: ArticulatedPose,
    num_points: int,
    instance: str,
) -> Frame:
    """A frame from a depth image and the parts of its pixels.

    Args:
      name: of the frame.
      depth: [H, W] meters.
      labels: [H, W] int part of every pixel, -1 off the object.
      intrinsics: [3, 3] pixels.
      truth: the pose.
      num_points: points of the cloud; none when too few pixels show the object.
      instance: name of the object in the dataset.
    """
    mask = labels >= 0
    points, pixels = np.zeros((0, 3), np.float32), np.zeros((0, 2), np.int32)
    if np.count_nonzero(mask & (depth > 0)) >= MIN_POINTS:
        cloud = cloud_from_depth(depth, mask, intrinsics, num_points)
        points, pixels = cloud.points, cloud.pixels
    return Frame(
        name=name,
        points=points,
        labels=labels[pixels[:, 0], pixels[:, 1]].astype(np.int32),
        truth=truth,
        visible=np.bincount(labels[mask], minlength=len(truth.size)),
        depth=depth,
        mask=mask,
        intrinsics=intrinsics,
        instance=instance,
    )


def pose_of_parts(
    model: Model, parts: Sequence[ScaledPose], category: Category, where: str, scaled: bool
) -> ArticulatedPose:
    """The pose in our conventions from the transformations of a file.

    Args:
      model: the object in our rest pose and frame, at the scale of the files.
      parts: K transformations, file frame of a part -> camera, in the order of our parts.
      category: gives the tree and the types of the joints.
      where: file and instance, for errors.
      scaled: transformations carry one scale per object; else their scale must be 1.

    Raises:
      CaperError: transformations that carry another scale.
    """
    scale = parts[0].scale if scaled else 1.0
    if max(abs(part.scale - scale) for part in parts) > _SCALE_TOLERANCE:
        wanted, scales = "one scale" if scaled else "no scale", [part.scale for part in parts]
        raise CaperError(f"{where}: transformations must carry {wanted}, got {scales}")
    file_rotation = np.stack([part.rotation for part in parts])
    rotation = file_rotation @ model.to_file_rotation
    moved = np.einsum("kij,kj->ki", file_rotation, model.to_file_shift)
    translation = np.stack([part.translation for part in parts]) + scale * moved
    return ArticulatedPose(
        rotation=rotation.astype(np.float32),
        translation=translation.astype(np.float32),
        size=(scale * model.size).astype(np.float32),
        box_center=(scale * model.center).astype(np.float32),
        joint_axis=model.axis.astype(np.float32),
        joint_pivot=(scale * model.pivot).astype(np.float32),
        joint_state=_joint_states(rotation, translation, model.axis, category).astype(np.float32),
    )


def _joint_states(
    rotation: np.ndarray, translation: np.ndarray, axis: np.ndarray, category: Category
) -> np.ndarray:
    """[J] states that the poses of parent and child give; angles nearest the joint's limits."""
    states = []
    for j, joint in enumerate(category.joints):
        parent, child = joint.parent, j + 1
        if joint.type == "revolute":
            # The twist about the axis, which a measured rotation misses a little.
            quaternion = Rotation.from_matrix(rotation[parent].T @ rotation[child]).as_quat()
            state = 2 * np.arctan2(quaternion[:3] @ axis[j], quaternion[3])
            middle = sum(joint.limits) / 2
            state = middle + (state - middle + np.pi) % (2 * np.pi) - np.pi
        else:
            state = float(rotation[parent].T @ (translation[child] - translation[parent]) @ axis[j])
        states.append(state)
    return np.array(states)
