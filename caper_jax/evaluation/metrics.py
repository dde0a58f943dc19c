"""Errors of estimated poses, frame by frame, as the conventions define them.

The formulas stand once, in ``unchecked_pose_errors``, a pure function in the precision of its
inputs. ``pose_errors`` checks what it is given and computes in float64. Rotations go by the atan2
form, so that the ground truth scored against itself scores 0 degrees, 0 meters and an IoU of 1.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import Array, ArticulatedPose
from caper_jax.articulation.symmetry import apply_symmetry, is_ambiguous
from caper_jax.data.types import pose_shapes
from caper_jax.errors import CaperError
from caper_jax.geometry import boxes
from caper_jax.lie import linalg, so3

FAILED_ROTATION_DEG = 180.0
# What a frame without an estimate scores, as the report says it.
FAILURE_VALUES = {
    "rotation_deg": FAILED_ROTATION_DEG,
    "translation_m": "distance of the true part origin from the camera",
    "translation_relative": "the same, over the diagonal of the object",
    "iou_full": 0.0,
    "iou_size": 0.0,
    "axis_deg": FAILED_ROTATION_DEG,
    "pivot_m": "distance of the true joint axis from the camera",
    "state": "width of the category's range of states",
}


@flax.struct.dataclass
class PoseErrors:
    """Errors of frames; ``*frames`` are any leading axes, numpy's or JAX's arrays.

    Attributes:
      rotation_deg: geodesic angle, never folded.
      translation_m: distance of the part origins.
      translation_relative: the same over the true ``object_diagonal``.
      iou_full: IoU of the oriented boxes in the camera frame.
      iou_size: IoU of the boxes' sizes alone, as if they shared center and rotation.
      axis_deg: angle of the joint axes in the root's frame; the sign counts.
      pivot_m: distance of the estimated pivot from the true axis; NaN for prismatic joints.
      state: degrees (revolute) or meters (prismatic).
    """

    rotation_deg: Float[Array, "*frames K"]
    translation_m: Float[Array, "*frames K"]
    translation_relative: Float[Array, "*frames K"]
    iou_full: Float[Array, "*frames K"]
    iou_size: Float[Array, "*frames K"]
    axis_deg: Float[Array, "*frames J"]
    pivot_m: Float[Array, "*frames J"]
    state: Float[Array, "*frames J"]


PART_METRICS = ("rotation_deg", "translation_m", "translation_relative", "iou_full", "iou_size")
JOINT_METRICS = ("axis_deg", "pivot_m", "state")


def pose_errors(
    estimate: ArticulatedPose,
    truth: ArticulatedPose,
    category: Category,
    failed: Bool[np.ndarray, " frames"] | None = None,
) -> PoseErrors:
    """Errors of estimates against the truth, without regard to symmetries.

    Args:
      estimate: arrays [F, K, ...]; whatever it holds for failed frames is not looked at.
      truth: arrays [F, K, ...].
      category: joint types and state limits.
      failed: [F] bool, frames without an estimate; they score ``FAILURE_VALUES``.

    Raises:
      CaperError: estimates of other shapes than the truth, or not finite although not failed.
    """
    return _in_float64(_errors_jitted, estimate, truth, category, failed)


def pose_errors_up_to_symmetry(
    estimate: ArticulatedPose,
    truth: ArticulatedPose,
    category: Category,
    failed: Bool[np.ndarray, " frames"] | None = None,
) -> PoseErrors:
    """Errors against the better of the truths that the category declares equivalent.

    Better is, frame by frame, the truth whose root's rotation is nearer to the estimate's; all
    errors of the frame are those against that truth. An instance whose exchanged parts are not
    alike (``Symmetry.tolerance``) has one truth only.

    Args and errors as for ``pose_errors``.
    """
    return _in_float64(_errors_up_to_symmetry_jitted, estimate, truth, category, failed)


def object_diagonal(pose: ArticulatedPose) -> Float[np.ndarray, " frames"]:
    """[F] meters, diagonal of the box around all parts at rest."""
    size, center = (np.asarray(values, np.float64) for values in (pose.size, pose.box_center))
    return boxes.rest_diagonal(size, center)


def unchecked_pose_errors(
    estimate: ArticulatedPose,
    truth: ArticulatedPose,
    category: Category,
    failed: Bool[Array, "*frames"] | None = None,
) -> PoseErrors:
    """``pose_errors`` as a pure function: jit, vmap and shard it at will.

    Args:
      estimate: arrays [..., K, ...]; failed ones may hold anything, NaN too.
      truth: arrays [..., K, ...]; its precision is that of the errors.
      category: static.
      failed: [...] bool.
    """
    revolute = np.array([kind == "revolute" for kind in category.joint_types], bool)
    rotation = so3.geodesic_distance(estimate.rotation, truth.rotation)
    full = boxes.iou_full(
        estimate.rotation,
        _box_center(estimate),
        estimate.size,
        truth.rotation,
        _box_center(truth),
        truth.size,
    )
    sine = linalg.norm(jnp.cross(estimate.joint_axis, truth.joint_axis))
    cosine = jnp.sum(estimate.joint_axis * truth.joint_axis, -1)
    offset = estimate.joint_pivot - truth.joint_pivot
    state = jnp.abs(estimate.joint_state - truth.joint_state)
    distance = linalg.norm(estimate.translation - truth.translation)
    errors = {
        "rotation_deg": jnp.degrees(rotation),
        "translation_m": distance,
        "iou_full": full,
        "iou_size": boxes.iou_size(estimate.size, truth.size),
        "axis_deg": jnp.degrees(jnp.arctan2(sine, cosine)),
        "pivot_m": linalg.norm(jnp.cross(offset, truth.joint_axis)),
        "state": jnp.where(revolute, jnp.degrees(state), state),
    }
    if failed is not None:
        widths = np.array([joint.limits[1] - joint.limits[0] for joint in category.joints])
        worst: dict[str, Any] = {
            "rotation_deg": FAILED_ROTATION_DEG,
            "translation_m": linalg.norm(truth.translation),
            "iou_full": 0.0,
            "iou_size": 0.0,
            "axis_deg": FAILED_ROTATION_DEG,
            "pivot_m": _axis_distance(truth),
            "state": np.where(revolute, np.degrees(widths), widths).astype(state.dtype),
        }
        errors = {
            key: jnp.where(failed[..., None], worst[key], value) for key, value in errors.items()
        }
    errors["pivot_m"] = jnp.where(revolute, errors["pivot_m"], jnp.nan)
    diagonal = boxes.rest_diagonal(truth.size, truth.box_center)
    return PoseErrors(translation_relative=errors["translation_m"] / diagonal[..., None], **errors)


def unchecked_errors_up_to_symmetry(
    estimate: ArticulatedPose,
    truth: ArticulatedPose,
    category: Category,
    failed: Bool[Array, "*frames"] | None = None,
) -> PoseErrors:
    """``pose_errors_up_to_symmetry`` as a pure function, as ``unchecked_pose_errors``."""
    if not category.symmetries:
        return unchecked_pose_errors(estimate, truth, category, failed)
    nearest = truth
    least = so3.geodesic_distance(estimate.rotation[..., 0, :, :], truth.rotation[..., 0, :, :])
    for symmetry in category.symmetries:
        other = apply_symmetry(truth, symmetry, category)
        angle = so3.geodesic_distance(estimate.rotation[..., 0, :, :], other.rotation[..., 0, :, :])
        nearer = is_ambiguous(truth.size, symmetry) & (angle < least)
        least = jnp.where(nearer, angle, least)
        nearest = jax.tree.map(partial(_choose, nearer), other, nearest)
    if failed is not None:  # they count against the truth itself
        nearest = jax.tree.map(partial(_choose, failed), truth, nearest)
    return unchecked_pose_errors(estimate, nearest, category, failed)


_errors_jitted = jax.jit(unchecked_pose_errors, static_argnames="category")
_errors_up_to_symmetry_jitted = jax.jit(unchecked_errors_up_to_symmetry, static_argnames="category")


def _choose(chosen: jax.Array, one: Any, other: Any) -> jax.Array:
    """``one`` in the chosen frames [...], ``other`` in the rest."""
    return jnp.where(chosen.reshape(chosen.shape + (1,) * (one.ndim - chosen.ndim)), one, other)


def _box_center(pose: ArticulatedPose) -> jax.Array:
    """[..., K, 3] centers of the parts' boxes in the camera frame."""
    return linalg.apply(pose.rotation, pose.box_center) + pose.translation


