"""One frame of data, what a dataset offers, and the checks that both must pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Protocol

import jax
import numpy as np

from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError
from caper_jax.lie import se3

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category

# Ground truth is exact up to the float32 it is stored in, or up to an annotator's hand; looser
# parts cannot be joined by the joint that the frame names.
_KINEMATICS_TOLERANCE_RAD = 5e-3
_KINEMATICS_TOLERANCE_M = 1e-3
_ROTATION_TOLERANCE = 1e-3
_MAX_DISTANCE_M = 50.0


class NoFramesError(CaperError):
    """A split that holds no frame of a category, in data that are otherwise well."""


@dataclass(frozen=True)
class Frame:
    """One object in one depth frame, in the camera's frame (OpenCV), meters.

    Attributes:
      name: unique within its dataset.
      points: [N, 3] float32 meters, visible surface of the object.
      labels: [N] int32 part of every point, -1 where unknown; None when the data has none.
      truth: pose with arrays [K, ...]; None when the data has none.
      visible: [K] points or pixels that show each part; None when unknown.
      visibility: [K] fraction of each part that neither other parts nor other objects hide, of
        what the camera would see of it alone; None when unknown.
      depth: [H, W] float32 meters, for pictures; None when the data has no image.
      mask: [H, W] bool, the object in ``depth``.
      intrinsics: [3, 3] of ``depth``.
      instance: which object is shown, by its name in the data set (urdf_id, PartNet id, number of
        a generated shape); None when unknown.
    """

    name: str
    points: np.ndarray
    labels: np.ndarray | None = None
    truth: ArticulatedPose | None = None
    visible: np.ndarray | None = None
    visibility: np.ndarray | None = None
    depth: np.ndarray | None = None
    mask: np.ndarray | None = None
    intrinsics: np.ndarray | None = None
    instance: str | None = None


class Dataset(Protocol):
    """A category's frames, read on demand.

    Attributes:
      category: the category all frames show.
      format: name of the layout on disk, as on the command line.
      split: which part of the data this is.
      mask_source: how the object was told from its surroundings (part of every result).
      names: the frames' names, in order.
    """

    category: Category
    format: str
    split: str
    mask_source: str
    names: Sequence[str]

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Frame: ...


def pose_shapes(num_parts: int) -> dict[str, tuple[int, ...]]:
    """Shape of every field of an unbatched ``ArticulatedPose`` with ``num_parts`` parts."""
    joints = num_parts - 1
    return {
        "rotation": (num_parts, 3, 3),
        "translation": (num_parts, 3),
        "size": (num_parts, 3),
        "box_center": (num_parts, 3),
        "joint_axis": (joints, 3),
        "joint_pivot": (joints, 3),
        "joint_state": (joints,),
    }


def validate(frame: Frame, category: Category) -> None:
    """Checks a frame against the conventions, and names everything that is wrong with it.

    Args:
      frame: the frame to check.
      category: the category it claims to show.

    Raises:
      CaperError: shapes, dtypes, non-finite numbers, rotations that are none, parts that their
        joints cannot bring to where they are; all of them in one message.
    """
    problems = frame_problems(frame, category)
    if problems:
        raise CaperError(f"frame {frame.name!r} of {category.name}: {'; '.join(problems)}")


def frame_problems(frame: Frame, category: Category) -> list[str]:
    """What is wrong with a frame, one phrase per problem; empty when all is well."""
    problems = _cloud_problems(frame, category.num_parts)
    if frame.truth is not None:
        problems += pose_problems(frame.truth, category)
    return problems


def pose_problems(pose: ArticulatedPose, category: Category) -> list[str]:
    """What is wrong with poses, as phrases; leading axes of ``pose`` are batch axes.

    Args:
      pose: arrays [..., K, ...] with the same leading axes, e.g. none or [F].
      category: gives K, the joint types and the tree of parts.

    Returns:
      One phrase per problem, naming the first bad entry; empty when all is well.
    """
    arrays = {key: np.asarray(getattr(pose, key)) for key in pose_shapes(category.num_parts)}
    problems = []
    lead = arrays["rotation"].shape[: max(arrays["rotation"].ndim - 3, 0)]
    for key, shape in pose_shapes(category.num_parts).items():
        array = arrays[key]
        if array.shape != lead + shape:
            problems.append(f"{key} has shape {array.shape}, expected {lead + shape}")
        elif not np.issubdtype(array.dtype, np.floating):
            problems.append(f"{key} is {array.dtype}, expected a float array")
        elif not np.isfinite(array).all():
            problems.append(f"{key} has NaN or infinite entries{_first(~np.isfinite(array))}")
    if problems:
        return problems
    double = {key: array.astype(np.float64) for key, array in arrays.items()}

    rotation = double["rotation"]
    drift = np.abs(rotation.swapaxes(-1, -2) @ rotation - np.eye(3)).max((-1, -2))
    mirrored = np.linalg.det(rotation) < 0
    if (drift > _ROTATION_TOLERANCE).any():
        problems.append(
            f"rotation is not orthonormal (off by {drift.max():.2g})"
            f"{_first(drift > _ROTATION_TOLERANCE)}: divide a scaled matrix by its scale"
        )
    elif mirrored.any():
        problems.append(f"rotation is a reflection (determinant -1){_first(mirrored)}")
    if (double["size"] <= 0).any():
        problems.append(f"size must be positive{_first(double['size'] <= 0)}")
    for key in ("translation", "size", "box_center", "joint_pivot"):
        if (np.abs(double[key]) > _MAX_DISTANCE_M).any():
            problems.append(f"{key} is beyond {_MAX_DISTANCE_M:g} m: is it in millimeters?")
    length = np.linalg.norm(double["joint_axis"], axis=-1)
    if (np.abs(length - 1) > _ROTATION_TOLERANCE).any():
        problems.append(f"joint_axis is not a unit vector{_first(np.abs(length - 1) > 1e-3)}")
    if not problems:
        problems += _kinematics_problems(double, category)
    return problems


def _kinematics_problems(arrays: dict[str, np.ndarray], category: Category) -> list[str]:
    """Parts whose pose differs from the one that the root, the joints and the states give."""
    with jax.enable_x64(True):
        expected = np.asarray(_part_poses(arrays, category.joint_types, category.parents))
    # The chord |R - R'| / sqrt 2 equals the angle between the rotations to first order.
    chord = np.linalg.norm(expected[..., :3, :3] - arrays["rotation"], axis=(-1, -2)) / np.sqrt(2)
    distance = np.linalg.norm(expected[..., :3, 3] - arrays["translation"], axis=-1)
    apart = (chord > _KINEMATICS_TOLERANCE_RAD) | (distance > _KINEMATICS_TOLERANCE_M)
    if not apart.any():
        return []
    part = category.parts[int(np.argwhere(apart)[0][-1])]
    return [
        f"pose of part {part!r} is not the one its joint and state give (worst "
        f"{np.degrees(chord.max()):.2g} deg, {distance.max():.2g} m){_first(apart)}: check the "
        "sign and unit of joint_state, and that axis and pivot are in the root's rest frame"
    ]


@partial(jax.jit, static_argnums=(1, 2))
def _part_poses(arrays, joint_types, parents):
    """[..., K, 4, 4] by forward kinematics from part 0 of ``arrays``."""
    root = se3.from_rt(arrays["rotation"][..., 0, :, :], arrays["translation"][..., 0, :])
    return forward_kinematics(
        root,
        arrays["joint_axis"],
        arrays["joint_pivot"],
        arrays["joint_state"],
        joint_types,
        parents,
    )


def _cloud_problems(frame: Frame, num_parts: int) -> list[str]:
    problems = []
    points = np.asarray(frame.points)
    if points.ndim != 2 or points.shape[-1] != 3 or len(points) == 0:
        problems.append(f"points has shape {points.shape}, expected (N, 3)")
    elif points.dtype != np.float32:
        problems.append(f"points is {points.dtype}, expected float32")
    elif not np.isfinite(points).all():
        problems.append(f"points has NaN or infinite entries{_first(~np.isfinite(points))}")
    elif np.abs(points).max() > _MAX_DISTANCE_M:
        problems.append(f"points reach beyond {_MAX_DISTANCE_M:g} m: are they in millimeters?")
    if frame.labels is not None:
        labels = np.asarray(frame.labels)
        if labels.shape != points.shape[:1]:
            problems.append(f"labels has shape {labels.shape}, expected {points.shape[:1]}")
        elif labels.dtype != np.int32:
            problems.append(f"labels is {labels.dtype}, expected int32")
        elif ((labels < -1) | (labels >= num_parts)).any():
            problems.append(
                f"labels go from {labels.min()} to {labels.max()}, expected -1 (unknown) to "
                f"{num_parts - 1}"
            )
    if frame.visible is not None:
        visible = np.asarray(frame.visible)
        if visible.shape != (num_parts,):
            problems.append(f"visible has shape {visible.shape}, expected ({num_parts},)")
        elif not np.issubdtype(visible.dtype, np.integer) or (visible < 0).any():
            problems.append("visible must be counts, integers from 0 up")
    if frame.visibility is not None:
        visibility = np.asarray(frame.visibility)
        if visibility.shape != (num_parts,):
            problems.append(f"visibility has shape {visibility.shape}, expected ({num_parts},)")
        elif not ((visibility >= 0) & (visibility <= 1)).all():
            problems.append("visibility must be fractions from 0 to 1")
    return problems


def _first(bad: np.ndarray) -> str:
    """Where the first true entry is, as " at [i, j]"; nothing for a scalar."""
    index = np.argwhere(bad)[0]
    return f" at {index.tolist()}" if index.size else ""
