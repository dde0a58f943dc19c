"""A pose as JSON: one schema for single estimates, recorded tracks and live streams."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from jaxtyping import Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError
from caper_jax.evaluation.report import STATE_UNITS
from caper_jax.tracking.step import TrackResult


def joint_lines(
    pose: ArticulatedPose, category: Category
) -> tuple[Float[np.ndarray, "joints 3"], Float[np.ndarray, "joints 3"]]:
    """The joints' axes in the camera's frame.

    Axes and pivots are given in the root's rest frame; at rest all parts share that frame, so the
    pose of the part that a joint is mounted on carries them to the camera, however deep the tree.

    Args:
      pose: arrays [K, ...] and [J, ...], without batch axes.
      category: gives the tree of parts.

    Returns:
      ([J, 3] unit directions, [J, 3] points on the axes, meters).
    """
    parents = list(category.parents)
    rotation = np.asarray(pose.rotation, float)[parents]
    axis = np.einsum("jab,jb->ja", rotation, np.asarray(pose.joint_axis, float))
    pivot = np.einsum("jab,jb->ja", rotation, np.asarray(pose.joint_pivot, float))
    return axis, pivot + np.asarray(pose.translation, float)[parents]


def pose_record(pose: ArticulatedPose, category: Category) -> dict[str, Any]:
    """A pose, JSON-ready, in meters and degrees; the name of every field says its frame.

    "camera" is the camera's frame (OpenCV: x right, y down, z forward), "rest" the rest frame that
    all parts share. "parts" holds by name: rotation [3, 3] and translation [3] (rest -> camera),
    size [3] and box_center_rest [3]. "joints" holds by the name of the part that they carry: type,
    state with its unit, axis_rest, pivot_rest, axis_camera and pivot_camera [3]; the pivots of a
    prismatic joint are null.

    Args:
      pose: arrays [K, ...] and [J, ...], without batch axes.
      category: names the parts.

    Raises:
      CaperError: a pose that is not finite.
    """
    arrays = {key: np.asarray(value, np.float64) for key, value in vars(pose).items()}
    if not all(np.isfinite(value).all() for value in arrays.values()):
        raise CaperError("the model gave no finite pose; check the masks and the unit of depth")
    arrays["axis_camera"], arrays["pivot_camera"] = joint_lines(pose, category)
    # A tenth of a micrometer, or of a microradian: below what float32 holds. + 0.0 mends -0.0.
    rounded = {key: (value.round(7) + 0.0).tolist() for key, value in arrays.items()}
    parts = {
        name: {
            "rotation": rounded["rotation"][part],
            "translation": rounded["translation"][part],
            "size": rounded["size"][part],
            "box_center_rest": rounded["box_center"][part],
        }
        for part, name in enumerate(category.parts)
    }
    joints = {}
    for joint, kind in enumerate(category.joint_types):
        revolute = kind == "revolute"
        state = float(arrays["joint_state"][joint])
        joints[category.parts[joint + 1]] = {
            "type": kind,
            "state": round(float(np.degrees(state)) if revolute else state, 6),
            "unit": STATE_UNITS[kind],
            "axis_rest": rounded["joint_axis"][joint],
            "pivot_rest": rounded["joint_pivot"][joint] if revolute else None,
            "axis_camera": rounded["axis_camera"][joint],
            "pivot_camera": rounded["pivot_camera"][joint] if revolute else None,
        }
    return {"parts": parts, "joints": joints}


def frame_record(
    frame: str | int, result: TrackResult, category: Category, seconds: float
) -> dict[str, Any]:
    """One tracked frame, JSON-ready: ``pose_record`` and what the tracker did.

    Args:
      frame: name or number.
      result: of one frame, without batch axes.
      category: names the parts.
      seconds: from points to pose.

    Raises:
      CaperError: a pose that is not finite.
    """
    try:
        pose = pose_record(result.pose, category)
    except CaperError as error:
        raise CaperError(f"frame {frame}: {error}") from error
    return {
        "frame": frame,
        **pose,
        "energy": round(float(result.energy), 7),
        "keyframe": bool(result.keyframe),
        "estimated": bool(result.estimated),
        "lost": bool(result.lost),
        "milliseconds": round(1000 * seconds, 3),
    }


def json_line(record: dict[str, Any]) -> str:
    """A record as one line of JSON, without line break."""
    return json.dumps(record, allow_nan=False)
