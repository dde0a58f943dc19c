"""Rotations: SO(3) as [..., 3, 3] matrices and so(3) as rotation vectors w [..., 3] (radians).

Every function broadcasts over leading axes, follows the dtype of its input and has finite
derivatives, forward and reverse, for every rotation, identity and half turns included.

Three devices keep float32 accurate to its last digits (worst errors 2e-7 in ``exp`` and 4e-7 in
``log``, over all angles):

* the coefficients of Rodrigues' formula, such as (1 - cos t) / t^2, cancel for small angles. They
  are power series in s = t^2 for t < 1 and closed forms above. Being functions of s, they also
  spare the derivative of sqrt at 0;
* ``log`` goes through a quaternion: one column of 4 q q^T, which is linear in the entries of R,
  the longest of the four. It works alike at 0 and at pi;
* where an angle near pi meets its own rounding (1e-7), the rounding is computed and carried along
  (compensated arithmetic: the parts of a number split on a grid of 1/256 multiply exactly).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from caper_jax.lie.linalg import apply as apply
from caper_jax.lie.linalg import (
    as_floating,
    cross_of,
    dot_of,
    entries,
    from_entries,
    from_rows,
    multiply,
    norm,
    rows,
    transpose,
)

# Below this t^2 the power series are used; their terms fall by 1/24 or faster.
_SERIES_BELOW = 1.0
_SERIES_TERMS = 12

# |B_2k| / (2k)!, Bernoulli numbers; each is 1 / (4 pi^2) of the one before.
_BERNOULLI = (
    *(1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160),
    *(691 / 1307674368000, 1 / 74724249600, 3617 / 10670622842880000),
    *(43867 / 5109094217170944000, 174611 / 802857662698291200000),
)

# hat of the unit vectors. Constants and broadcasting compile to one loop, stacked entries to nine.
_GENERATORS = np.array(
    [
        [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ]
)

# An axis and the two after it, in the order of the cross product.
_CYCLES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def hat(w: ArrayLike) -> Float[Array, "... 3 3"]:
    """Skew matrix [..., 3, 3] of a vector [..., 3]: ``hat(w) @ v == cross(w, v)``."""
    w = as_floating(w, (3,), "w")[..., None, None]
    x, y, z = _GENERATORS.astype(w.dtype)
    return w[..., 0, :, :] * x + w[..., 1, :, :] * y + w[..., 2, :, :] * z


def vee(skew: ArrayLike) -> Float[Array, "... 3"]:
    """Vector [..., 3] of a skew matrix [..., 3, 3]; of another matrix, of its skew part."""
    m = as_floating(skew, (3, 3), "skew")
    pairs = ((2, 1), (0, 2), (1, 0))
    return jnp.stack([(m[..., i, j] - m[..., j, i]) / 2 for i, j in pairs], axis=-1)


def exp(w: ArrayLike) -> Float[Array, "... 3 3"]:
    """Rotation matrix [..., 3, 3] of a rotation vector [..., 3] (Rodrigues' formula).

    Args:
      w: [..., 3] axis times angle, radians; any length.
    """
    return from_rows(exp_of(entries(as_floating(w, (3,), "w"))))


@jax.custom_jvp
def exp_of(w: Sequence[jax.Array]) -> list[list[jax.Array]]:
    """``exp`` of the entries [...] of a vector: three rows of three entries."""
    terms = trigonometry(w)
    first, second, _ = exp_coefficients(terms)
    squares = [second * x * x for x in w]
    matrix = _off_diagonal(w, first, second)
    for i, j, k in _CYCLES:
        # The diagonal has two forms. 1 - c (y^2 + z^2) is exact near the identity; for an angle
        # near pi about y or z it takes nearly 2 from 1, where cos t + c x^2 keeps one more bit.
        others = squares[j] + squares[k]
        near = terms.small | (others < squares[i])
        matrix[i][i] = jnp.where(near, 1 - others, terms.cos + squares[i])
    return matrix


@exp_of.defjvp
def _exp_jvp(primals, tangents):
    (w,), (change,) = primals, tangents
    rotation = exp_of(w)
    _, first, second = exp_coefficients(trigonometry(w))
    v = _twice_across(w, change, first, second)
    columns = [cross_of(v, column) for column in _columns(rotation)]
    return rotation, _columns(columns)


def log(rotation: ArrayLike) -> Float[Array, "... 3"]:
    """Rotation vector [..., 3], of length at most pi, of a rotation matrix [..., 3, 3].

    At exactly pi the vector and its negative are the same rotation, and either may be returned.
    Derivatives are right along rotations; of another change, its part along them counts.
    """
    w, _, _ = log_of(rows(as_floating(rotation, (3, 3), "rotation")))
    return from_entries(w)


@jax.custom_jvp
def log_of(
    rotation: Sequence[Sequence[jax.Array]],
) -> tuple[list[jax.Array], jax.Array, jax.Array]:
    """``log`` w of the entries [...] of a matrix, and the ``inverse_coefficients`` of w."""
    real, *vector = _quaternion(rotation)
    squared, parts = _squared_length(vector)
    # w = 2 atan2(|v|, r) v / |v|; for |v| < 0.02 r as a series in (|v| / r)^2.
    small = squared < 4e-4 * real**2
    safe_real = jnp.where(small, real, 1.0)
    tangent_squared = jnp.where(small, squared, 0.0) / safe_real**2
    series = _horner((1.0, -1 / 3, 1 / 5, -1 / 7, 1 / 9), tangent_squared) / safe_real
    length, length_rest = _sqrt(jnp.where(small, 1.0, squared), parts)
    # Beyond a quarter turn pi / 2 - atan2(r, |v|), whose rounding vanishes towards pi.
    beyond = length > real
    acute = jnp.arctan2(jnp.where(beyond, real, length), jnp.where(beyond, length, real))
    quarter = np.asarray(math.pi / 2, real.dtype)
    half = jnp.where(beyond, quarter - acute, acute)
    half_rest = ((quarter - half) - acute) + (math.pi / 2 - float(quarter))
    ratio = half / length
    rest = _minus_product(half, ratio, length) - ratio * length_rest
    rest = jax.lax.stop_gradient((rest + jnp.where(beyond, half_rest, 0.0)) / length)
    ratio, rest = jnp.where(small, series, ratio), jnp.where(small, 0.0, rest)
    w = [2 * (ratio * v + rest * v) for v in vector]
    # (t / 2) cot(t / 2) is t / 2 over |v|, times r.
    first = ratio * real
    small, x, squared = _by_size(dot_of(w, w))
    return w, first, jnp.where(small, _horner(_BERNOULLI, x), (1 - first) / squared)


@log_of.defjvp
def _log_jvp(primals, tangents):
    (rotation,), (change,) = primals, tangents
    w, first, second = log_of(rotation)
    # The skew part of change R^T, as a sum over columns.
    turns = [cross_of(a, b) for a, b in zip(*map(_columns, (rotation, change)), strict=True)]
    turned = [(a + b + c) / 2 for a, b, c in zip(*turns, strict=True)]
    w_change = _twice_across(w, turned, -0.5, second)
    slope = 2 * dot_of(w, w_change)
    first_slope, second_slope = _inverse_coefficient_slopes(w, first, second)
    return (w, first, second), (w_change, first_slope * slope, second_slope * slope)


def _columns(matrix: Sequence[Sequence[jax.Array]]) -> list[list[jax.Array]]:
    """Lists of the entries of the columns, of those of the rows."""
    return [list(column) for column in zip(*matrix, strict=True)]


def _twice_across(w, v, first, second) -> list[jax.Array]:
    """``rodrigues(w, first, second) v``, entry by entry: v + first w x v + second w x (w x v)."""
    once = cross_of(w, v)
    twice = cross_of(w, once)
    return [v[i] + first * once[i] + second * twice[i] for i in range(3)]


def left_jacobian(w: ArrayLike) -> Float[Array, "... 3 3"]:
    """[..., 3, 3] J with ``exp(w + d) = exp(J d) exp(w)`` to first order; V of SE(3) alike."""
    w = as_floating(w, (3,), "w")
    _, first, second = exp_coefficients(trigonometry(entries(w)))
    return rodrigues(w, first, second)


def left_jacobian_inverse(w: ArrayLike) -> Float[Array, "... 3 3"]:
    """[..., 3, 3] inverse of ``left_jacobian``; singular at |w| = 2 pi, 4 pi, ... only."""
    w = as_floating(w, (3,), "w")
    _, second = inverse_coefficients(trigonometry(entries(w)))
    return rodrigues(w, jnp.full_like(second, -0.5), second)


def angle(rotation: ArrayLike) -> Float[Array, "..."]:
    """Rotation angle [...] in [0, pi] radians of [..., 3, 3]; its derivative at 0 is taken as 0.

    2 atan2(|v|, r) of the quaternion (r, v) keeps seven digits in float32 at every angle, where
    arccos of the trace reads 0 for 0.01 deg; so does its derivative. For second derivatives near
    0 take ``log``: the square of an angle whose slope is taken as 0 has no curvature there.
    """
    real, *vector = _quaternion(rows(as_floating(rotation, (3, 3), "rotation")))
    return 2 * jnp.arctan2(norm(from_entries(vector)), real)


def geodesic_distance(rotation_a: ArrayLike, rotation_b: ArrayLike) -> Float[Array, "..."]:
    """Angle [...] in radians of the rotation that takes one [..., 3, 3] to the other."""
    a = as_floating(rotation_a, (3, 3), "rotation_a")
    b = as_floating(rotation_b, (3, 3), "rotation_b")
    return angle(multiply(transpose(a), b))


def interpolate(
    rotation_a: ArrayLike, rotation_b: ArrayLike, fraction: ArrayLike
) -> Float[Array, "... 3 3"]:
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


class Trigonometry(NamedTuple):
    """The angle t = |w| as the coefficients of ``exp`` and its kin need it, all [...].

    Small angles take power series in t^2, others closed forms. Both are evaluated and both are
    differentiated, so each gets a harmless angle where it is not meant.

    Attributes:
      small: whether the series apply.
      series: t^2 for the series; 0 where not ``small``.
      t, squared, sin, cos: t, t^2, sin t and cos t for the closed forms; of 1 where ``small``.
    """

    small: jax.Array
    series: jax.Array
    t: jax.Array
    squared: jax.Array
    sin: jax.Array
    cos: jax.Array


def trigonometry(w: Sequence[jax.Array]) -> Trigonometry:
    """Angle, sine and cosine of a rotation vector, given entry by entry."""
    squared, parts = _squared_length(w)
    small, series, squared = _by_size(squared)
    t, rest = _sqrt(squared, parts)
    rest = jnp.where(small, 0.0, rest)
    sin, cos = jnp.sin(t), jnp.cos(t)
    return Trigonometry(small, series, t, squared, sin + cos * rest, cos - sin * rest)


def _by_size(squared: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Whether t^2 [...] is for a series; what the series takes, and what closed forms take.

    Each is a harmless number where it is not used, so that no derivative meets 0 / 0.
    """
    small = squared < _SERIES_BELOW
    return small, jnp.where(small, squared, 0.0), jnp.where(small, 1.0, squared)


def exp_coefficients(terms: Trigonometry) -> tuple[jax.Array, jax.Array, jax.Array]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3, each [...]."""
    small, _, t, squared, sin, cos = terms

    def series(n: int) -> jax.Array:
        return alternating_series(lambda k: 1 / math.factorial(2 * k + n), terms)

    return (
        jnp.where(small, series(1), sin / t),
        jnp.where(small, series(2), (1 - cos) / squared),
        jnp.where(small, series(3), (t - sin) / (squared * t)),
    )


@jax.custom_jvp
def exp_coefficients_of(w: Sequence[jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
    """``exp_coefficients`` of entries [...], whose derivatives are again such coefficients."""
    return exp_coefficients(trigonometry(w))


@exp_coefficients_of.defjvp
def _exp_coefficients_jvp(primals, tangents):
    # With a = (1 - cos t) / s and so on, s = t^2, each is 1 / n! - s times the one after the next.
    (w,), (change,) = primals, tangents
    terms = trigonometry(w)
    first, second, third = exp_coefficients(terms)

    def after(n: int, before: jax.Array) -> jax.Array:
        series = alternating_series(lambda k: 1 / math.factorial(2 * k + n + 2), terms)
        return jnp.where(terms.small, series, (1 / math.factorial(n) - before) / terms.squared)

    fourth, fifth = after(2, second), after(3, third)
    slope = dot_of(w, change)
    changes = ((third - second) * slope, (2 * fourth - third) * slope, (3 * fifth - fourth) * slope)
    return (first, second, third), changes


def inverse_coefficients(terms: Trigonometry) -> tuple[jax.Array, jax.Array]:
    """c = (t / 2) cot(t / 2) and (1 - c) / t^2, each [...]."""
    small, x, t, squared, sin, cos = terms
    series = _horner(_BERNOULLI, x)
    first = jnp.where(small, 1 - x * series, t * sin / (2 * (1 - cos)))
    return first, jnp.where(small, series, (1 - first) / squared)


def _inverse_coefficient_slopes(
    w: Sequence[jax.Array], first: jax.Array, second: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Derivatives [...] of ``inverse_coefficients`` by t^2."""
    small, x, squared = _by_size(dot_of(w, w))
    slope_first = (first * second - 0.25) / 2
    weighted = [k * c for k, c in enumerate(_BERNOULLI)][1:]
    closed = -(slope_first + second) / squared
    return slope_first, jnp.where(small, _horner(weighted, x), closed)


def rodrigues(vector: jax.Array, first: jax.Array, second: jax.Array) -> Float[Array, "... 3 3"]:
    """``I + first hat(v) + second hat(v)^2`` [..., 3, 3] of v [..., 3] and two scalars [...]."""
    v = entries(vector)
    matrix = _off_diagonal(v, first, second)
    for i, j, k in _CYCLES:
        # hat(v)^2 has the diagonal -(y^2 + z^2), ...: no cancellation for small angles.
        matrix[i][i] = 1 - second * (v[j] * v[j] + v[k] * v[k])
    return from_rows(matrix)


def alternating_series(coefficient: Callable[[int], float], terms: Trigonometry) -> jax.Array:
    """``sum_k (-1)^k coefficient(k) t^2k`` for small angles."""
    return _horner([(-1) ** k * coefficient(k) for k in range(_SERIES_TERMS)], terms.series)


def _squared_length(v: Sequence[jax.Array]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """|v|^2 [...] of three entries, rounded, and as an unrounded sum of two parts."""
    coarse, fine = zip(*(_split(x) for x in v), strict=True)
    parts = (
        coarse[0] ** 2 + coarse[1] ** 2 + coarse[2] ** 2,
        sum((2 * c + f) * f for c, f in zip(coarse, fine, strict=True)),
    )
    return parts[0] + parts[1], parts


def _sqrt(x: jax.Array, parts: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """sqrt(x), rounded, and the rest to the root of the unrounded x = parts[0] + parts[1]."""
    root = jnp.sqrt(x)
    missing = _minus_product(parts[0], root, root) + parts[1]
    return root, jax.lax.stop_gradient(missing / (2 * root))


def _minus_product(x: jax.Array, a: jax.Array, b: jax.Array) -> jax.Array:
    """x - a b for x near a b, without the rounding of a b."""
    (a_coarse, a_fine), (b_coarse, b_fine) = _split(a), _split(b)
    return ((x - a_coarse * b_coarse) - a_coarse * b_fine) - a_fine * b


def _split(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """x as a multiple of 1/256 and the rest; products of multiples below 16 are exact."""
    coarse = jnp.round(x * 256) / 256
    return coarse, x - coarse


def _horner(coefficients: Sequence[float], x: jax.Array) -> jax.Array:
    """Polynomial in x, |x| <= 1; terms below the dtype's rounding are left out."""
    floor = float(jnp.finfo(x.dtype).eps) / 16 * abs(coefficients[0])
    kept = [c for c in coefficients if abs(c) > floor]
    result = jnp.full_like(x, kept[-1])
    for c in reversed(kept[:-1]):
        result = result * x + c
    return result


def _quaternion(r: Sequence[Sequence[jax.Array]]) -> list[jax.Array]:
    """Quaternion, of length 2 to 4, real part first and >= 0, of the entries of a rotation."""
    xx, yy, zz = r[0][0], r[1][1], r[2][2]
    wx, wy, wz = (r[i][j] - r[j][i] for i, j in ((2, 1), (0, 2), (1, 0)))
    xy, xz, yz = (r[i][j] + r[j][i] for i, j in ((0, 1), (0, 2), (1, 2)))
    diagonal = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    columns = (
        (diagonal[0], wx, wy, wz),
        (wx, diagonal[1], xy, xz),
        (wy, xy, diagonal[2], yz),
        (wz, xz, yz, diagonal[3]),
    )
    best, q = diagonal[0], list(columns[0])
    for d, column in zip(diagonal[1:], columns[1:], strict=True):
        better = d > best
        best = jnp.where(better, d, best)
        q = [jnp.where(better, new, old) for new, old in zip(column, q, strict=True)]
    return [jnp.where(q[0] < 0, -x, x) for x in q]


def _off_diagonal(
    v: Sequence[jax.Array], first: jax.Array, second: jax.Array
) -> list[list[jax.Array]]:
    """Rows of ``first hat(v) + second v v^T``."""
    scaled, outer = [first * x for x in v], [second * x for x in v]
    matrix = [[a * x for x in v] for a in outer]
    for i, j, k in _CYCLES:
        matrix[j][k] = matrix[j][k] - scaled[i]
        matrix[k][j] = matrix[k][j] + scaled[i]
    return matrix
