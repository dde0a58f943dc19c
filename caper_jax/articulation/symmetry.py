"""The declared symmetries of a category: other poses that describe the same object equally well."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from caper_jax.articulation.category import Category, Symmetry
from caper_jax.articulation.pose import Array, ArticulatedPose
from caper_jax.errors import CaperError


def apply_symmetry(
    pose: ArticulatedPose, symmetry: Symmetry, category: Category
) -> ArticulatedPose:
    """The equivalent pose of the same object: ``T'_k = T_permutation[k] S``.

    The relative motion of two parts becomes ``S^-1 J S``: axes and pivots rotate by S^-1, and an
    axis also changes sign where parent and child change places, so that the states stay.

    Args:
      pose: of numpy or jax arrays; the result is of the same kind.
      symmetry: one of the category's.
      category: gives the tree of parts.

    Raises:
      CaperError: the permutation joins parts that no joint, or one of another type, joins.
    """
    order = list(symmetry.permutation)
    rotation = np.asarray(symmetry.rotation)
    joints, signs = _matching_joints(order, category)

    def rotated(rows, by=rotation):
        # Row vectors times S, elementwise: exact on every backend, numpy or jax.
        return (rows[..., :, None] * by.astype(rows.dtype)).sum(-2)

    return ArticulatedPose(
        rotation=rotated(pose.rotation[..., order, :, :]),
        translation=pose.translation[..., order, :],
        size=rotated(pose.size[..., order, :], np.abs(rotation)),
        box_center=rotated(pose.box_center[..., order, :]),
        joint_axis=signs[:, None].astype(pose.joint_axis.dtype)
        * rotated(pose.joint_axis[..., joints, :]),
        joint_pivot=rotated(pose.joint_pivot[..., joints, :]),
        joint_state=pose.joint_state[..., joints],
    )


def _matching_joints(order: list[int], category: Category) -> tuple[list[int], np.ndarray]:
    """For every joint of the equivalent pose, the joint of the first and +1, or -1 if reversed."""
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


def permute_labels(labels: Int[Array, "*batch"], symmetry: Symmetry) -> Int[Array, "*batch"]:
    """Part labels that go with the equivalent pose; negative labels stay."""
    inverse = np.argsort(symmetry.permutation)
    return jnp.where(labels < 0, labels, jnp.asarray(inverse)[jnp.maximum(labels, 0)])


def is_ambiguous(size: Float[Array, "*batch K 3"], symmetry: Symmetry) -> Bool[Array, "*batch"]:
    """Whether an instance looks (nearly) the same in both poses.

    Args:
      size: of the parts; a thin part against a thick one decides.
      symmetry: with its tolerance.
    """
    rotation = np.abs(np.asarray(symmetry.rotation)).T
    other = (rotation * size[..., list(symmetry.permutation), None, :]).sum(-1)
    difference = jnp.abs(other - size) / jnp.maximum(other, size)
    return (difference <= symmetry.tolerance).all((-1, -2))
