"""The JSON schema of poses: units, frames, and what is not finite."""

from __future__ import annotations

import json

import numpy as np
import pytest
from _helpers.arm import ARM, arm_pose
from scipy.spatial.transform import Rotation

from caper_jax.errors import CaperError
from caper_jax.evaluation.records import FRAMES, frame_record, json_line
from caper_jax.models import plausibility
from caper_jax.tracking.step import TrackResult


def record_of(pose, reason=0):
    verdict = (reason == 0, np.int32(reason), np.float32(1.5), np.int32(640))
    result = TrackResult(pose, None, np.float32(0.02), True, False, False, *verdict)
    return frame_record("f", result, ARM, 0.0125)


def test_units_and_parts():
    record = record_of(arm_pose())
    assert record["name"] == "f" and record["category"] == ARM.name
    assert [part["name"] for part in record["parts"]] == ["base", "link", "slider"]
    link, slider = record["joints"]
    assert (link["name"], link["type"], link["unit"]) == ("link", "revolute", "degrees")
    assert link["state"] == pytest.approx(40.107046) and link["pivot"] == [0.02, 0.05, -0.03]
    np.testing.assert_allclose(link["limits"], np.degrees(ARM.joints[0].limits), atol=1e-5)
    assert (slider["name"], slider["type"], slider["unit"]) == ("slider", "prismatic", "meters")
    assert slider["state"] == pytest.approx(0.08) and slider["axis"] == [1.0, 0.0, 0.0]
    assert slider["pivot"] is None and slider["pivot_camera"] is None
    assert record["milliseconds"] == 12.5 and record["energy"] == 0.02
    assert (record["keyframe"], record["estimated"], record["lost"]) == (True, False, False)
    assert json.loads(json_line(record)) == record


def test_what_is_not_plausible_says_why():
    record = record_of(arm_pose())
    assert (record["plausible"], record["reason"]) == (True, None)
    assert (record["size_ratio"], record["distinct_points"]) == (1.5, 640)
    doubted = record_of(arm_pose(), plausibility.SEVERAL)
    assert doubted["plausible"] is False and "more than one object" in doubted["reason"]
    assert json.loads(json_line(doubted)) == doubted


def test_every_spatial_field_names_its_frame():
    record = record_of(arm_pose())
    vectors = {
        key
        for item in (*record["parts"], *record["joints"])
        for key, value in item.items()
        if isinstance(value, list) and key != "limits"
    }
    assert vectors == set(FRAMES) - {"camera"} and record["frames"] == FRAMES


def test_lines_of_joints_in_the_camera():
    """The child turns about the line where it now is, and its pivot stays on both parts."""
    record = record_of(arm_pose())
    parts = {part["name"]: part for part in record["parts"]}
    for joint in record["joints"]:
        parent, child = parts[joint["parent"]], parts[joint["name"]]
        before, after = np.array(parent["rotation"]), np.array(child["rotation"])
        axis = np.array(joint["axis_camera"])
        if joint["type"] == "prismatic":
            moved = np.array(child["translation"]) - parent["translation"]
            np.testing.assert_allclose(moved, joint["state"] * axis, atol=1e-5)
            continue
        turn = Rotation.from_matrix(after @ before.T).as_rotvec(degrees=True)
        np.testing.assert_allclose(turn, joint["state"] * axis, atol=1e-3)
        for part, rotation in ((parent, before), (child, after)):
            point = rotation @ joint["pivot"] + part["translation"]
            np.testing.assert_allclose(point, joint["pivot_camera"], atol=1e-5)


def test_a_pose_that_is_not_finite_is_an_error():
    with pytest.raises(CaperError, match="frame f: the model gave no finite pose"):
        record_of(arm_pose(np.array([np.nan, 0.0])))
