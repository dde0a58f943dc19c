"""Rotations: SO(3) as [..., 3, 3] matrices and so(3) as rotation vectors w [..., 3] (radians).

Every function broadcasts over leading axes, follows the dtype of its input and has finite
derivatives, forward and reverse, for every rotation, identity and half turns included. Products
are written out element by element: faster than batched 3 x 3 matmuls, and exact where a GPU would
round matmul operands to TF32.

Two devices keep float32 accurate to its last digits:

* the coefficients of Rodrigues' formula, such as (1 - cos t) / t^2, cancel for small angles. They
  are power series in s = t^2 for t < 1 and half-angle forms above. Being functions of s, they
  also spare the derivative of sqrt at 0;
* ``log`` goes through the unit quaternion q nearest to the matrix. With M = 4 q q^T linear in
  the entries of R, any column of M is a multiple of q; the longest starts one power iteration,
  which averages the rounding of all nine entries and works alike at 0 and pi.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from caper_jax.errors import CaperError

# Below this t^2 the power series are used; their terms fall by 1/24 or faster.
_SERIES_BELOW = 1.0
_SERIES_TERMS = 12


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


def norm(vector: jax.Array) -> jax.Array:
    """Euclidean length [...] of vectors [..., D], with derivative 0 at the zero vector."""
    squared = jnp.sum(vector * vector, axis=-1)
    zero = squared == 0.0
    # Both branches of a `where` are differentiated, so sqrt must not see the zero.
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


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


def hat(w: ArrayLike) -> jax.Array:
    """Skew matrix [..., 3, 3] of a vector [..., 3]: ``hat(w) @ v == cross(w, v)``."""
    w = as_floating(w, (3,), "w")
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    zero = jnp.zeros_like(x)
    return _matrix(zero, -z, y, z, zero, -x, -y, x, zero)


def vee(skew: ArrayLike) -> jax.Array:
    """Vector [..., 3] of a skew matrix [..., 3, 3]; of another matrix, of its skew part."""
    m = as_floating(skew, (3, 3), "skew")
    pairs = ((2, 1), (0, 2), (1, 0))
    return jnp.stack([(m[..., i, j] - m[..., j, i]) / 2 for i, j in pairs], axis=-1)


def exp(w: ArrayLike) -> jax.Array:
    """Rotation matrix [..., 3, 3] of a rotation vector [..., 3] (Rodrigues' formula).

    Args:
      w: [..., 3] axis times angle, radians; any length.
    """
    w = as_floating(w, (3,), "w")
    return _identity_plus(w, *exp_coefficients(w)[:2])


def log(rotation: ArrayLike) -> jax.Array:
    """Rotation vector [..., 3], of length at most pi, of a rotation matrix [..., 3, 3].

    A matrix off SO(3) by rounding is read as the rotation nearest to it. At exactly pi the vector
    and its negative are the same rotation, and either may be returned.
    """
    q = _quaternion(as_floating(rotation, (3, 3), "rotation"))
    real, vector = q[..., 0], q[..., 1:]
    squared = jnp.sum(vector * vector, axis=-1)
    # asin(n) / n as a series; n < 0.02 leaves the first dropped term at 8e-16.
    small = squared < 4e-4
    series = _horner((1.0, 1 / 6, 3 / 40, 15 / 336), squared)
    length = jnp.sqrt(jnp.where(small, 1.0, squared))
    half_angle_ratio = jnp.where(small, series, jnp.arctan2(length, real) / length)
    return 2 * half_angle_ratio[..., None] * vector


def left_jacobian(w: ArrayLike) -> jax.Array:
    """[..., 3, 3] J with ``exp(w + d) = exp(J d) exp(w)`` to first order; V of SE(3) alike."""
    w = as_floating(w, (3,), "w")
    _, first, second = exp_coefficients(w)
    return _identity_plus(w, first, second)


def left_jacobian_inverse(w: ArrayLike) -> jax.Array:
    """[..., 3, 3] inverse of ``left_jacobian``; singular at |w| = 2 pi, 4 pi, ... only."""
    w = as_floating(w, (3,), "w")
    return _identity_plus(w, jnp.asarray(-0.5, w.dtype), inverse_jacobian_coefficient(w))


def angle(rotation: ArrayLike) -> jax.Array:
    """Rotation angle [...] in [0, pi] radians of [..., 3, 3].

    The atan2 form keeps seven digits in float32 at every angle, where arccos of the trace reads 0
    for 0.01 deg. The derivative is taken as 0 at the identity and at pi, where none exists.
    """
    r = as_floating(rotation, (3, 3), "rotation")
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    return jnp.arctan2(norm(vee(r)), (trace - 1) / 2)


def geodesic_distance(rotation_a: ArrayLike, rotation_b: ArrayLike) -> jax.Array:
    """Angle [...] in radians of the rotation that takes one [..., 3, 3] to the other."""
    a = as_floating(rotation_a, (3, 3), "rotation_a")
    b = as_floating(rotation_b, (3, 3), "rotation_b")
    return angle(multiply(transpose(a), b))


def interpolate(rotation_a: ArrayLike, rotation_b: ArrayLike, fraction: ArrayLike) -> jax.Array:
    """Point [..., 3, 3] on the shortest path from a (fraction 0) to b (fraction 1).

    Args:
      rotation_a: [..., 3, 3].
      rotation_b: [..., 3, 3].
      fraction: [...]; values outside [0, 1] extrapolate.
    """
    a = as_floating(rotation_a, (3, 3), "rotation_a")
    b = as_floating(rotation_b, (3, 3), "rotation_b")
    w = log(multiply(transpose(a), b))
    return multiply(a, exp(jnp.asarray(fraction, w.dtype)[..., None] * w))


def exp_coefficients(w: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 [...] of t = |w|, w [..., 3]."""
    squared, small, t = angle_terms(w)
    sin, cos = jnp.sin(t / 2), jnp.cos(t / 2)
    sin_t = 2 * sin * cos
    closed = (sin_t / t, 2 * (sin / t) ** 2, (t - sin_t) / t**3)
    series = [
        alternating_series(lambda k, n=n: 1 / math.factorial(2 * k + n), squared) for n in (1, 2, 3)
    ]
    first, second, third = (jnp.where(small, s, c) for s, c in zip(series, closed, strict=True))
    return first, second, third


def inverse_jacobian_coefficient(w: jax.Array) -> jax.Array:
    """(1 - (t / 2) cot(t / 2)) / t^2 [...] of t = |w|, w [..., 3]."""
    squared, small, t = angle_terms(w)
    half = t / 2
    closed = (1 - half * jnp.cos(half) / jnp.sin(half)) / t**2
    # |B_2k| / (2k)!, Bernoulli numbers; each term is 1 / (4 pi^2) of the one before.
    series = (
        *(1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160),
        *(691 / 1307674368000, 1 / 74724249600, 3617 / 10670622842880000),
        *(43867 / 5109094217170944000, 174611 / 802857662698291200000),
    )
    return jnp.where(small, _horner(series, squared), closed)


def alternating_series(coefficient: Callable[[int], float], squared: jax.Array) -> jax.Array:
    """sum_k (-1)^k coefficient(k) s^k for s = t^2 below the switch to closed forms."""
    return _horner([(-1) ** k * coefficient(k) for k in range(_SERIES_TERMS)], squared)


def angle_terms(w: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """t^2, whether the series apply, and t, replaced by 1 where they do."""
    squared = jnp.sum(w * w, axis=-1)
    small = squared < _SERIES_BELOW
    # The unused branch must stay finite too, or 0 * inf = NaN reaches the gradient.
    return squared, small, jnp.sqrt(jnp.where(small, 1.0, squared))


def _horner(coefficients: Sequence[float], x: jax.Array) -> jax.Array:
    """Polynomial in x, |x| <= 1; terms below the dtype's rounding are left out."""
    floor = float(jnp.finfo(x.dtype).eps) / 16 * abs(coefficients[0])
    kept = [c for c in coefficients if abs(c) > floor]
    result = jnp.full_like(x, kept[-1])
    for c in reversed(kept[:-1]):
        result = result * x + c
    return result


def _quaternion(r: jax.Array) -> jax.Array:
    """Unit quaternion [..., 4], real part first and >= 0, of the rotation nearest to a matrix."""
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    wx, wy, wz = (r[..., i, j] - r[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    xy, xz, yz = (r[..., i, j] + r[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    diagonal = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    rows = (
        (diagonal[0], wx, wy, wz),
        (wx, diagonal[1], xy, xz),
        (wy, xy, diagonal[2], yz),
        (wz, xz, yz, diagonal[3]),
    )
    best, column = diagonal[0], rows[0]
    for d, row in zip(diagonal[1:], rows[1:], strict=True):
        better = d > best
        best = jnp.where(better, d, best)
        column = tuple(jnp.where(better, new, old) for new, old in zip(row, column, strict=True))
    # M q0 is parallel to q for every start q0, so the start needs no derivative. The length of
    # M q0 is at least that of the column, at least 1: no division by zero for any matrix.
    start = [jax.lax.stop_gradient(c) for c in column]
    q = jnp.stack([sum(m * c for m, c in zip(row, start, strict=True)) for row in rows], axis=-1)
    q = q / jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True))
    return jnp.where(q[..., :1] < 0, -q, q)


def _identity_plus(w: jax.Array, first: jax.Array, second: jax.Array) -> jax.Array:
    """I + first hat(w) + second hat(w)^2 [..., 3, 3]."""
    # hat(w)^2 has the diagonal -(y^2 + z^2), ...: no cancellation for small angles.
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    xx, yy, zz = second * x * x, second * y * y, second * z * z
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    ax, ay, az = first * x, first * y, first * z
    return _matrix(
        *(1 - (yy + zz), xy - az, xz + ay),
        *(xy + az, 1 - (xx + zz), yz - ax),
        *(xz - ay, yz + ax, 1 - (xx + yy)),
    )


def _matrix(*entries: jax.Array) -> jax.Array:
    """[..., 3, 3] from nine [...] entries, row by row."""
    stacked = jnp.stack(entries, axis=-1)
    return stacked.reshape((*stacked.shape[:-1], 3, 3))
