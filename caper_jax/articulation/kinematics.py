"""Forward kinematics of a part tree."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from caper_jax.articulation.joints import joint_transforms
from caper_jax.errors import CaperError
from caper_jax.lie import se3
from caper_jax.lie.linalg import as_floating


def forward_kinematics(
    root: ArrayLike,
    axis: ArrayLike,
    pivot: ArrayLike,
    state: ArrayLike,
    joint_types: Sequence[str],
    parents: Sequence[int],
) -> jax.Array:
    """Poses of all K = J + 1 parts: ``T_k = T_parent(k) J_k(state_k)``.

    Axes and pivots are given in the root's canonical frame at rest. At rest every part shares the
    root's pose, so the same numbers hold in the parent's frame, however deep the tree.

    Args:
      root: [..., 4, 4] pose of part 0, canonical frame -> camera.
      axis: [..., J, 3] unit joint axes.
      pivot: [..., J, 3] meters; points on the axes.
      state: [..., J] radians (revolute) or meters (prismatic) from the rest pose.
      joint_types: J times "revolute" or "prismatic"; joint j carries part j + 1.
      parents: J parent parts; a parent comes before its child.

    Returns:
      [..., K, 4, 4].

    Raises:
      CaperError: unknown joint type, or counts or parents that make no tree.
    """
    joints = len(joint_types)
    if len(parents) != joints:
        raise CaperError(f"joint_types names {joints} joints, parents {len(parents)}")
    for joint, parent in enumerate(parents):
        if not 0 <= parent <= joint:
            raise CaperError(
                f"parents[{joint}] = {parent}: part {joint + 1} needs a parent among parts "
                f"0 to {joint}"
            )
    root = as_floating(root, (4, 4), "root")
    motions = joint_transforms(joint_types, axis, pivot, state)
    poses = [root]
    for joint, parent in enumerate(parents):
        poses.append(se3.compose(poses[parent], motions[..., joint, :, :]))
    return jnp.stack(jnp.broadcast_arrays(*poses), axis=-3)
