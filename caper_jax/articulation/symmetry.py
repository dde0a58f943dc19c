"""Second readings of objects that a category declares ambiguous."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category, Symmetry
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError


def apply_symmetry(
    pose: ArticulatedPose, symmetry: Symmetry, category: Category
) -> ArticulatedPose:
    """The same object under the other reading: ``T'_k = T_permutation[k] S``.

    The relative motion of two parts becomes ``S^-1 J S``: axes and pivots turn by S^-1, and an
    axis also changes sign where parent and child change places, so that the states stay.

    Args:
      pose: arrays [..., K, ...], numpy or jax; the result is of the same kind.
      symmetry: one of the category's.
      category: gives the tree of parts.

    Raises:
      CaperError: the permutation joins parts that no joint, or one of another type, joins.
    """
    order = list(symmetry.permutation)
    turn = np.asarray(symmetry.turn)
    joints, signs = _matching_joints(order, category)

    def turned(rows, by=turn):
        # Row vectors times S, elementwise: exact on every backend, numpy or jax.
        return (rows[..., :, None] * by.astype(rows.dtype)).sum(-2)

    return ArticulatedPose(
        rotation=turned(pose.rotation[..., order, :, :]),
        translation=pose.translation[..., order, :],
        size=turned(pose.size[..., order, :], np.abs(turn)),
        box_center=turned(pose.box_center[..., order, :]),
        joint_axis=signs[:, None].astype(pose.joint_axis.dtype)
        * turned(pose.joint_axis[..., joints, :]),
        joint_pivot=turned(pose.joint_pivot[..., joints, :]),
        joint_state=pose.joint_state[..., joints],
    )


def _matching_joints(order: list[int], category: Category) -> tuple[list[int], np.ndarray]:
    """For every joint of the second reading, the joint of the first and +1, or -1 if reversed."""
    joint_of = {(parent, j + 1): j for j, parent in enumerate(category.parents)}
    where = f"category {category.name!r}: symmetry {tuple(order)} puts"
    joints, signs = [], []
    for j, parent in enumerate(category.parents):
        ends = order[parent], order[j + 1]
        reverse = ends not in joint_of
        joint = joint_of.get(ends[::-1] if reverse else ends)
        if joint is None:
            raise CaperError(
                f"{where} a joint between parts {ends[0]} and {ends[1]}, which have none"
            )
        kind, expected = category.joint_types[joint], category.joint_types[j]
        if kind != expected:
            raise CaperError(
                f"{where} the {kind} joint of part {joint + 1} where a {expected} one belongs"
            )
        joints.append(joint)
        signs.append(-1.0 if reverse else 1.0)
    return joints, np.array(signs)


def permute_labels(labels, symmetry: Symmetry):
    """Part labels [...] under the other reading; negative labels stay."""
    inverse = np.argsort(symmetry.permutation)
    return jnp.where(labels < 0, labels, jnp.asarray(inverse)[jnp.maximum(labels, 0)])


def is_ambiguous(size, symmetry: Symmetry):
    """Whether an instance looks (nearly) the same under both readings.

    Args:
      size: [..., K, 3] part sizes; a thin part against a thick one decides.
      symmetry: the declared ambiguity, with its tolerance.

    Returns:
      [...] bool.
    """
    turn = np.abs(np.asarray(symmetry.turn)).T
    other = (turn * size[..., list(symmetry.permutation), None, :]).sum(-1)
    difference = jnp.abs(other - size) / jnp.maximum(other, size)
    return (difference <= symmetry.tolerance).all((-1, -2))
