"""Hands and cables made of capsules, and exact ray casting of these (camera frame, meters)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from caper_jax.synthetic.ray_casting import FAR

_HAND_M = 0.25  # objects with a smaller diagonal are touched by a hand smaller in proportion


class Capsules(NamedTuple):
    """All points within ``radius`` [C] of the segments from ``start`` to ``end`` [C, 3], meters."""

    start: Float[Array, "C 3"]
    end: Float[Array, "C 3"]
    radius: Float[Array, " C"]


def capsule_depth(capsules: Capsules, rays: Sequence[Float[Any, " *R"]]) -> Float[Array, " *R"]:
    """Depth [...] of the nearest capsule along rays (x [...], y [...], 1), ``FAR`` for none.

    Rays enter a capsule through the cylinder, or else through the ball at the nearer end.
    """
    x, y = rays

    def nearest(depth, capsule):
        start, end, radius = capsule
        axis = end - start
        length = jnp.maximum((axis * axis).sum(), 1e-12)
        # Rays begin near the capsule: what is squared below stays small, and so does rounding.
        middle = (start[2] + end[2]) / 2
        from_start = (x * middle - start[0], y * middle - start[1], middle - start[2])
        ray = x * x + y * y + 1.0
        along = axis[0] * x + axis[1] * y + axis[2]
        offset = sum(axis[i] * from_start[i] for i in range(3))
        closing = x * from_start[0] + y * from_start[1] + from_start[2]
        square = sum(value * value for value in from_start) - radius**2
        a = jnp.maximum(length * ray - along**2, 1e-9 * length)
        b = length * closing - offset * along
        root = b * b - a * (length * square - offset**2)
        step = (-b - jnp.sqrt(jnp.maximum(root, 0.0))) / a
        place = offset + step * along
        inner = (root > 0) & (place > 0) & (place < length)

        second = place > 0  # which end
        b = closing - jnp.where(second, along, 0.0)
        square += jnp.where(second, length - 2 * offset, 0.0)
        ball = b * b - ray * square
        step = jnp.where(inner, step, (-b - jnp.sqrt(jnp.maximum(ball, 0.0))) / ray)
        found = middle + step
        found = jnp.where((inner | (ball > 0)) & (found > 0), found, FAR)
        return jnp.minimum(depth, found), None

    return jax.lax.scan(nearest, jnp.full(jnp.shape(x), FAR), capsules)[0]


def hand_scale(diagonal: float | Float[Any, ""]) -> Float[Array, ""]:
    """1, less in proportion for objects with a diagonal below 25 cm."""
    return jnp.minimum(1.0, diagonal / _HAND_M)


def hand_capsules(
    uniform: Float[Any, " 6"],
    touch: Float[Any, " 3"],
    along: Float[Any, " 3"],
    scale: float | Float[Any, ""],
) -> Capsules:
    """A hand of five capsules: up to three fingers, the palm and the forearm.

    Fingers are 15 to 25 mm thick and 50 to 90 mm long, times ``scale``.

    Args:
      uniform: six numbers in [0, 1).
      touch: [3] the point that the tip of the first finger touches.
      along: [3] unit vector from the tip to the knuckle.
      scale: of all lengths but the forearm's, see ``hand_scale``.
    """
    radius = scale * (0.0075 + 0.005 * uniform[0])
    length = scale * (0.05 + 0.04 * uniform[1])
    sight = touch / jnp.linalg.norm(touch)
    side = jnp.cross(along, sight)
    side /= jnp.linalg.norm(side)

    # Fingers that are not there coincide with the first one.
    number = jnp.floor(3 * uniform[2])
    place = 2.2 * radius * jnp.where(jnp.arange(3) <= number, jnp.array([0.0, 1.0, -1.0]), 0.0)
    lag = jnp.where(place == 0, 0.0, 0.3 * length * uniform[3])
    first = touch - radius * sight
    tips = first + place[:, None] * side + lag[:, None] * along
    knuckles = first + place[:, None] * side + length * along
    palm = scale * (0.03 + 0.01 * uniform[4])
    wrist = first + (length + 0.5 * palm) * along, first + (length + 2.5 * palm) * along
    elbow = wrist[1] + jnp.minimum(0.4, 0.4 * touch[2]) * along
    return Capsules(
        jnp.concatenate([tips, jnp.stack(wrist)]),
        jnp.concatenate([knuckles, jnp.stack([wrist[1], elbow])]),
        jnp.stack([radius, radius, radius, palm, (0.7 + 0.2 * uniform[5]) * palm]),
    )


def cable_capsules(
    uniform: Float[Any, " 5"], middle: Float[Any, " 3"], diagonal: float | Float[Any, ""]
) -> Capsules:
    """A cable along a parabola: 3 to 6 capsules (six, the last ones empty), 3 to 8 mm thick.

    Args:
      uniform: five numbers in [0, 1).
      middle: [3] the point in its middle.
      diagonal: of the object at rest, meters; the cable's ends are 1.4 of them apart.
    """
    angle = 2 * jnp.pi * uniform[0]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    along = jnp.stack([cos, sin, 0.6 * uniform[1] - 0.3])
    bend = (0.8 * uniform[2] - 0.4) * jnp.stack([-sin, cos, jnp.zeros(())])
    number = 3.0 + jnp.floor(4 * uniform[3])
    place = (2 * jnp.minimum(jnp.arange(7) / number, 1.0) - 1.0)[:, None]
    points = middle + diagonal * (0.7 * place * along + place**2 * bend)
    return Capsules(points[:-1], points[1:], jnp.full((6,), 0.0015 + 0.0025 * uniform[4]))
