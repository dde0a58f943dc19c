"""One frame of data, a batch of them, what a dataset offers, and the checks of their arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import flax.struct
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32

from caper_jax.arrays import array_problem, first_entry
from caper_jax.articulation.kinematics import forward_kinematics_float64
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category

# Ground truth is exact up to the float32 it is stored in, or up to an annotator's hand; looser
# parts cannot be joined by the joint that the frame names.
_KINEMATICS_TOLERANCE_RAD = 5e-3
_KINEMATICS_TOLERANCE_M = 1e-3
_ROTATION_TOLERANCE = 1e-3
_MAX_DISTANCE_M = 50.0

# numpy or JAX arrays: the same container serves files, the generator and the networks.
Array = Any


class NoFramesError(CaperError):
    """A split that holds no frame of a category, in data that are otherwise well."""


@dataclass(frozen=True)
class Frame:
    """One object in one depth frame, in the camera's frame (OpenCV), meters.

    Attributes:
      name: unique within its dataset.
      points: [N, 3] meters, visible surface of the object; N is 0 where too little is visible.
      labels: [N] part of every point, -1 where unknown; None when the data has none.
      truth: pose with arrays [K, ...]; None when the data has none.
      visible: [K] points or pixels that show each part; None when unknown.
      visibility: [K] fraction of each part that neither other parts nor other objects hide, of
        what the camera would see of it alone; None when unknown.
      depth: [H, W] meters, for pictures; None when the data has no image.
      mask: [H, W], the object in ``depth``.
      intrinsics: [3, 3] pixels, of ``depth``.
      instance: which object is shown, by its name in the dataset (urdf_id, PartNet id, number of
        a generated shape); None when unknown.
      gravity: [3] unit vector, the way things fall; None when unknown.
    """

    name: str
    points: Float32[np.ndarray, "N 3"]
    labels: Int32[np.ndarray, " N"] | None = None
    truth: ArticulatedPose | None = None
    visible: Int[np.ndarray, " K"] | None = None
    visibility: Float[np.ndarray, " K"] | None = None
    depth: Float32[np.ndarray, "H W"] | None = None
    mask: Bool[np.ndarray, "H W"] | None = None
    intrinsics: Float64[np.ndarray, "3 3"] | None = None
    instance: str | None = None
    gravity: Float[np.ndarray, " 3"] | None = None


@flax.struct.dataclass
class Batch:
    """Labeled frames, generated or read from a dataset; leading axes are batch axes.

    Attributes:
      points: [B, N, 3] meters, camera frame, in scan order.
      labels: [B, N] int32 part of each point, -1 unknown or residue.
      pose: ArticulatedPose with leading axis B.
      visible: [B, K] int32 pixels of each part in the mask, before sampling; None in training
        data of a dataset.
      instance: [B] int32 index of the object; None where unknown.
      visibility: [B, K] ``visible`` over the pixels that the part would have if nothing, neither
        another part nor something else, were in front of it; None unless measured.
    """

    points: Float[Array, "*batch N 3"]
    labels: Int[Array, "*batch N"]
    pose: ArticulatedPose
    visible: Int[Array, "*batch K"] | None = None
    instance: Int[Array, "*batch"] | None = None
    visibility: Float[Array, "*batch K"] | None = None


class Dataset(Protocol):
    """A category's frames, read on demand; several threads may read at once.

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

    def videos(self) -> dict[str, list[int]]:
        """Name of every video -> indices of its frames in the order of time; {} without videos."""
        ...


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
    lead = arrays["rotation"].shape[: max(arrays["rotation"].ndim - 3, 0)]
    checks = [
        array_problem(key, arrays[key], lead + shape)
        for key, shape in pose_shapes(category.num_parts).items()
    ]
    problems = [problem for problem in checks if problem is not None]
    if problems:
        return problems
    double = {key: array.astype(np.float64) for key, array in arrays.items()}

    rotation = double["rotation"]
    drift = np.abs(rotation.swapaxes(-1, -2) @ rotation - np.eye(3)).max((-1, -2))
    mirrored = np.linalg.det(rotation) < 0
    if (drift > _ROTATION_TOLERANCE).any():
        problems.append(
            f"rotation is not orthonormal (off by {drift.max():.2g})"
            f"{first_entry(drift > _ROTATION_TOLERANCE)}: divide a scaled matrix by its scale"
        )
    elif mirrored.any():
        problems.append(f"rotation is a reflection (determinant -1){first_entry(mirrored)}")
    if (double["size"] <= 0).any():
        problems.append(f"size must be positive{first_entry(double['size'] <= 0)}")
    for key in ("translation", "size", "box_center", "joint_pivot"):
        problems += _far_problems(key, double[key])
    slant = np.abs(np.linalg.norm(double["joint_axis"], axis=-1) - 1)
    slanted = slant > _ROTATION_TOLERANCE
    if slanted.any():
        problems.append(f"joint_axis is not a unit vector{first_entry(slanted)}")
    if not problems:
        problems += _kinematics_problems(double, category)
    return problems


def _far_problems(key: str, lengths: np.ndarray) -> list[str]:
    if np.abs(lengths).max(initial=0.0) > _MAX_DISTANCE_M:
        return [f"{key} reach beyond {_MAX_DISTANCE_M:g} m: are they in millimeters?"]
    return []


def _kinematics_problems(arrays: dict[str, np.ndarray], category: Category) -> list[str]:
    """Parts whose pose differs from the one that the root, the joints and the states give."""
    root = np.zeros((*arrays["rotation"].shape[:-3], 4, 4))
    root[..., :3, :3], root[..., 3, 3] = arrays["rotation"][..., 0, :, :], 1.0
    root[..., :3, 3] = arrays["translation"][..., 0, :]
    axis, pivot, state = (arrays[f"joint_{field}"] for field in ("axis", "pivot", "state"))
    axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    expected = forward_kinematics_float64(
        root, axis, pivot, state, category.joint_types, category.parents
    )
    # The chord |R - R'| / sqrt 2 equals the angle between the rotations to first order.
    chord = np.linalg.norm(expected[..., :3, :3] - arrays["rotation"], axis=(-1, -2)) / np.sqrt(2)
    distance = np.linalg.norm(expected[..., :3, 3] - arrays["translation"], axis=-1)
    apart = (chord > _KINEMATICS_TOLERANCE_RAD) | (distance > _KINEMATICS_TOLERANCE_M)
    if not apart.any():
        return []
    part = category.parts[int(np.argwhere(apart)[0][-1])]
    return [
        f"pose of part {part!r} is not the one its joint and state give (worst "
        f"{np.degrees(chord.max()):.2g} deg, {distance.max():.2g} m){first_entry(apart)}: check "
        "the sign and unit of joint_state, and that axis and pivot are in the root's rest frame"
    ]


def _cloud_problems(frame: Frame, num_parts: int) -> list[str]:
    points = array_problem("points", frame.points, (None, 3), np.float32)
    problems = [points] if points else _far_problems("points", frame.points)
    length = np.shape(frame.points)[:1]
    expected: dict[str, tuple[Any, ...]] = {  # shape, dtype and range of what may be left out
        "labels": (length, np.int32, -1, num_parts - 1),
        "visible": ((num_parts,), np.integer, 0),
        "visibility": ((num_parts,), np.floating, 0, 1),
    }
    for name, arguments in expected.items():
        value = getattr(frame, name)
        problem = None if value is None else array_problem(name, value, *arguments)
        problems += [problem] if problem else []
    return problems
