"""Rigid transforms: SE(3) as [..., 4, 4] matrices, se(3) as twists [..., 6].

A twist is xi = (w, rho), rotation first (paper Sec 2): ``exp(xi) = [exp(w) | V(w) rho]`` with V
the left Jacobian of SO(3), so rho is not the translation. Lengths are meters, angles radians.
Everything said in ``so3`` about broadcasting, dtypes, derivatives and products holds here.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from caper_jax.lie import so3
from caper_jax.lie.linalg import (
    apply,
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


def from_rt(rotation: ArrayLike, translation: ArrayLike) -> Float[Array, "... 4 4"]:
    """Transform [..., 4, 4] ``p -> R p + t`` from R [..., 3, 3] and t [..., 3]."""
    r = as_floating(rotation, (3, 3), "rotation")
    t = as_floating(translation, (3,), "translation")
    batch = jnp.broadcast_shapes(r.shape[:-2], t.shape[:-1])
    dtype = jnp.result_type(r, t)
    top = jnp.concatenate(
        [
            jnp.broadcast_to(r, (*batch, 3, 3)).astype(dtype),
            jnp.broadcast_to(t, (*batch, 3)).astype(dtype)[..., None],
        ],
        axis=-1,
    )
    bottom = jnp.broadcast_to(jnp.eye(4, dtype=dtype)[3], (*batch, 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def hat(xi: ArrayLike) -> Float[Array, "... 4 4"]:
    """Matrix [..., 4, 4] of a twist [..., 6]: ``[[hat(w), rho], [0, 0]]``."""
    w, rho = _split(xi)
    top = jnp.concatenate([so3.hat(w), rho[..., None]], axis=-1)
    return jnp.concatenate([top, jnp.zeros_like(top[..., :1, :])], axis=-2)


def vee(matrix: ArrayLike) -> Float[Array, "... 6"]:
    """Twist [..., 6] of ``hat``'s matrix [..., 4, 4]."""
    matrix = as_floating(matrix, (4, 4), "matrix")
    return jnp.concatenate([so3.vee(matrix[..., :3, :3]), matrix[..., :3, 3]], axis=-1)


def exp(xi: ArrayLike) -> Float[Array, "... 4 4"]:
    """Transform [..., 4, 4] of a twist (w, rho) [..., 6]."""
    twist = entries(as_floating(xi, (6,), "xi"))
    w, rho = twist[:3], twist[3:]
    first, second, third = so3.exp_coefficients_of(w)
    along, across = third * dot_of(w, rho), cross_of(w, rho)
    translation = [first * rho[i] + second * across[i] + along * w[i] for i in range(3)]
    zero = jnp.zeros_like(along)
    top = [[*row, t] for row, t in zip(so3.exp_of(w), translation, strict=True)]
    return from_rows([*top, [zero, zero, zero, zero + 1]])


def log(transform: ArrayLike) -> Float[Array, "... 6"]:
    """Twist (w, rho) [..., 6], |w| <= pi, of a transform [..., 4, 4]; see ``so3.log``."""
    top = rows(as_floating(transform, (4, 4), "transform"))[:3]
    t = [row[3] for row in top]
    w, first, second = so3.log_of([row[:3] for row in top])
    along, across = second * dot_of(w, t), cross_of(w, t)
    rho = [first * t[i] - across[i] / 2 + along * w[i] for i in range(3)]
    return from_entries([*w, *rho])


def left_jacobian(xi: ArrayLike) -> Float[Array, "... 6 6"]:
    """[..., 6, 6] J with ``exp(xi + d) = exp(J d) exp(xi)`` to first order.

    ``[[J3, 0], [Q, J3]]`` with J3 the left Jacobian of SO(3) and Q(w, rho) of Barfoot, State
    Estimation for Robotics (2017), eq. 7.86, reordered for rotation first.
    """
    w, rho = _split(xi)
    return _block_lower(so3.left_jacobian(w), _translation_block(w, rho))


def left_jacobian_inverse(xi: ArrayLike) -> Float[Array, "... 6 6"]:
    """[..., 6, 6] inverse of ``left_jacobian``; singular at |w| = 2 pi, 4 pi, ... only."""
    w, rho = _split(xi)
    inverse = so3.left_jacobian_inverse(w)
    block = multiply(multiply(inverse, _translation_block(w, rho)), inverse)
    return _block_lower(inverse, -block)


