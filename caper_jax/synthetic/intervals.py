"""Where rays enter and leave convex solids, in inverse depth.

A ray is ``depth * (x, y, 1)``. In inverse depth w = 1 / depth the intersections cost least: a plane
n . p = a (camera frame) is met at w = n . (x, y, 1) / a, linear in (x, y); a quadric is met at the
roots of c w^2 + 2 b w + a = 0, and c is the same for all rays. A convex solid is the interval
far < w < near: near is the least w of the planes that have the camera outside, far the largest of
the others.

Two steps for each kind of solid. ``SURFACE[kind](frame)`` prepares what is the same for all rays,
of S solids at once, and tells [S] whether the camera is outside. ``INTERVAL[kind](surface, rays)``
takes one of them and gives near and far [R].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from caper_jax.geometry.solids import Kind

LIMIT = 1e9  # an inverse depth that no surface reaches
_TINY = 1e-30


def matvec(
    matrix: Float[Array, "*#batch 3 3"], vector: Float[Array, "*#batch 3"]
) -> Float[Array, " ..."]:
    """[..., 3, 3] @ [..., 3] elementwise: exact in float32 on every backend (no TF32)."""
    return (matrix * vector[..., None, :]).sum(-1)


def larger(a: Float[Any, " ..."] | float, b: Float[Any, " ..."] | float) -> Float[Array, " ..."]:
    """jnp.maximum without its care for NaN, which makes the caster half as slow again on a CPU."""
    return jnp.where(a > b, a, b)


def smaller(a: Float[Any, " ..."] | float, b: Float[Any, " ..."] | float) -> Float[Array, " ..."]:
    return jnp.where(a < b, a, b)


def _not_zero(value):
    return jnp.where(jnp.abs(value) < _TINY, _TINY, value)


def at(tree, index):
    """Entry ``index`` of every array."""
    return jax.tree.map(lambda values: values[index], tree)


def _rate(form, rays):
    """form . (x, y, 1) of each ray, [R]; elementwise for the same reason as ``matvec``."""
    return form[0] * rays[0] + form[1] * rays[1] + form[2]


class SolidFrame(NamedTuple):
    """S unit solids as the camera sees them.

    Attributes:
      turn: [S, 3, 3] directions (x, y, 1) -> unit frame.
      origin: [S, 3] the camera in the unit frame.
      width: [S, 2] half widths (x, y) of the unit solid at the camera's z.
      slope: [S, 2] their change per unit of z.
    """

    turn: Float[Array, "*S 3 3"]
    origin: Float[Array, "*S 3"]
    width: Float[Array, "*S 2"]
    slope: Float[Array, "*S 2"]


def camera_frame(
    to_unit: Float[Array, "S 3 3"],
    center: Float[Array, "S 3"],
    taper: Float[Array, "S 2"] | None,
    poses: Float[Any, "S 4 4"],
) -> SolidFrame:
    """The frame of S solids; arguments as of ``SolidGroup``, poses [S, 4, 4] rest -> camera."""
    rotation, translation = poses[..., :3, :3], poses[..., :3, 3]
    # to_unit @ rotation.T, elementwise.
    turn = (to_unit[..., :, None, :] * rotation[..., None, :, :]).sum(-1)
    origin = -matvec(turn, translation + matvec(rotation, center))
    taper = jnp.ones_like(origin[..., :2]) if taper is None else taper
    slope = 0.5 * (taper - 1.0)
    return SolidFrame(turn, origin, 0.5 * (taper + 1.0) + slope * origin[..., 2:], slope)


class _Slab(NamedTuple):
    """What lies between the planes -1 and 1 of an axis; each field [...], the same for all rays.

    Of the rate d of a ray along the axis: near = enter * d + open, far = max(leave * d, other * d).
    The camera is outside of one plane at most; when of none, near has no limit.
    """

    enter: Any
    open: Any
    leave: Any
    other: Any


def _slab(origin) -> _Slab:
    above, below = origin > 1.0, origin < -1.0
    upper, lower = 1.0 / _not_zero(1.0 - origin), -1.0 / _not_zero(1.0 + origin)
    return _Slab(
        enter=jnp.where(above, upper, jnp.where(below, lower, 0.0)),
        open=jnp.where(above | below, 0.0, LIMIT),
        leave=jnp.where(above, lower, upper),
        other=jnp.where(below, upper, lower),
    )


def _between(slab: _Slab, rate):
    """Near and far of a slab."""
    return slab.enter * rate + slab.open, larger(slab.leave * rate, slab.other * rate)


class _Sides(NamedTuple):
    """The four slanted planes of a frustum: w = form . (x, y, 1).

    Attributes:
      form: [..., 4, 3].
      limit: [..., 4] a bound that makes a plane count for far only when the camera is inside of it,
        for near only when outside.
    """

    form: Any
    limit: Any


def _sides(frame: SolidFrame) -> _Sides:
    forms, margins = [], []
    for axis in (0, 1):
        fall = frame.slope[..., axis, None] * frame.turn[..., 2, :]
        for side in (1.0, -1.0):
            forms.append(side * frame.turn[..., axis, :] - fall)
            margins.append(frame.width[..., axis] - side * frame.origin[..., axis])
    margin = jnp.stack(margins, -1)
    limit = jnp.where(margin < 0, -LIMIT, LIMIT)
    return _Sides(jnp.stack(forms, -2) / _not_zero(margin)[..., None], limit)


def _roots(inverse, a, b, discriminant):
    """The roots of c w^2 + 2 b w + a, without cancellation; inverse = 1 / c.

    Of the two crossings, the first is where the ray goes in when b < 0, the second when b > 0.
    """
    q = jnp.abs(b) + jnp.sqrt(larger(discriminant, _TINY))
    q = jnp.where(b < 0, q, -q)
    return q * inverse, a / q


class _Round(NamedTuple):
    """A round side, circle or ball; each field [...], the same for all rays.

    Attributes:
      inverse: 1 / c, c = |origin|^2 - 1.
      open: a lower bound of near: none when the camera is inside.
    """

    inverse: Any
    open: Any


def _round(origin) -> _Round:
    c = (origin**2).sum(-1) - 1.0
    return _Round(1.0 / _not_zero(c), jnp.where(c > 0, -LIMIT, LIMIT))


def _within(round_: _Round, a, b, discriminant):
    """Near and far of a round side."""
    one, other = _roots(round_.inverse, a, b, discriminant)
    # Pointing away from the side (b > 0), a ray only leaves it, or misses it with near < 0.
    near = jnp.where(discriminant > 0, larger(one, round_.open), -LIMIT)
    return near, jnp.where(b < 0, other, one)


def _box_surface(frame: SolidFrame):
    slab = _slab(frame.origin)
    return (frame.turn, slab), (slab.open == 0).any(-1)


def _box_interval(surface, rays):
    turn, slab = surface
    spans = [_between(at(slab, axis), _rate(turn[axis], rays)) for axis in range(3)]
    (near, far), *others = spans
    for enter, leave in others:
        near, far = smaller(near, enter), larger(far, leave)
    return near, far


def _frustum_surface(frame: SolidFrame):
    slab, sides = _slab(frame.origin[..., 2]), _sides(frame)
    return (frame.turn[..., 2, :], slab, sides), (slab.open == 0) | (sides.limit < 0).any(-1)


def _frustum_interval(surface, rays):
    turn, slab, sides = surface
    near, far = _between(slab, _rate(turn, rays))
    for side in range(4):
        crossing = _rate(sides.form[side], rays)
        near = smaller(near, larger(crossing, sides.limit[side]))
        far = larger(far, smaller(crossing, sides.limit[side]))
    return near, far


def _cylinder_surface(frame: SolidFrame):
    slab, round_ = _slab(frame.origin[..., 2]), _round(frame.origin[..., :2])
    return (frame.turn, frame.origin, slab, round_), (slab.open == 0) | (round_.open < 0)


def _cylinder_interval(surface, rays):
    turn, origin, slab, round_ = surface
    u, v, w = (_rate(row, rays) for row in turn)
    near, far = _between(slab, w)
    a = u * u + v * v
    # Distance of the axis from the ray, by the cross product: the usual b^2 - ac cancels in
    # float32 when the unit solid is small against the distance.
    cross = origin[0] * v - origin[1] * u
    enter, leave = _within(round_, a, origin[0] * u + origin[1] * v, a - cross * cross)
    return smaller(near, enter), larger(far, leave)


def _ellipsoid_surface(frame: SolidFrame):
    round_ = _round(frame.origin)
    return (frame.turn, frame.origin, round_), round_.open < 0


def _ellipsoid_interval(surface, rays):
    turn, (x, y, z), round_ = surface
    u, v, w = (_rate(row, rays) for row in turn)
    a = u * u + v * v + w * w
    crosses = (x * v - y * u, y * w - z * v, z * u - x * w)
    discriminant = a - sum(cross * cross for cross in crosses)
    return _within(round_, a, x * u + y * v + z * w, discriminant)


def _cone_surface(frame: SolidFrame):
    origin, width = frame.origin, frame.width[..., 0]
    slab = _slab(origin[..., 2])
    c = origin[..., 0] ** 2 + origin[..., 1] ** 2 - width**2
    # The camera may be inside the cone, or inside the cone's other half beyond its tip.
    inside, beyond = (c <= 0) & (width > 0), (c <= 0) & (width <= 0)
    enter, leave = jnp.where(inside, LIMIT, -LIMIT), jnp.where(beyond, -LIMIT, LIMIT)
    side = (1.0 / _not_zero(c), enter, leave)
    return (frame.turn, origin, width, frame.slope[..., 0], slab, side), (slab.open == 0) | ~inside


def _cone_interval(surface, rays):
    turn, origin, width, slope, slab, (inverse, least, most) = surface
    u, v, w = (_rate(row, rays) for row in turn)
    near, far = _between(slab, w)
    widening = slope * w
    a = u * u + v * v - widening * widening
    b = origin[0] * u + origin[1] * v - width * widening
    # b^2 - ac as a sum of squares of cross products, as for the cylinder.
    cross = origin[0] * v - origin[1] * u
    first, second = width * u - origin[0] * widening, width * v - origin[1] * widening
    discriminant = first * first + second * second - cross * cross
    # Steeper than the side, a ray always crosses it: less than zero is rounding.
    discriminant = jnp.where(a < 0, jnp.abs(discriminant) + _TINY, discriminant)
    one, other = _roots(inverse, a, b, discriminant)
    enter = larger(jnp.where(b < 0, one, other), least)
    leave = smaller(jnp.where(b < 0, other, one), most)
    return smaller(near, jnp.where(discriminant > 0, enter, -LIMIT)), larger(far, leave)


SURFACE: dict[Kind, Callable] = {
    "box": _box_surface,
    "cylinder": _cylinder_surface,
    "ellipsoid": _ellipsoid_surface,
    "frustum": _frustum_surface,
    "cone": _cone_surface,
}
INTERVAL: dict[Kind, Callable] = {
    "box": _box_interval,
    "cylinder": _cylinder_interval,
    "ellipsoid": _ellipsoid_interval,
    "frustum": _frustum_interval,
    "cone": _cone_interval,
}
