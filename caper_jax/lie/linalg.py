"""Small vectors and matrices, batched over leading axes, multiplied element by element.

On a CPU this is faster than batched 3 x 3 matmuls, and on a GPU it is exact where a matmul would
round its float32 operands to TF32.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from caper_jax.errors import CaperError


def as_floating(value: ArrayLike, shape: Sequence[int], name: str) -> Float[Array, "..."]:
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


def dot(a: Float[Array, "*#batch D"], b: Float[Array, "*#batch D"]) -> Float[Array, "..."]:
    """Inner product of vectors, for small D."""
    return dot_of(entries(a), entries(b))


def cross(a: Float[Array, "*#batch 3"], b: Float[Array, "*#batch 3"]) -> Float[Array, "... 3"]:
    """Cross product of vectors."""
    return from_entries(cross_of(entries(a), entries(b)))


@jax.custom_jvp
def entries(vector: jax.Array) -> list[jax.Array]:
    """The D entries [...] of vectors [..., D].

    Sums and products of whole [...] arrays compile to vector instructions, those of [..., 3] to
    short loops.
    """
    return _split(vector)


@entries.defjvp
def _entries_jvp(primals, tangents):
    # A sum of one entry and zeros, for the sake of its reverse: choices, as in from_entries.
    (vector,), (change,) = primals, tangents
    chosen = np.eye(vector.shape[-1], dtype=bool)
    return _split(vector), [jnp.where(mask, change, 0).sum(-1) for mask in chosen]


def from_entries(parts: Sequence[jax.Array]) -> jax.Array:
    """Vectors [..., D] of D entries [...]; inverts ``entries``.

    Choices compile to one loop that evaluates what the entries share once; XLA on a CPU evaluates
    it again for each operand of a concatenation, and all that this in turn shares.
    """
    index = np.arange(len(parts))
    result = parts[0][..., None]
    for i, part in enumerate(parts[1:], start=1):
        result = jnp.where(index < i, result, part[..., None])
    return result


def rows(matrix: jax.Array) -> list[list[jax.Array]]:
    """The entries [...] of matrices [..., I, J], as I lists of J."""
    *batch, height, width = matrix.shape
    flat = _split(matrix.reshape(*batch, height * width))
    return [flat[i * width : (i + 1) * width] for i in range(height)]


@jax.custom_jvp
def from_rows(parts: Sequence[Sequence[jax.Array]]) -> jax.Array:
    """Matrices [..., I, J], 9 entries or more, of I lists of J entries; inverts ``rows``."""
    return jnp.stack([from_entries(row) for row in parts], axis=-2)


@from_rows.defjvp
def _from_rows_jvp(primals, tangents):
    # The reverse of one concatenation cancels that of rows. XLA computes the operands of more than
    # eight apart, so that nothing they share is evaluated twice.
    (parts,), (changes,) = primals, tangents
    flat = jnp.stack([entry for row in changes for entry in row], axis=-1)
    return from_rows(parts), flat.reshape(*flat.shape[:-1], len(parts), len(parts[0]))


def _split(vector: jax.Array) -> list[jax.Array]:
    """The entries [...] of vectors [..., D], whose reverse is a concatenation."""
    parts = jax.lax.split(vector, [1] * vector.shape[-1], axis=-1)
    return [jax.lax.squeeze(part, [-1]) for part in parts]


def dot_of(a: Sequence[jax.Array], b: Sequence[jax.Array]) -> jax.Array:
    """Inner product of vectors given entry by entry."""
    terms = [x * y for x, y in zip(a, b, strict=True)]
    return sum(terms[1:], start=terms[0])


def cross_of(a: Sequence[jax.Array], b: Sequence[jax.Array]) -> list[jax.Array]:
    """Cross product of vectors given entry by entry."""
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def norm(vector: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
    """Euclidean length of vectors, with derivative 0 at the zero vector."""
    squared = dot(vector, vector)
    zero = squared == 0.0
    # Both branches of a `where` are differentiated, so sqrt must not see the zero.
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def unit(vector: Float[Array, "*batch D"]) -> Float[Array, "*batch D"]:
    """Vectors scaled to length 1; the zero vector stays zero, with finite derivative."""
    length = norm(vector)[..., None]
    return vector / jnp.where(length > 0, length, 1.0)


def multiply(
    a: Float[Array, "*#batch I K"], b: Float[Array, "*#batch K J"]
) -> Float[Array, "... I J"]:
    """Matrix product of small matrices, element by element."""
    terms = [a[..., :, k, None] * b[..., None, k, :] for k in range(a.shape[-1])]
    return sum(terms[1:], start=terms[0])


def apply(
    matrix: Float[Array, "*#batch I K"], vector: Float[Array, "*#batch K"]
) -> Float[Array, "... I"]:
    """Matrix-vector product, element by element."""
    terms = [matrix[..., :, k] * vector[..., k, None] for k in range(matrix.shape[-1])]
    return sum(terms[1:], start=terms[0])


def transpose(matrix: Float[Array, "*batch I J"]) -> Float[Array, "*batch J I"]:
    """Transposed matrices."""
    return jnp.swapaxes(matrix, -1, -2)
