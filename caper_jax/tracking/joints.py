"""What the part poses of one frame say about the joints between them."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp

from caper_jax.articulation.category import Category
from caper_jax.lie import linalg, se3, so3
from caper_jax.tracking.state import ObjectParameters

# Motion from rest at which a pose tells as much about its joint as one frame's votes do.
_TURN, _SLIDE, _PIVOT = 0.1, 0.1, 0.1


def joints_from_poses(parts, votes: ObjectParameters, category: Category):
    """Joint states, axes and pivots that fit given part poses, as far as these determine them.

    A child's pose in its parent's frame is ``[R | (I - R) q]`` (Eq 8): the axis of R is the
    joint's, its angle the state, and the pivot q follows but for its place along the axis. Near
    rest R and I - R vanish and the votes of the network stay as they are; in between, both count
    by their uncertainty.

    Args:
      parts: [K, 4, 4] part poses in the root's frame, network units.
      votes: joints as the network sees them; its axes also decide about the signs.
      category: joint types and tree.

    Returns:
      (states [J], constants with new axes, pivots and ``known``).
    """
    states, axes, pivots, known = [], [], [], []
    for joint, (kind, parent) in enumerate(
        zip(category.joint_types, category.parents, strict=True)
    ):
        relative = se3.compose(se3.inverse(parts[parent]), parts[joint + 1])
        rotation, translation = relative[:3, :3], relative[:3, 3]
        turns = kind == "revolute"
        motion, scale = (so3.log(rotation), _TURN) if turns else (translation, _SLIDE)
        voted = votes.axis[joint]
        forward = jnp.where(linalg.dot(motion, voted) < 0, -1.0, 1.0)
        weight = linalg.dot(motion, motion) / scale**2
        length = linalg.norm(motion)
        axis = linalg.unit(voted + weight * forward * linalg.unit(motion))
        states.append(forward * length)
        axes.append(axis)
        known.append(weight)
        pivot = votes.pivot[joint]
        if turns:
            arm = jnp.eye(3, dtype=rotation.dtype) - rotation
            normal = linalg.multiply(arm.T, arm) + _PIVOT**2 * jnp.eye(3, dtype=arm.dtype)
            missing = translation - linalg.apply(arm, pivot)
            pivot += jnp.linalg.solve(normal, linalg.apply(arm.T, missing))
        pivots.append(pivot)
    constants = replace(
        votes, axis=jnp.stack(axes), pivot=jnp.stack(pivots), known=10.0 * jnp.stack(known)
    )
    return jnp.stack(states), constants
