"""Consistent random frames for tests; SciPy does the kinematics."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from caper_jax.articulation.pose import ArticulatedPose


def random_pose(frames: int, seed: int = 0) -> ArticulatedPose:
    """Poses [F, 2, ...] of an object with one revolute joint, 2.5 m in front of the camera."""
    rng = np.random.default_rng(seed)
    root = Rotation.random(frames, rng=rng)
    shift = rng.normal(size=(frames, 3)) * 0.2 + [0, 0, 2.5]
    axis = rng.normal(size=(frames, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    pivot, state = rng.normal(size=(frames, 3)) * 0.05, rng.uniform(0, 3, frames)
    turn = Rotation.from_rotvec(axis * state[:, None])
    lid_shift = root.apply(pivot - turn.apply(pivot)) + shift
    return ArticulatedPose(
        rotation=np.stack([root.as_matrix(), (root * turn).as_matrix()], 1).astype(np.float32),
        translation=np.stack([shift, lid_shift], 1).astype(np.float32),
        size=rng.uniform(0.05, 0.3, (frames, 2, 3)).astype(np.float32),
        box_center=rng.normal(size=(frames, 2, 3)).astype(np.float32) * 0.01,
        joint_axis=axis[:, None].astype(np.float32),
        joint_pivot=pivot[:, None].astype(np.float32),
        joint_state=state[:, None].astype(np.float32),
    )


def random_frames(frames: int, points: int, seed: int = 0) -> dict[str, Any]:
    """Arguments of ``hdf5.write``: points, labels, pose, visible."""
    rng = np.random.default_rng(seed)
    pose = random_pose(frames, seed)
    offsets = rng.uniform(-0.3, 0.3, (frames, points, 3))
    labels = rng.integers(-1, 2, (frames, points))
    return {
        "points": (pose.translation[:, :1] + offsets).astype(np.float32),
        "labels": labels,
        "pose": pose,
        "visible": np.stack([(labels == part).sum(1) for part in range(2)], 1),
    }
