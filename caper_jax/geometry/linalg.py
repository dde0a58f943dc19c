"""Small vectors and matrices, batched over leading axes, multiplied element by element.

On a CPU this is faster than batched 3 x 3 matmuls, and on a GPU it is exact where a matmul would
round its float32 operands to TF32.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from caper_jax.errors import CaperError


def as_floating(value: ArrayLike, shape: Sequence[int], name: str) -> jax.Array:
    """The value as a floating array whose trailing axes are ``shape``.

    Raises:
      CaperError: the trailing axes differ.
    """
    array = jnp.asarray(value)
    if array.shape[max(array.ndim - len(shape), 0) :] != tuple(shape):
        wanted = ", ".join(map(str, ("...", *shape)))
        raise CaperError(f"{name} must have shape [{wanted}], got {list(array.shape)}")
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return array.astype(jnp.result_type(float))


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Inner product [...] of vectors [..., D], for small D."""
    a, b = entries(a, 1), entries(b, 1)
    terms = [a[i] * b[i] for i in range(len(a))]
    return sum(terms[1:], start=terms[0])


def entries(array: jax.Array, axes: int) -> jax.Array:
    """The last axes first, so that array[i], or array[i, j], is one entry of all elements.

    Whole rows of memory then go through the derivatives of a choice of entries, not every third
    number: they are several times as fast on a CPU.
    """
    return jnp.moveaxis(array, range(-axes, 0), range(axes))


def from_entries(parts: Sequence[Any], axes: int) -> jax.Array:
    """The array of nested lists of entries; inverts ``entries``."""
    return jnp.moveaxis(jnp.array(parts), range(axes), range(-axes, 0))


def cross_of(a: Any, b: Any) -> list[jax.Array]:
    """Cross product of vectors given entry by entry."""
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross product [..., 3] of vectors [..., 3]."""
    return from_entries(cross_of(entries(a, 1), entries(b, 1)), 1)


def norm(vector: jax.Array) -> jax.Array:
    """Euclidean length [...] of vectors [..., D], with derivative 0 at the zero vector."""
    squared = dot(vector, vector)
    zero = squared == 0.0
    # Both branches of a `where` are differentiated, so sqrt must not see the zero.
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def unit(vector: jax.Array) -> jax.Array:
    """Vectors [..., D] scaled to length 1; the zero vector stays zero, with finite derivative."""
    length = norm(vector)[..., None]
    return vector / jnp.where(length > 0, length, 1.0)


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix product of small matrices [..., I, K] and [..., K, J], element by element."""
    terms = [a[..., :, k, None] * b[..., None, k, :] for k in range(a.shape[-1])]
    return sum(terms[1:], start=terms[0])


def apply(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Matrix-vector product of [..., I, K] and [..., K], element by element."""
    terms = [matrix[..., :, k] * vector[..., k, None] for k in range(matrix.shape[-1])]
    return sum(terms[1:], start=terms[0])


def transpose(matrix: jax.Array) -> jax.Array:
    """[..., I, J] -> [..., J, I]."""
    return jnp.swapaxes(matrix, -1, -2)
