"""Forward kinematics of a part tree: differentiable in JAX, and in float64 on the host."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Shaped

from caper_jax.articulation.joints import joint_transforms
from caper_jax.errors import CaperError, unknown_name
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


def joint_transform_float64(
    joint_type: str,
    axis: Float[np.ndarray, " 3"],
    pivot: Float[np.ndarray, " 3"],
    state: float,
) -> Float[np.ndarray, "4 4"]:
    """``joints.joint_transform`` of one joint with a unit axis, in float64 without JAX.

    For files, whose meshes must not move by the rounding of float32.

    Args:
      joint_type: "revolute" or "prismatic".
      axis: [3] unit vector.
      pivot: [3] meters; without effect on a prismatic joint.
      state: radians or meters.

    Returns:
      [4, 4].

    Raises:
      CaperError: unknown joint type.
    """
    from scipy.spatial.transform import Rotation  # importing it costs 0.1 s

    motion = np.eye(4)
    if joint_type == "prismatic":
        motion[:3, 3] = state * axis
    elif joint_type == "revolute":
        motion[:3, :3] = Rotation.from_rotvec(state * axis).as_matrix()
        motion[:3, 3] = pivot - motion[:3, :3] @ pivot
    else:
        raise unknown_name("joint type", joint_type, ("revolute", "prismatic"))
    return motion


def forward_kinematics_float64(
    root: Float[np.ndarray, "4 4"],
    axis: Float[np.ndarray, "J 3"],
    pivot: Float[np.ndarray, "J 3"],
    state: Shaped[np.ndarray, " J"],
    joint_types: Sequence[str],
    parents: Sequence[int],
) -> Float[np.ndarray, "K 4 4"]:
    """``forward_kinematics`` of one object with unit axes, in float64 without JAX.

    Args:
      root: [4, 4] pose of part 0.
      axis: [J, 3] unit joint axes.
      pivot: [J, 3] meters.
      state: [J] radians or meters from the rest pose.
      joint_types: J times "revolute" or "prismatic".
      parents: J parent parts; a parent comes before its child.

    Returns:
      [K, 4, 4].

    Raises:
      CaperError: unknown joint type.
    """
    poses = [np.asarray(root, np.float64)]
    for joint, parent in enumerate(parents):
        motion = joint_transform_float64(
            joint_types[joint], axis[joint], pivot[joint], float(state[joint])
        )
        poses.append(poses[parent] @ motion)
    return np.stack(poses)
