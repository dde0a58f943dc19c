"""Forms that several categories are made of: rotations, solids between two points, chains."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from caper_jax.geometry.solids import Solid, box, cone, cylinder, frustum

Axis = Literal["x", "y", "z"]


def about(axis: Axis, angle: float) -> np.ndarray:
    """[3, 3] right-handed rotation by ``angle`` radians about a coordinate axis."""
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    rotation = np.eye(3)
    rotation[first, first] = rotation[second, second] = np.cos(angle)
    rotation[second, first] = np.sin(angle)
    rotation[first, second] = -np.sin(angle)
    return rotation


def along(direction, up) -> np.ndarray:
    """[3, 3] rotation that takes z to ``direction`` [3] and y as near to ``up`` [3] as that lets.

    The two must not be parallel.
    """
    # Plain numbers: numpy's overhead would be most of the time that an instance takes.
    z = _unit(*map(float, direction))
    u = tuple(map(float, up))
    across = z[0] * u[0] + z[1] * u[1] + z[2] * u[2]
    y = _unit(u[0] - across * z[0], u[1] - across * z[1], u[2] - across * z[2])
    x = (y[1] * z[2] - y[2] * z[1], y[2] * z[0] - y[0] * z[2], y[0] * z[1] - y[1] * z[0])
    return np.array([x, y, z]).T


def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def turned(solid: Solid, rotation: np.ndarray, pivot=(0.0, 0.0, 0.0)) -> Solid:
    """The solid (and its hole) turned by ``rotation`` [3, 3] about ``pivot`` [3]."""
    hole = None if solid.hole is None else turned(solid.hole, rotation, pivot)
    center = rotation @ (solid.center - pivot) + pivot
    return replace(solid, center=center, rotation=rotation @ solid.rotation, hole=hole)


def mirrored(solid: Solid, axis: Axis) -> Solid:
    """The solid (and its hole) reflected in the plane through the origin across ``axis``."""
    hole = None if solid.hole is None else mirrored(solid.hole, axis)
    flip = np.ones(3)
    flip["xyz".index(axis)] = -1.0
    # Every unit solid is symmetric in its own x, which turns the reflection into a rotation.
    rotation = flip[:, None] * solid.rotation * np.array([-1.0, 1.0, 1.0])
    return replace(solid, center=flip * solid.center, rotation=rotation, hole=hole)


def beam(start, end, half, up, taper=None, round_: bool = False) -> Solid:
    """A solid from ``start`` to ``end`` [3], with half width and half height ``half``, meters.

    Args:
      start, end: the middles of its two ends.
      half: half extents of the section at the start, across and towards ``up``.
      up: [3] direction that the section's height is measured along.
      taper: the section at the end relative to that at the start, a number or two; None for 1.
      round_: an elliptic section instead of a rectangular one.
    """
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    way = end - start
    extents = (half[0], half[1], math.sqrt(way @ way) / 2)
    rotation = along(way, up)
    center = (start + end) / 2
    if taper is None:
        return (cylinder if round_ else box)(center, extents, rotation)
    if round_:
        return cone(center, extents, taper, rotation)
    return frustum(center, extents, np.broadcast_to(taper, (2,)), rotation)


def chain(points, half, up, closed: bool = False, round_: bool = False) -> list[Solid]:
    """Beams that join ``points`` [n, 3] one after the other; ``closed`` joins the ends too.

    Each reaches a little beyond its corners, so that no gap shows on the outside of a bend.

    Args:
      half, up, round_: as for ``beam``.
    """
    points = np.asarray(points, np.float64)
    ends = np.roll(points, -1, axis=0) if closed else points[1:]
    solids = []
    for start, end in zip(points[: len(ends)], ends, strict=True):
        way = end - start
        reach = 0.35 * half[0] / math.sqrt(way @ way) * way
        solids.append(beam(start - reach, end + reach, half, up, None, round_))
    return solids
