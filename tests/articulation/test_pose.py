"""Joints in the camera frame: where the moved parts leave them."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caper_jax.articulation.kinematics import forward_kinematics_float64
from caper_jax.articulation.pose import ArticulatedPose, joints_in_camera

TYPES, PARENTS = ("revolute", "prismatic", "revolute"), (0, 1, 1)


@pytest.mark.parametrize("batch", [(), (2, 5)])
def test_axes_are_those_of_the_parents(batch):
    g = np.random.default_rng(0)
    root = np.broadcast_to(np.eye(4), (*batch, 4, 4)).copy()
    count = int(np.prod(batch))
    root[..., :3, :3] = Rotation.random(count, rng=g).as_matrix().reshape(*batch, 3, 3)
    root[..., :3, 3] = g.normal(size=(*batch, 3))
    axis, pivot = g.normal(size=(2, *batch, 3, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    state = g.uniform(-2, 2, (*batch, 3))
    parts = forward_kinematics_float64(root, axis, pivot, state, TYPES, PARENTS)
    nothing = np.zeros((*batch, 4, 3))
    pose = ArticulatedPose(
        rotation=parts[..., :3, :3],
        translation=parts[..., :3, 3],
        size=nothing,
        box_center=nothing,
        joint_axis=axis,
        joint_pivot=pivot,
        joint_state=state,
    )
    found_axis, found_pivot = joints_in_camera(pose)
    parents = parts[..., list(PARENTS), :, :]
    expected = np.einsum("...jab,...jb->...ja", parents[..., :3, :3], axis)
    np.testing.assert_allclose(found_axis, expected, atol=1e-6)
    expected = np.einsum("...jab,...jb->...ja", parents[..., :3, :3], pivot) + parents[..., :3, 3]
    beside = np.cross(found_pivot - expected, found_axis)  # anywhere along the axis
    np.testing.assert_allclose(beside, 0.0, atol=1e-5)
    traced = jax.jit(joints_in_camera)(jax.tree.map(np.float32, pose))
    np.testing.assert_allclose(traced[0], found_axis, atol=1e-5)
