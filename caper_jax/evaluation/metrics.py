"""Errors of estimated poses, frame by frame, as the conventions define them.

Everything is computed in float64; rotations by the atan2 form, so that the ground truth scored
against itself scores 0 degrees, 0 meters and an IoU of 1.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
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


@dataclass(frozen=True)
class PoseErrors:
    """Errors of F frames.

    Attributes:
      rotation_deg: [F, K] geodesic angle, never folded.
      translation_m: [F, K] distance of the part origins.
      translation_relative: [F, K] the same over the true ``object_diagonal``.
      iou_full: [F, K] IoU of the oriented boxes in the camera frame.
      iou_size: [F, K] IoU of the boxes' sizes alone, as if they shared center and rotation.
      axis_deg: [F, J] angle of the joint axes in the root's frame; the sign counts.
      pivot_m: [F, J] distance of the estimated pivot from the true axis; NaN for prismatic joints.
      state: [F, J] degrees (revolute) or meters (prismatic).
    """

    rotation_deg: Float[np.ndarray, "frames parts"]
    translation_m: Float[np.ndarray, "frames parts"]
    translation_relative: Float[np.ndarray, "frames parts"]
    iou_full: Float[np.ndarray, "frames parts"]
    iou_size: Float[np.ndarray, "frames parts"]
    axis_deg: Float[np.ndarray, "frames joints"]
    pivot_m: Float[np.ndarray, "frames joints"]
    state: Float[np.ndarray, "frames joints"]


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
    none = np.zeros(len(truth.rotation), bool)
    failed = none if failed is None else np.asarray(failed, bool)
    true = _as_double(truth, "truth", category, none)
    guess = _as_double(estimate, "estimate", category, failed)

    with jax.enable_x64(True):
        errors = {key: np.array(value) for key, value in _errors(guess, true).items()}
    revolute = np.array([kind == "revolute" for kind in category.joint_types], bool)
    errors["pivot_m"][:, ~revolute] = np.nan
    errors["state"][:, revolute] = np.degrees(errors["state"][:, revolute])

    for key in ("rotation_deg", "axis_deg"):
        errors[key][failed] = FAILED_ROTATION_DEG
    for key in ("iou_full", "iou_size"):
        errors[key][failed] = 0.0
    errors["translation_m"][failed] = np.linalg.norm(true["translation"], axis=-1)[failed]
    errors["pivot_m"][failed] = np.where(revolute, _axis_distance(true), np.nan)[failed]
    widths = np.array([joint.limits[1] - joint.limits[0] for joint in category.joints])
    errors["state"][failed] = np.where(revolute, np.degrees(widths), widths)
    errors["translation_relative"] = errors["translation_m"] / object_diagonal(truth)[:, None]
    return PoseErrors(**errors)


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
    truths = [truth, *(apply_symmetry(truth, s, category) for s in category.symmetries)]
    errors = [pose_errors(estimate, one, category, failed) for one in truths]
    angles = [error.rotation_deg[:, 0] for error in errors]
    for number, symmetry in enumerate(category.symmetries, start=1):
        alike = np.asarray(is_ambiguous(np.asarray(truth.size), symmetry))
        angles[number] = np.where(alike, angles[number], np.inf)
    best = np.argmin(angles, axis=0)
    frames = np.arange(len(best))
    return PoseErrors(
        **{
            field.name: np.stack([getattr(error, field.name) for error in errors])[best, frames]
            for field in fields(PoseErrors)
        }
    )


def object_diagonal(pose: ArticulatedPose) -> Float[np.ndarray, " frames"]:
    """[F] meters, diagonal of the box around all parts at rest."""
    size, center = (np.asarray(values, np.float64) for values in (pose.size, pose.box_center))
    return boxes.rest_diagonal(size, center)


@jax.jit
def _errors(guess: dict[str, jax.Array], true: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """All metrics but the failures; states and angles in radians where the joint is revolute."""
    rotation = so3.geodesic_distance(guess["rotation"], true["rotation"])
    full = boxes.iou_full(
        guess["rotation"],
        _box_center(guess),
        guess["size"],
        true["rotation"],
        _box_center(true),
        true["size"],
    )
    sine = linalg.norm(jnp.cross(guess["joint_axis"], true["joint_axis"]))
    cosine = jnp.sum(guess["joint_axis"] * true["joint_axis"], -1)
    offset = guess["joint_pivot"] - true["joint_pivot"]
    return {
        "rotation_deg": jnp.degrees(rotation),
        "translation_m": linalg.norm(guess["translation"] - true["translation"]),
        "iou_full": full,
        "iou_size": boxes.iou_size(guess["size"], true["size"]),
        "axis_deg": jnp.degrees(jnp.arctan2(sine, cosine)),
        "pivot_m": linalg.norm(jnp.cross(offset, true["joint_axis"])),
        "state": jnp.abs(guess["joint_state"] - true["joint_state"]),
    }


def _box_center(arrays: dict[str, jax.Array]) -> jax.Array:
    """[..., K, 3] centers of the parts' boxes in the camera frame."""
    return linalg.apply(arrays["rotation"], arrays["box_center"]) + arrays["translation"]


def _axis_distance(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """[F, J] meters from the camera to the joint axes, which rest in the root's frame."""
    root = arrays["rotation"][:, None, 0]
    axis = np.einsum("fjab,fjb->fja", root, arrays["joint_axis"])
    pivot = np.einsum("fjab,fjb->fja", root, arrays["joint_pivot"])
    pivot += arrays["translation"][:, None, 0]
    return np.linalg.norm(np.cross(pivot, axis), axis=-1)


def _as_double(
    pose: ArticulatedPose, name: str, category: Category, failed: np.ndarray
) -> dict[str, np.ndarray]:
    """Fields [F, ...] in float64; failed frames get a harmless pose, which is not used."""
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
    return arrays