def _axis_distance(pose: ArticulatedPose) -> jax.Array:
    """[..., J] meters from the camera to the joint axes, which rest in the root's frame."""
    root = pose.rotation[..., :1, :, :]
    pivot = linalg.apply(root, pose.joint_pivot) + pose.translation[..., :1, :]
    return linalg.norm(jnp.cross(pivot, linalg.apply(root, pose.joint_axis)))


def _in_float64(
    function: Any,
    estimate: ArticulatedPose,
    truth: ArticulatedPose,
    category: Category,
    failed: np.ndarray | None,
) -> PoseErrors:
    """What a jitted form of the unchecked errors gives in float64, as numpy arrays.

    Raises:
      CaperError: see ``pose_errors``.
    """
    none = np.zeros(len(truth.rotation), bool)
    failed = none if failed is None else np.asarray(failed, bool)
    true = _as_double(truth, "truth", category, none)
    guess = _as_double(estimate, "estimate", category, failed)
    with jax.enable_x64(True):
        return jax.device_get(function(guess, true, category=category, failed=failed))


def _as_double(
    pose: ArticulatedPose, name: str, category: Category, failed: np.ndarray
) -> ArticulatedPose:
    """Arrays [F, ...] in float64; failed frames get a harmless pose, which is not used."""
    arrays = {}
    for key, shape in pose_shapes(category.num_parts).items():
        array = np.array(getattr(pose, key), np.float64)
        if array.shape != (len(failed), *shape):
            raise CaperError(
                f"{name} {key} has shape {array.shape}, expected {(len(failed), *shape)}"
            )
        array[failed] = np.eye(3) if key == "rotation" else 1.0
        if not np.isfinite(array).all():
            raise CaperError(f"{name} {key} has NaN or infinite entries")
        arrays[key] = array
    return ArticulatedPose(**arrays)
