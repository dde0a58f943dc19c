"""Second readings of objects that a category declares ambiguous."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Equivalence
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError


def second_reading(pose: ArticulatedPose, equivalence: Equivalence) -> ArticulatedPose:
    """The same object under the other reading: ``T'_k = T_permutation[k] S``.

    Args:
      pose: leading axes [...]; numpy or jax.
      equivalence: the root stays the root, or the two parts of a two-part object change places.

    Raises:
      CaperError: another kind of permutation; what its joints become is not defined.
    """
    order = list(equivalence.permutation)
    turn = np.asarray(equivalence.turn)
    back = turn.T
    if order[0] == 0:
        joints, sign = [part - 1 for part in order[1:]], 1.0
    elif len(order) == 2:
        # Root and child change places: the child's motion as its parent sees it is the inverse
        # motion of the root, about the same line; positive still opens with the axis reversed.
        joints, sign = [0], -1.0
    else:
        raise CaperError(
            f"equivalence {order}: a constrained part can only become the root of two parts"
        )

    def rotated(vectors):
        return (back * vectors[..., None, :]).sum(-1)

    return ArticulatedPose(
        rotation=jnp.matmul(pose.rotation[..., order, :, :], turn, precision="highest"),
        translation=pose.translation[..., order, :],
        size=jnp.abs(rotated(pose.size[..., order, :])),
        box_center=rotated(pose.box_center[..., order, :]),
        joint_axis=sign * rotated(pose.joint_axis[..., joints, :]),
        joint_pivot=rotated(pose.joint_pivot[..., joints, :]),
        joint_state=pose.joint_state[..., joints],
    )


def second_labels(labels, equivalence: Equivalence):
    """Part labels [...] under the other reading; negative labels stay."""
    inverse = np.argsort(equivalence.permutation)
    return jnp.where(labels < 0, labels, jnp.asarray(inverse)[jnp.maximum(labels, 0)])


def is_ambiguous(size, equivalence: Equivalence, tolerance: float = 0.3):
    """Whether an instance looks (nearly) the same under both readings.

    Args:
      size: [..., K, 3] part sizes; a thin part against a thick one decides.
      equivalence: the declared ambiguity.
      tolerance: largest relative difference of any extent of exchanged parts.

    Returns:
      [...] bool.
    """
    turn = np.abs(np.asarray(equivalence.turn)).T
    other = (turn * size[..., list(equivalence.permutation), None, :]).sum(-1)
    difference = jnp.abs(other - size) / jnp.maximum(other, size)
    return (difference <= tolerance).all((-1, -2))
