"""What annotations of the public layouts share: links with transformations and polygons."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.clouds import MIN_POINTS, cloud_from_depth
from caper_jax.data.images import read_json
from caper_jax.data.readers.reartmix_models import Model
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError

_SCALE_TOLERANCE = 1e-3
_FAR_PIXEL = 1e6  # no image is as large


def checked_annotation(
    path: Path, keys: tuple[str, ...], instance_keys: tuple[str, ...]
) -> dict[str, Any]:
    """The content of an annotation, of which depth_path, instances and links have their types.

    Args:
      path: the file.
      keys: what it must have besides depth_path and instances.
      instance_keys: what every instance must have besides links.

    Raises:
      CaperError: missing or broken file, one that lacks a key, or a value of another type.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise CaperError(f"{path}: no annotation, it is no JSON object")
    _require(content, ("depth_path", "instances", *keys), f"{path}: no annotation, it")
    if not isinstance(content["depth_path"], str):
        raise CaperError(f"{path}: depth_path must be text, got {content['depth_path']!r}")
    for instance in _objects(content["instances"], f"{path}: instances"):
        _require(instance, ("links", *instance_keys), f"{path}: an instance")
        _objects(instance["links"], f"{path}: links")
    return content


def _require(content: dict[str, Any], keys: tuple[str, ...], what: str) -> None:
    missing = [key for key in keys if key not in content]
    if missing:
        raise CaperError(f"{what} lacks {missing[0]!r}")


def _objects(value: Any, where: str) -> list[dict[str, Any]]:
    """A list of JSON objects; CaperError for anything else."""
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        found = "another list" if isinstance(value, list) else repr(value)
        raise CaperError(f"{where} must be a list of objects, got {found}")
    return value


def ordered_links(
    instance: dict[str, Any], num_parts: int, where: str, first: int, keys: tuple[str, ...]
) -> list[dict[str, Any]]:
    """The links in the order of the parts.

    Args:
      instance: one instance of an annotation; its links come in any order.
      num_parts: K.
      where: file and instance, for errors.
      first: the ``link_category_id`` of the root.
      keys: what every link must have.

    Raises:
      CaperError: a part without a link, a link too many, or one that lacks a key.
    """
    try:
        links = {link["link_category_id"] - first: link for link in instance["links"]}
        ordered = [links[part] for part in range(num_parts)]
        for link in ordered:
            for key in keys:
                link[key]
    except (KeyError, TypeError) as error:
        raise CaperError(f"{where}: a link lacks {error}") from error
    if len(instance["links"]) != num_parts:
        raise CaperError(f"{where}: {len(instance['links'])} links, expected {num_parts}")
    return ordered


