"""A pose of a short robot arm, by the package's kinematics in float64."""

from __future__ import annotations

import jax
import numpy as np

from caper_jax.articulation.category import Category, Joint
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose

ARM = Category(
    name="arm",
    parts=("base", "link", "slider"),
    joints=(Joint("revolute", 0, (-2.0, 2.0)), Joint("prismatic", 1, (0.0, 0.2))),
    directions=("x", "y"),
    directions_reason="test",
    unit=1.0,
    mean_size=((0.1, 0.1, 0.1),) * 3,
    mean_center=((0.0, 0.0, 0.0),) * 3,
)


ROOT = np.array(
    [[0.6, 0.0, 0.8, 0.05], [0.64, -0.6, -0.48, -0.02], [0.48, 0.8, -0.36, 0.9], [0, 0, 0, 1.0]]
)
AXIS = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])


PIVOT = np.array([[0.02, 0.05, -0.03], [0.0, 0.0, 0.0]])


STATE = np.array([0.7, 0.08])


def part_poses(state: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        kinematics = forward_kinematics(ROOT, AXIS, PIVOT, state, ARM.joint_types, ARM.parents)
        return np.asarray(kinematics)


def arm_pose(state: np.ndarray = STATE) -> ArticulatedPose:
    parts = part_poses(state)
    size = np.array([[0.2, 0.06, 0.12], [0.1, 0.12, 0.05], [0.15, 0.04, 0.03]])
    center = np.array([[0.0, 0.0, 0.0], [0.02, 0.1, 0.01], [0.1, 0.12, 0.0]])
    return ArticulatedPose(
        parts[:, :3, :3], parts[:, :3, 3], size, center, AXIS.copy(), PIVOT.copy(), state.copy()
    )
