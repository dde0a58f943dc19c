"""Estimates and their errors as plain text, at most 80 columns wide."""

from __future__ import annotations

import jax
import numpy as np

from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.evaluation.metrics import PoseErrors, pose_errors, pose_errors_up_to_symmetry
from caper_jax.evaluation.report import text_table
from caper_jax.lie import so3
from caper_jax.visualization.scene import Scene, format_state, joint_name


def scene_errors(scene: Scene) -> dict[str, PoseErrors]:
    """Errors of the estimate by label: "error" and, where it differs, "up to symmetry".

    Returns:
      Errors of one frame (F = 1); empty without ground truth.
    """
    if scene.truth is None:
        return {}
    estimate, truth = (_batched(pose) for _, pose in scene.poses)
    errors = {"error": pose_errors(estimate, truth, scene.category)}
    best = pose_errors_up_to_symmetry(estimate, truth, scene.category)
    if not np.array_equal(best.rotation_deg, errors["error"].rotation_deg):
        errors["up to symmetry"] = best
    return errors


def format_scene(scene: Scene) -> str:
    """The estimate as a table of parts and one of joints, each with its errors below it.

    Positions, rotation vectors and sizes are those of the parts in the camera's frame; axes and
    pivots are in the root's rest frame.
    """
    pose, category, errors = scene.pose, scene.category, scene_errors(scene)
    with jax.enable_x64(True):
        vectors = np.degrees(np.asarray(so3.log(np.asarray(pose.rotation, np.float64))))
    rows = []
    for part, name in enumerate(category.parts):
        size = 100 * np.asarray(pose.size)[part]
        position = np.asarray(pose.translation)[part]
        rows.append([name, _triple(position, 3), _triple(vectors[part], 1), _triple(size, 1)])
        rows += [[f"  {label}", *part_errors(error, part)] for label, error in errors.items()]
    lines = text_table(["part", "position [m]", "rotation vector [deg]", "size [cm]"], rows)
    rows = []
    for index, joint in enumerate(category.joints):
        pivot = _triple(np.asarray(pose.joint_pivot)[index], 3) if joint.type == "revolute" else "-"
        state = format_state(float(pose.joint_state[index]), joint.type)
        axis = _triple(np.asarray(pose.joint_axis)[index], 3)
        rows.append([joint_name(category, index), axis, pivot, state])
        for label, error in errors.items():
            rows.append([f"  {label}", *joint_errors(error, index, joint.type)])
    lines += ["", *text_table(["joint", "axis (rest)", "pivot (rest) [m]", "state"], rows)]
    return "\n".join([*lines, "", "parts: camera frame; joints: rest frame of the root"])


def part_errors(errors: PoseErrors, part: int) -> tuple[str, str, str]:
    """Error of position and rotation, and the IoU of the boxes, of the first frame."""
    return (
        f"{1000 * errors.translation_m[0, part]:.1f} mm",
        f"{errors.rotation_deg[0, part]:.2f}°",
        f"IoU {errors.iou_full[0, part]:.2f}",
    )


def joint_errors(errors: PoseErrors, joint: int, joint_type: str) -> tuple[str, str, str]:
    """Error of axis, pivot ("-" where there is none) and state, of the first frame."""
    axis = f"{errors.axis_deg[0, joint]:.2f}°"
    if joint_type == "revolute":
        pivot = f"{1000 * errors.pivot_m[0, joint]:.1f} mm"
        return axis, pivot, f"{errors.state[0, joint]:.2f}°"
    return axis, "-", f"{100 * errors.state[0, joint]:.2f} cm"


def _batched(pose: ArticulatedPose) -> ArticulatedPose:
    return jax.tree.map(lambda array: np.asarray(array)[None], pose)


def _triple(values: np.ndarray, digits: int) -> str:
    # Adding 0 turns -0.0 into 0.0.
    return " ".join(f"{value:.{digits}f}" for value in np.round(values, digits) + 0.0)
