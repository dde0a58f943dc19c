"""Joint transforms and forward kinematics of a part tree (paper Sec 5.2.2, Eq 8).

Differentiable in JAX, and in float64 on the host for files.

Eq 8 is implemented in its right form, ``[R | (I - R) q]``. A state is measured from the rest pose,
in radians (revolute) or meters (prismatic). A positive one turns the child by plus the state about
the axis, or slides it by plus the state along the axis. Axes are scaled to unit length here; a zero
axis gives the identity, with finite derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Shaped

from caper_jax.errors import CaperError, unknown_name
from caper_jax.lie import se3, so3
from caper_jax.lie.linalg import as_floating, cross, unit


def revolute_transform(
    axis: ArrayLike, pivot: ArrayLike, angle: ArrayLike
) -> Float[Array, "... 4 4"]:
    """Turn [..., 4, 4] about the line through ``pivot``.

    R is Rodrigues' rotation about the unit axis u, ``cos I + (1 - cos) u u^T + sin hat(u)``.

    Args:
      axis: [..., 3] direction of the line.
      pivot: [..., 3] meters; any point of the line.
      angle: [...] radians.
    """
    return joint_transform("revolute", axis, pivot, angle)


def prismatic_transform(axis: ArrayLike, displacement: ArrayLike) -> Float[Array, "... 4 4"]:
    """Slide [..., 4, 4] along an axis: ``[I | d u]``.

    Args:
      axis: [..., 3] direction.
      displacement: [...] meters.
    """
    u = unit(as_floating(axis, (3,), "axis"))
    shift = u * as_floating(displacement, (), "displacement")[..., None]
    return se3.from_rt(jnp.eye(3, dtype=shift.dtype), shift)


def joint_transform(
    joint_type: str, axis: ArrayLike, pivot: ArrayLike, state: ArrayLike
) -> Float[Array, "... 4 4"]:
    """Transform [..., 4, 4] of a joint at a state.

    Args:
      joint_type: "revolute" or "prismatic".
      axis: [..., 3] in the root's canonical (rest) frame.
      pivot: [..., 3] meters, same frame; without effect on a prismatic joint.
      state: [...] radians or meters.

    Raises:
      CaperError: unknown joint type.
    """
    axis = as_floating(axis, (3,), "axis")[..., None, :]
    pivot = as_floating(pivot, (3,), "pivot")[..., None, :]
    state = as_floating(state, (), "state")[..., None]
    return joint_transforms([joint_type], axis, pivot, state)[..., 0, :, :]


def joint_transforms(
    joint_types: Sequence[str], axis: ArrayLike, pivot: ArrayLike, state: ArrayLike
) -> Float[Array, "... J 4 4"]:
    """Transforms [..., J, 4, 4] of J joints, each at its own state.

    Args:
      joint_types: J times "revolute" or "prismatic".
      axis: [..., J, 3] in the root's canonical (rest) frame.
      pivot: [..., J, 3] meters, same frame; without effect on a prismatic joint.
      state: [..., J] radians or meters.

    Raises:
      CaperError: unknown joint type.
    """
    known = ("revolute", "prismatic")
    for name in joint_types:
        if name not in known:
            raise unknown_name("joint type", name, known)
    turns = np.array([name == "revolute" for name in joint_types], dtype=bool)
    count = len(turns)
    u = unit(as_floating(axis, (count, 3), "axis"))
    q = jnp.where(turns[:, None], as_floating(pivot, (count, 3), "pivot"), 0.0)
    state = as_floating(state, (count,), "state")
    angle, slide = jnp.where(turns, state, 0.0), jnp.where(turns, 0.0, state)

    sin, versine = jnp.sin(angle), 2 * jnp.sin(angle / 2) ** 2
    rotation = so3.rodrigues(u, sin, versine)
    # (I - R) q from the same terms: small for small angles, where the difference q - R q would
    # be left with the rounding of q.
    turned = cross(u, q)
    shift = slide[..., None] * u - sin[..., None] * turned - versine[..., None] * cross(u, turned)
    return se3.from_rt(rotation, shift)


def forward_kinematics(
    root: ArrayLike,
    axis: ArrayLike,
    pivot: ArrayLike,
    state: ArrayLike,
    joint_types: Sequence[str],
    parents: Sequence[int],
) -> Float[Array, "... K 4 4"]:
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
    axis: Float[np.ndarray, "*#batch 3"],
    pivot: Float[np.ndarray, "*#batch 3"],
    state: float | Shaped[np.ndarray, "*#batch"],
) -> Float[np.ndarray, "... 4 4"]:
    """``joint_transform`` of a joint with a unit axis, in float64 without JAX.

    For files, whose meshes must not move by the rounding of float32.

    Args:
      joint_type: "revolute" or "prismatic".
      axis: [..., 3] unit vectors.
      pivot: [..., 3] meters; without effect on a prismatic joint.
      state: [...] radians or meters.

    Raises:
      CaperError: unknown joint type.
    """
    from scipy.spatial.transform import Rotation  # importing it costs 0.1 s

    shift = np.asarray(state)[..., None] * axis
    motion = np.broadcast_to(np.eye(4), (*shift.shape[:-1], 4, 4)).copy()
    if joint_type == "prismatic":
        motion[..., :3, 3] = shift
    elif joint_type == "revolute":
        turn = Rotation.from_rotvec(shift.reshape(-1, 3)).as_matrix().reshape(*shift.shape, 3)
        motion[..., :3, :3] = turn
        motion[..., :3, 3] = pivot - (turn @ pivot[..., None])[..., 0]
    else:
        raise unknown_name("joint type", joint_type, ("revolute", "prismatic"))
    return motion


def forward_kinematics_float64(
    root: Float[np.ndarray, "*#batch 4 4"],
    axis: Float[np.ndarray, "*#batch J 3"],
    pivot: Float[np.ndarray, "*#batch J 3"],
    state: Shaped[np.ndarray, "*#batch J"],
    joint_types: Sequence[str],
    parents: Sequence[int],
) -> Float[np.ndarray, "... K 4 4"]:
    """``forward_kinematics`` with unit axes, in float64 without JAX; the same arguments."""
    poses = [np.asarray(root, np.float64)]
    for j, (joint_type, parent) in enumerate(zip(joint_types, parents, strict=True)):
        motion = joint_transform_float64(
            joint_type, axis[..., j, :], pivot[..., j, :], np.asarray(state)[..., j]
        )
        poses.append(poses[parent] @ motion)
    return np.stack(np.broadcast_arrays(*poses), axis=-3)
