"""What gravity says of an object's rotation: what stands on a table has its up axis upright.

Not in the paper. Robots, phones and some depth cameras know which way is down. The cloud is leveled
by it (``observation.observe``), so that any camera roll will do; and of the 24 rotations that an
object is mistaken for (``rotation_classes``) it leaves those in which the object stands.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from caper_jax.articulation.category import Category
from caper_jax.geometry.frames import CUBE_ROTATIONS, multiply

# Standard deviation of an upright object's tilt as stage I sees it, a sloping floor included.
_TILT = np.radians(15.0)
_OVERTURNED = 1e-3  # what stands may have fallen over


def upright_log_weight(
    rotation: Float[Array, "*#batch 3 3"], gravity: Float[Array, "*#batch 3"], category: Category
) -> Float[Array, "..."]:
    """Logarithm of how well a rotation of the root agrees with gravity: 0 for upright.

    Zero also where gravity is unknown, and for categories that lie as they like.

    Args:
      rotation: root -> the frame of ``gravity``.
      gravity: unit vector, zeros where it is unknown.
      category: static.
    """
    if not category.stands:
        return jnp.zeros(rotation.shape[:-2], rotation.dtype)
    up = rotation[..., "xyz".index(category.viewpoint.up)]
    known = jnp.square(gravity).sum(-1) > 0.5
    cosine = -(up * gravity).sum(-1)
    # 2 (1 - cos) is the square of a small angle, and smooth where the arc cosine is not.
    weight = jnp.exp((cosine - 1.0) / _TILT**2)
    return jnp.where(known, jnp.log(weight + _OVERTURNED) - np.log1p(_OVERTURNED), 0.0)


def class_log_weights(
    rotation: Float[Array, "*batch 3 3"], gravity: Float[Array, "*batch 3"], category: Category
) -> Float[Array, "*batch 24"]:
    """``upright_log_weight`` of a rotation after each of ``CUBE_ROTATIONS``."""
    rotated = multiply(rotation[..., None, :, :], jnp.asarray(CUBE_ROTATIONS, rotation.dtype))
    return upright_log_weight(rotated, gravity[..., None, :], category)
