"""One JSON schema for poses: ``estimate --json``, ``track``'s JSONL and the live stream.

A record is one object of one frame and complete in itself:

  name: the frame's: a file name, a frame of a video, or the sequence number of a stream.
  category: as on the command line.
  frames: field -> the coordinate frame its numbers are in (``FRAMES``). Camera: OpenCV, x right,
    y down, z forward. Rest frame: the object's own with all joints at rest, common to all parts
    there; its origin is the center of the object's bounding box at rest.
  units: {"length": "meters", "angle": "degrees"}; a joint's state has its own "unit".
  parts: a list, root first, each with
    name
    rotation [3, 3], translation [3]: p_camera = rotation p_rest + translation.
    size [3]: full extents of the part's box along the axes of its rest frame.
    box_center [3]: the box's center, in the part's rest frame.
    rotation_std_deg [], translation_std []: standard deviation about and along each axis; absent
      where the model is not calibrated, and in tracks.
    size_std [3]: standard deviations of the size; absent likewise.
    points: points of the cloud that the part has; hidden: too few, so that it is known through its
      joint alone. Both absent in tracks.
  joints: a list, each with
    name: of the part it carries; parent: of the part it is mounted on.
    type: "revolute" or "prismatic".
    axis [3], pivot [3]: in the root's rest frame; a prismatic joint has no pivot (null).
    axis_camera [3], pivot_camera [3]: the same line where it now is, in the camera frame.
    state: from the rest pose, positive about (along) the axis; unit: "degrees" or "meters".
    limits [2]: range of the category's states, in that unit.
    state_std: standard deviation of the state; absent as above.

  plausible: whether this can be an object of the category, whole, alone and in meters; reason: in
    one line why not, or null; size_ratio: size of the cloud over that usual in the category;
    distinct_points: how many different points the object has.

``estimate`` adds confidence (of the root's two directions, 0 to 1), plausibility (0 to 1, absent
where the model has no classifier), points (of the cloud: available, dropped) and hypotheses (absent
where the model was not fitted to state them): a list of readings, the answer first, each with its
probability, and parts and joints as above, without deviations. ``track`` adds
energy, keyframe, estimated, lost and milliseconds; the live stream also skipped, the frames left
out before this one.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.data.clouds import Cloud
    from caper_jax.estimator import Prediction
    from caper_jax.tracking.step import TrackResult

FRAMES = {
    "camera": "OpenCV: x right, y down, z forward",
    "rotation": "part's rest frame -> camera",
    "translation": "part's rest frame -> camera",
    "size": "part's rest frame",
    "box_center": "part's rest frame",
    "axis": "root's rest frame",
    "pivot": "root's rest frame",
    "axis_camera": "camera",
    "pivot_camera": "camera",
}
UNITS = {"length": "meters", "angle": "degrees"}


def json_line(record: dict[str, Any]) -> str:
    """A record as one line of JSON, without line break."""
    return json.dumps(record, allow_nan=False)


def pose_record(name: str | int, pose: ArticulatedPose, category: Category) -> dict[str, Any]:
    """What every record holds.

    Args:
      name: of the frame.
      pose: without batch axes.
      category: names the parts.

    Raises:
      CaperError: a pose that is not finite.
    """
    arrays = {key: np.asarray(value, np.float64) for key, value in vars(pose).items()}
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise CaperError(
            f"frame {name}: the model gave no finite pose; check the mask and the unit of depth"
        )
    parts = [
        {
            "name": part,
            "rotation": _rounded(arrays["rotation"][k]),
            "translation": _rounded(arrays["translation"][k]),
            "size": _rounded(arrays["size"][k]),
            "box_center": _rounded(arrays["box_center"][k]),
        }
        for k, part in enumerate(category.parts)
    ]
    return {
        "name": name,
        "category": category.name,
        "frames": FRAMES,
        "units": UNITS,
        "parts": parts,
        "joints": [_joint(j, arrays, category) for j in range(category.num_joints)],
    }


def _joint(j: int, arrays: dict[str, np.ndarray], category: Category) -> dict[str, Any]:
    joint = category.joints[j]
    turns = joint.type == "revolute"
    factor = _per_unit(category, j)
    # At rest all parts share one frame; since then the joint has moved along with its parent.
    rotation = arrays["rotation"][joint.parent]
    translation = arrays["translation"][joint.parent]
    axis, pivot = arrays["joint_axis"][j], arrays["joint_pivot"][j]
    return {
        "name": category.parts[j + 1],
        "parent": category.parts[joint.parent],
        "type": joint.type,
        "axis": _rounded(axis),
        "pivot": _rounded(pivot) if turns else None,
        "axis_camera": _rounded(rotation @ axis),
        "pivot_camera": _rounded(rotation @ pivot + translation) if turns else None,
        "state": round(float(arrays["joint_state"][j]) * factor, 6),
        "unit": "degrees" if turns else "meters",
        "limits": [round(limit * factor, 6) for limit in joint.limits],
    }


def estimate_record(
    name: str, prediction: Prediction, category: Category, cloud: Cloud
) -> dict[str, Any]:
    """The record of a single-frame estimate.

    Args:
      name: of the frame.
      prediction: without batch axes.
      category: names the parts.
      cloud: what the estimate was made from.

    Raises:
      CaperError: a pose that is not finite.
    """
    from caper_jax.models.uncertainty import HIDDEN_POINTS

    record = pose_record(name, prediction.pose, category)
    for k, part in enumerate(record["parts"]):
        part["points"] = int(prediction.points_per_part[k])
        part["hidden"] = bool(prediction.points_per_part[k] < HIDDEN_POINTS)
        if prediction.rotation_std is not None:
            part["rotation_std_deg"] = float(np.degrees(prediction.rotation_std[k]))
            part["translation_std"] = float(prediction.translation_std[k])
        if prediction.size_std is not None:
            part["size_std"] = _rounded(np.asarray(prediction.size_std[k], np.float64))
    if prediction.state_std is not None:
        for j, joint in enumerate(record["joints"]):
            joint["state_std"] = float(prediction.state_std[j]) * _per_unit(category, j)
    record |= _verdict(prediction, category)
    if prediction.plausibility is not None:
        record["plausibility"] = round(float(prediction.plausibility), 6)
    if prediction.hypotheses is not None:
        stated = prediction.hypotheses
        record["hypotheses"] = [
            {
                "probability": round(float(chance), 6),
                **_reading(name, jax.tree.map(lambda leaf, i=i: leaf[i], stated.pose), category),
            }
            for i, chance in enumerate(np.asarray(stated.probability))
        ]
    record["confidence"] = prediction.confidence.tolist()
    record["points"] = {"available": cloud.available, "dropped": cloud.dropped}
    return record


def _reading(name: str, pose: ArticulatedPose, category: Category) -> dict[str, Any]:
    whole = pose_record(name, pose, category)
    return {key: whole[key] for key in ("parts", "joints")}


def frame_record(
    name: str | int, result: TrackResult, category: Category, seconds: float
) -> dict[str, Any]:
    """The record of one frame of a track.

    Args:
      name: of the frame, or its number.
      result: without batch axes.
      category: names the parts.
      seconds: from points to pose.

    Raises:
      CaperError: a pose that is not finite.
    """
    return {
        **pose_record(name, result.pose, category),
        "energy": round(float(result.energy), 7),
        "keyframe": bool(result.keyframe),
        "estimated": bool(result.estimator_queried),
        "lost": bool(result.lost),
        **_verdict(result, category),
        "milliseconds": round(1000 * seconds, 3),
    }


def _verdict(result: Prediction | TrackResult, category: Category) -> dict[str, Any]:
    """Whether a result can be believed, and in one line why not."""
    from caper_jax.models.plausibility import implausible_because

    return {
        "plausible": bool(result.plausible),
        "reason": implausible_because(result, category) or None,
        "size_ratio": round(float(result.size_ratio), 4),
        "distinct_points": int(result.distinct_points),
    }


def _per_unit(category: Category, joint: int) -> float:
    """What makes a state of radians or meters one of files and tables."""
    return float(np.degrees(1.0)) if category.joint_types[joint] == "revolute" else 1.0


def _rounded(array: np.ndarray) -> list:
    """A tenth of a micrometer, or of a microradian: below what float32 holds."""
    return (array.round(7) + 0.0).tolist()  # + 0.0 mends -0.0
