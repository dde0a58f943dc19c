"""Rotation from two predicted directions: the vertical correction of paper Sec 5.1.1, Eq 3.

Stage I predicts two axes of the root's frame, each with a confidence psi in (0, 1). They are not
quite at right angles: theta = pi / 2 + e. Eq 3 shares the excess e so that the confident direction
moves less: minimizing psi_1 d_1^2 + psi_2 d_2^2 under d_1 + d_2 = e gives

    d_1 = e psi_2 / (psi_1 + psi_2),    d_2 = e psi_1 / (psi_1 + psi_2).

The first turns by d_1 towards the second about a = first x second, the second by d_2 towards the
first. The third axis is plus or minus a. (The paper calls psi the extent of adjustment, which is
the opposite of its own Eq 3.)
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from caper_jax.errors import CaperError
from caper_jax.lie.linalg import as_floating, cross, dot, norm, unit


def rotation_from_directions(
    first: ArrayLike,
    second: ArrayLike,
    confidence_first: ArrayLike,
    confidence_second: ArrayLike,
    axes: tuple[str, str] = ("y", "z"),
) -> tuple[Float[Array, "*batch 3 3"], Bool[Array, "*batch"]]:
    """The rotation whose axes are the corrected directions (paper Eq 3).

    Args:
      first: [..., 3] predicted direction, of any length.
      second: [..., 3] predicted direction, of any length.
      confidence_first: [...] psi of the first direction, in (0, 1).
      confidence_second: [...] psi of the second direction.
      axes: which two of "x", "y", "z" the directions are.

    Returns:
      rotation: [..., 3, 3], always a rotation, with finite derivatives.
      degenerate: [...] bool; the input does not determine the rotation: a direction is zero or
        not finite, the two are parallel or opposite, or the confidences are both zero or not
        finite. What can be kept is kept: a single good direction is an axis of the result.

    Raises:
      CaperError: ``axes`` are not two different ones of x, y, z, or shapes are wrong.
    """
    i, j, k, sign = _axis_indices(axes)
    first = as_floating(first, (3,), "first")
    second = as_floating(second, (3,), "second")
    first, second = jnp.broadcast_arrays(first, second)
    basis = np.eye(3, dtype=first.dtype)

    first, first_good = _usable_unit(first)
    second, second_good = _usable_unit(second)
    spare_first = jnp.where(second_good[..., None], _perpendicular(second), basis[i])
    spare_second = jnp.where(first_good[..., None], _perpendicular(first), basis[j])
    first = jnp.where(first_good[..., None], first, spare_first)
    second = jnp.where(second_good[..., None], second, spare_second)

    normal = cross(first, second)
    sine = norm(normal)
    # Below this sine the plane of the two is rounding noise.
    parallel = sine < math.sqrt(float(jnp.finfo(first.dtype).eps))
    normal = unit(jnp.where(parallel[..., None], _perpendicular(first), normal))
    # Once more: for a small sine the cross product is not quite perpendicular.
    normal = unit(normal - first * dot(first, normal)[..., None])

    excess = jnp.arctan2(sine, dot(first, second)) - math.pi / 2
    share, share_good = _share(confidence_first, confidence_second)
    turn = (share * excess)[..., None]
    first = jnp.cos(turn) * first + jnp.sin(turn) * cross(normal, first)
    columns = {i: first, j: cross(normal, first), k: sign * normal}
    rotation = jnp.stack(jnp.broadcast_arrays(*(columns[c] for c in range(3))), axis=-1)
    return rotation, parallel | ~(first_good & second_good & share_good)


def _axis_indices(axes: tuple[str, str]) -> tuple[int, int, int, int]:
    """Indices of the first, second and third axis, and the sign of first x second in the third."""
    names = tuple(axes)
    if len(names) != 2 or names[0] == names[1] or not set(names) <= set("xyz"):
        raise CaperError(f"axes must be two different ones of 'x', 'y', 'z', got {axes!r}")
    i, j = ("xyz".index(name) for name in names)
    return i, j, 3 - i - j, 1 if (j - i) % 3 == 1 else -1


def _usable_unit(vector: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Unit vectors [..., 3], and whether [...] the input had a direction; if not, a zero vector."""
    length = norm(jax.lax.stop_gradient(vector))
    good = (length > 0) & jnp.isfinite(length)
    return unit(jnp.where(good[..., None], vector, 0.0)), good


def _perpendicular(vector: jax.Array) -> jax.Array:
    """Some unit vector at right angles to each unit vector [..., 3]; constant in derivatives."""
    vector = jax.lax.stop_gradient(vector)
    least = jnp.argmin(jnp.abs(vector), axis=-1)
    return unit(cross(vector, jax.nn.one_hot(least, 3, dtype=vector.dtype)))


def _share(first: ArrayLike, second: ArrayLike) -> tuple[jax.Array, jax.Array]:
    """Part [...] of the excess that the first direction takes, one half where undetermined."""
    first = as_floating(first, (), "confidence_first")
    second = as_floating(second, (), "confidence_second")
    total = first + second
    good = (first >= 0) & (second >= 0) & (total > 0) & jnp.isfinite(total)
    share = jnp.where(good, second, 0.5) / jnp.where(good, total, 1.0)
    return share, good
