"""Axis-aligned bounds of solids with holes.

A hole rarely reaches an outermost point; where it does (a dome is a cylinder whose lower half is
cut away), what remains of the convex solid A without the convex hole B is the union, over the
planes ``n . x <= b`` around B, of the convex pieces of A with ``n . x >= b``. The corners of such a
piece are corners of A and points where an edge of A meets the plane.
"""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np

from caper_jax.errors import CaperError
from caper_jax.geometry.solids import Solid

# Sections of a circle. Of a round solid that is cut, and of a round hole that cuts, bounds are
# right to 3e-4 of its radius; all others are exact.
_SECTIONS = 128
_INSIDE = 1e-9  # of the hole's half extents: what touches its surface is not cut away
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def bounds(solids: list[Solid]) -> tuple[np.ndarray, np.ndarray]:
    """Axis-aligned bounds (low [3], high [3]) of a union of solids, without what holes cut away.

    Raises:
      CaperError: a hole swallows its whole solid.
    """
    low, high = zip(*(_remaining(solid) for solid in solids), strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)


def _remaining(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    low, high = solid.extent()
    if solid.hole is None:
        return low, high
    hit = [[_reached(solid, sign * axis) for axis in np.eye(3)] for sign in (-1, 1)]
    if not np.all(hit):
        points = corners_after_cut(solid)
        low = np.where(hit[0], low, points.min(axis=0))
        high = np.where(hit[1], high, points.max(axis=0))
    return low, high


def _reached(solid: Solid, direction: np.ndarray) -> bool:
    """Whether some outermost point in a direction [3] lies outside of the hole."""
    x, y, z = along = solid.rotation.T @ direction * solid.half
    if solid.kind == "ellipsoid":
        unit = (along / np.linalg.norm(along))[None]
    elif solid.kind in ("box", "frustum"):
        unit = _CORNERS
    elif np.hypot(x, y) > 1e-9 * np.linalg.norm(along):
        unit = np.array([[x, y, 0.0], [x, y, 0.0]]) / np.hypot(x, y) + [[0, 0, -1], [0, 0, 1]]
    else:  # the end of a cylinder or cone: a hole that spares some of it spares some of its rim
        unit = _ring(np.sign(z))
    points = _points(solid, unit)
    reach = points @ direction
    outermost = points[reach >= reach.max() - 1e-9 * solid.half.max()]
    assert solid.hole is not None
    normals, offsets = _planes(solid.hole)
    return bool((outermost @ normals.T - offsets > -_INSIDE * solid.hole.half.min()).any())


def corners_after_cut(solid: Solid) -> np.ndarray:
    """Corners [n, 3] (meters) of the pieces of a solid that its hole leaves.

    Raises:
      CaperError: the hole swallows the whole solid.
    """
    unit, edges = _polytope(solid.kind)
    points = _points(solid, unit)
    assert solid.hole is not None
    kept = []
    for normal, offset in zip(*_planes(solid.hole), strict=True):
        height = points @ normal - offset
        kept.append(points[height >= 0])
        first, second = edges[(height[edges] >= 0).sum(axis=1) == 1].T
        share = height[first] / (height[first] - height[second])
        kept.append(points[first] + share[:, None] * (points[second] - points[first]))
    remaining = np.concatenate(kept)
    if not len(remaining):
        raise CaperError(f"the hole of a {solid.kind} at {solid.center} swallows all of it")
    return remaining


def _points(solid: Solid, unit: np.ndarray) -> np.ndarray:
    """Points [n, 3] of the unit solid before it is tapered, in the object's frame, meters."""
    scale = 1 + (unit[:, 2:] + 1) / 2 * (np.array(solid.taper) - 1)
    local = np.concatenate([unit[:, :2] * scale, unit[:, 2:]], axis=1)
    return solid.center + (local * solid.half) @ solid.rotation.T


def _planes(hole: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [m, 3] and offsets [m] of planes around a hole, ``n . x <= b``; meters."""
    if hole.kind == "ellipsoid":
        unit = gradient = _sphere()[0]
    else:
        if hole.kind in ("box", "frustum"):
            sides = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
            taper = np.repeat(hole.taper, 2)
        else:
            sides, taper = _ring(0.0), np.full(_SECTIONS, hole.taper[0])
        # The sides lean by the taper: s . (x, y) <= 1 - (1 - taper) (z + 1) / 2.
        lean = (1 - taper) / 2
        gradient = np.concatenate([sides + lean[:, None] * [0, 0, 1], [[0, 0, 1], [0, 0, -1]]])
        # A point of each plane: the middle of the side at z = -1, the middles of the ends.
        unit = np.concatenate([sides - [0, 0, 1], [[0, 0, 1], [0, 0, -1]]])
    normals = (gradient / hole.half) @ hole.rotation.T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles = hole.center + (unit * hole.half) @ hole.rotation.T
    return normals, (normals * middles).sum(axis=1)


def _ring(z: float) -> np.ndarray:
    angle = np.arange(_SECTIONS) * 2 * np.pi / _SECTIONS
    return np.stack([np.cos(angle), np.sin(angle), np.full(_SECTIONS, z)], axis=1)


@cache
def _polytope(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Corners [n, 3] and edges [m, 2] of a unit solid before it is tapered; round ones are cut."""
    if kind in ("box", "frustum"):
        pairs = itertools.combinations(range(8), 2)
        return _CORNERS, np.array(
            [(a, b) for a, b in pairs if (_CORNERS[a] != _CORNERS[b]).sum() == 1]
        )
    if kind == "ellipsoid":
        return _sphere()
    index = np.arange(_SECTIONS)
    around = np.stack([index, np.roll(index, -1)], axis=1)
    edges = [around, around + _SECTIONS, np.stack([index, index + _SECTIONS], axis=1)]
    return np.concatenate([_ring(-1.0), _ring(1.0)]), np.concatenate(edges)


@cache
def _sphere() -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] and edges [m, 2] of a globe's grid."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, _SECTIONS // 2 + 1)
    ring = _ring(0.0)[:, :2]
    circles = np.cos(latitude)[:, None, None] * ring
    height = np.broadcast_to(np.sin(latitude)[:, None, None], (*circles.shape[:2], 1))
    points = np.concatenate([circles, height], axis=2).reshape(-1, 3)
    index = np.arange(len(points)).reshape(len(latitude), _SECTIONS)
    along = np.stack([index, np.roll(index, -1, axis=1)], axis=2).reshape(-1, 2)
    up = np.stack([index[:-1], index[1:]], axis=2).reshape(-1, 2)
    return points, np.concatenate([along, up])
