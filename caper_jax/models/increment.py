"""Pose increments of the root as numbers of a network (paper Sec 5.3.2 and Table 9)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from caper_jax.config import IncrementKind
from caper_jax.geometry.two_axis_rotation import rotation_from_directions
from caper_jax.lie import se3


def increment_transform(numbers, kind: IncrementKind) -> jax.Array:
    """The rigid transform [..., 4, 4] that a network's output stands for.

    Args:
      numbers: "lie": [..., 6] a twist (w, rho), mapped by the exponential (Eq 14); "euclidean":
        [..., 9] the first two axes, as differences to x and y, and the translation; the first axis
        keeps its direction, the second is made perpendicular. Zeros give the identity in both.
      kind: which of the two.
    """
    if kind == "lie":
        return se3.exp(numbers)
    x = numbers[..., 0:3] + jnp.array([1.0, 0.0, 0.0], numbers.dtype)
    y = numbers[..., 3:6] + jnp.array([0.0, 1.0, 0.0], numbers.dtype)
    rotation, _ = rotation_from_directions(x, y, 1.0, 0.0, ("x", "y"))
    return se3.from_rt(rotation, numbers[..., 6:])


def increment_numbers(transform, kind: IncrementKind) -> jax.Array:
    """What a network should put out for a transform [..., 4, 4]; inverts the above."""
    if kind == "lie":
        return se3.log(transform)
    axes = transform[..., :3, :2] - jnp.eye(3, dtype=transform.dtype)[:, :2]
    axes = jnp.swapaxes(axes, -1, -2)
    return jnp.concatenate([axes[..., 0, :], axes[..., 1, :], transform[..., :3, 3]], -1)