def split_transformation(value: Any, where: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3] and translation [3] of ``[s R | t]``.

    Raises:
      CaperError: not 4x4 finite numbers, or not a scaled rotation.
    """
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise CaperError(f"{where}: transformation must be 4x4 finite numbers") from error
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise CaperError(f"{where}: transformation must be 4x4 finite numbers")
    determinant = np.linalg.det(matrix[:3, :3])
    if determinant <= 0:
        raise CaperError(f"{where}: transformation has determinant {determinant:.3g}")
    scale = float(np.cbrt(determinant))
    rotation = matrix[:3, :3] / scale
    drift = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if drift > _SCALE_TOLERANCE:
        raise CaperError(f"{where}: transformation is no scaled rotation (off by {drift:.2g})")
    return scale, rotation, matrix[:3, 3]


def check_image_size(path: Path, image: np.ndarray, annotation: dict[str, Any], by: Path) -> None:
    """Refuses an image [H, W] of another size than its annotation states, where it states one.

    Args:
      path: file of the image.
      image: what was read from it.
      annotation: content of the annotation.
      by: file of the annotation.

    Raises:
      CaperError: names both files and both sizes.
    """
    height, width = image.shape
    stated = annotation.get("width", width), annotation.get("height", height)
    if stated != (width, height):
        raise CaperError(
            f"{path}: image of {width} x {height}, but {by} says width {stated[0]}, height "
            f"{stated[1]}"
        )


def polygon_labels(links: list[dict[str, Any]], shape: tuple[int, ...], where: str) -> np.ndarray:
    """[H, W] int: part of every pixel, -1 outside; polygons include their outline.

    Raises:
      CaperError: a segmentation that is no list of polygons, or a polygon that is no list of pairs
        of finite coordinates.
    """
    canvas = Image.new("L", (shape[1], shape[0]), 0)
    draw = ImageDraw.Draw(canvas)
    for part, link in enumerate(links):
        polygons = link["segmentation"]
        if not isinstance(polygons, list) or not all(isinstance(p, list) for p in polygons):
            raise CaperError(f"{where}: segmentation of part {part} must be a list of polygons")
        for polygon in polygons:
            if len(polygon) % 2:
                raise CaperError(f"{where}: a polygon has an odd number of coordinates")
            for value in polygon:
                # Not NaN either, which Pillow draws as anything.
                if not isinstance(value, (int, float)) or not -_FAR_PIXEL < value < _FAR_PIXEL:
                    raise CaperError(
                        f"{where}: a polygon of part {part} must hold pixels, got {value!r}"
                    )
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
      intrinsics: [3, 3].
      truth: the pose.
      num_points: points of the cloud; none when too few pixels show the object.
      instance: name of the object in the data set.
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


def pose_of_links(
    model: Model, links: list[dict[str, Any]], category: Category, where: str, scaled: bool
) -> ArticulatedPose:
    """The pose in our conventions from the transformations of links.

    Args:
      model: the object in our rest pose and frame, at the scale of the files.
      links: K links in the order of the parts.
      category: gives the tree and the types of the joints.
      where: file and instance, for errors.
      scaled: transformations are ``[s R | t]`` with one scale s per object; else s must be 1.

    Raises:
      CaperError: transformations that are none, or that carry another scale.
    """
    scales, rotations, shifts = zip(
        *(split_transformation(link["transformation"], where) for link in links), strict=True
    )
    scale = scales[0] if scaled else 1.0
    if max(abs(other - scale) for other in scales) > _SCALE_TOLERANCE:
        wanted = "one scale" if scaled else "no scale"
        raise CaperError(f"{where}: transformations must carry {wanted}, got {scales}")
    file_rotation = np.stack(rotations)
    rotation = file_rotation @ model.to_file_rotation
    moved = np.einsum("kij,kj->ki", file_rotation, model.to_file_shift)
    translation = np.stack(shifts) + scale * moved
    return ArticulatedPose(
        rotation=rotation.astype(np.float32),
        translation=translation.astype(np.float32),
        size=(scale * model.size).astype(np.float32),
        box_center=(scale * model.center).astype(np.float32),
        joint_axis=model.axis.astype(np.float32),
        joint_pivot=(scale * model.pivot).astype(np.float32),
        joint_state=joint_states(rotation, translation, model.axis, category).astype(np.float32),
    )


def joint_states(
    rotation: np.ndarray, translation: np.ndarray, axis: np.ndarray, category: Category
) -> np.ndarray:
    """[J] states that the poses of parent and child give; angles nearest the joint's limits.

    Args:
      rotation: [K, 3, 3] rest-canonical part frames -> camera.
      translation: [K, 3] meters, likewise.
      axis: [J, 3] unit axes in the root's rest frame.
      category: gives the tree and the types of the joints.
    """
    states = []
    for j, joint in enumerate(category.joints):
        parent, child = joint.parent, j + 1
        if joint.type == "revolute":
            state = angle_about(rotation[parent].T @ rotation[child], axis[j])
            middle = sum(joint.limits) / 2
            state = middle + (state - middle + np.pi) % (2 * np.pi) - np.pi
        else:
            state = float(rotation[parent].T @ (translation[child] - translation[parent]) @ axis[j])
        states.append(state)
    return np.array(states)


def angle_about(rotation: np.ndarray, axis: np.ndarray) -> float:
    """Signed angle about a unit axis, (-pi, pi], of a rotation [3, 3] about (nearly) that axis."""
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return float(np.arctan2(skew @ axis / 2, (np.trace(rotation) - 1) / 2))