def compose(a: ArrayLike, b: ArrayLike) -> Float[Array, "... 4 4"]:
    """Transform [..., 4, 4] that applies b first, then a."""
    return multiply(as_floating(a, (4, 4), "a"), as_floating(b, (4, 4), "b"))


def inverse(transform: ArrayLike) -> Float[Array, "... 4 4"]:
    """Inverse [..., 4, 4] of a rigid transform: ``[R^T | -R^T t]``."""
    transform = as_floating(transform, (4, 4), "transform")
    back = transpose(transform[..., :3, :3])
    return from_rt(back, -apply(back, transform[..., :3, 3]))


def act(transform: ArrayLike, points: ArrayLike) -> Float[Array, "... N 3"]:
    """Moved points [..., N, 3]: ``R p + t``.

    Args:
      transform: [..., 4, 4]; its batch axes broadcast against those before N.
      points: [..., N, 3] meters.
    """
    transform = as_floating(transform, (4, 4), "transform")[..., None, :3, :]
    points = as_floating(points, (3,), "points")
    return apply(transform[..., :3], points) + transform[..., 3]


def adjoint(transform: ArrayLike) -> Float[Array, "... 6 6"]:
    """[..., 6, 6] Ad with ``T exp(xi) T^-1 = exp(Ad xi)``: ``[[R, 0], [hat(t) R, R]]``."""
    transform = as_floating(transform, (4, 4), "transform")
    rotation = transform[..., :3, :3]
    return _block_lower(rotation, multiply(so3.hat(transform[..., :3, 3]), rotation))


def geodesic_distance(a: ArrayLike, b: ArrayLike) -> Float[Array, "..."]:
    """Length [...] of the twist ``log(a^-1 b)``, one radian counting as much as one meter.

    Errors are reported as rotation and translation apart (``so3.geodesic_distance``); this is the
    one number for optimization and interpolation. Newton's method near 0 takes ``log`` itself, as
    said in ``so3.angle``.
    """
    return norm(log(compose(inverse(a), b)))


def interpolate(a: ArrayLike, b: ArrayLike, fraction: ArrayLike) -> Float[Array, "... 4 4"]:
    """Screw motion [..., 4, 4] from a (fraction 0) to b (fraction 1).

    Args:
      a: [..., 4, 4].
      b: [..., 4, 4].
      fraction: [...]; values outside [0, 1] extrapolate.
    """
    xi = log(compose(inverse(a), b))
    return compose(a, exp(jnp.asarray(fraction, xi.dtype)[..., None] * xi))


def _split(xi: ArrayLike) -> tuple[jax.Array, jax.Array]:
    xi = as_floating(xi, (6,), "xi")
    return xi[..., :3], xi[..., 3:]


def _block_lower(diagonal: jax.Array, lower: jax.Array) -> jax.Array:
    """[[diagonal, 0], [lower, diagonal]] [..., 6, 6]."""
    top = jnp.concatenate([diagonal, jnp.zeros_like(diagonal)], axis=-1)
    return jnp.concatenate([top, jnp.concatenate([lower, diagonal], axis=-1)], axis=-2)


def _translation_block(w: jax.Array, rho: jax.Array) -> jax.Array:
    """Q(w, rho) [..., 3, 3]: how the translation of ``exp`` answers to a change of w."""
    terms = so3.trigonometry(entries(w))
    small, _, t, squared, sin, cos = terms
    cubic = so3.exp_coefficients(terms)[2]
    quartic = jnp.where(
        small,
        so3.alternating_series(lambda k: 1 / math.factorial(2 * k + 4), terms),
        (squared - 2 * (1 - cos)) / (2 * squared**2),
    )
    quintic = jnp.where(
        small,
        so3.alternating_series(lambda k: (k + 1) / math.factorial(2 * k + 5), terms),
        (2 * t - 3 * sin + t * cos) / (2 * squared**2 * t),
    )
    a, b = so3.hat(w), so3.hat(rho)
    ab, ba = multiply(a, b), multiply(b, a)
    aba = multiply(ab, a)
    aab, baa = multiply(a, ab), multiply(ba, a)
    abaa, aaba = multiply(aba, a), multiply(a, aba)
    return (
        b / 2
        + cubic[..., None, None] * (ab + ba + aba)
        + quartic[..., None, None] * (aab + baa - 3 * aba)
        + quintic[..., None, None] * (abaa + aaba)
    )
