"""Solids of constructive geometry, their axis-aligned bounds and surfaces; pure numpy data.

A solid is an affine image of one of five unit solids, minus an optional other one, its hole. The
ray caster of ``synthetic`` intersects them exactly.

A hole rarely reaches an outermost point; where it does (a dome is a cylinder whose lower half is
cut away), what remains of the convex solid A without the convex hole B is the union, over the
planes ``n . x <= b`` around B, of the convex pieces of A with ``n . x >= b``. The corners of such a
piece are corners of A and points where an edge of A meets the plane.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Float

from caper_jax.arrays import checked_array
from caper_jax.errors import CaperError

Kind = Literal["box", "cylinder", "ellipsoid", "frustum", "cone"]
TAPERED: tuple[Kind, ...] = ("frustum", "cone")

# Sections of a circle. Of a round solid that is cut, and of a round hole that cuts, bounds are
# right to 3e-4 of its radius; all others are exact.
_SECTIONS = 128
_INSIDE = 1e-9  # of the hole's half extents: what touches its surface is not cut away
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


@dataclass(frozen=True)
class Solid:
    """The image of a unit solid under ``p = center + rotation @ (half * unit)``, minus ``hole``.

    The unit box is [-1, 1]^3; the unit cylinder has radius 1 about z and spans z in [-1, 1]; the
    unit ellipsoid is the ball of radius 1. The unit frustum and cone are box and cylinder whose x
    and y shrink linearly along z, from 1 at z = -1 to ``taper`` at z = 1.

    Attributes:
      kind: "box", "cylinder", "ellipsoid", "frustum" or "cone" (round ones are elliptic when their
        half extents differ).
      center: [3] meters, object rest-canonical frame; the middle of the unit solid's [-1, 1]^3.
      half: [3] half extents, meters.
      rotation: [3, 3].
      hole: a convex solid cut away (its own hole is ignored), or None.
      taper: (x, y) scale of the end at z = 1, each in (0, 1]; equal for a cone, 1 for kinds that
        have none.
    """

    kind: Kind
    center: np.ndarray
    half: np.ndarray
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    hole: Solid | None = None
    taper: tuple[float, float] = (1.0, 1.0)

    def moved(self, offset: np.ndarray) -> Solid:
        """This solid (and its hole) shifted by ``offset`` [3] meters."""
        hole = None if self.hole is None else self.hole.moved(offset)
        return replace(self, center=self.center + offset, hole=hole)

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Exact axis-aligned bounds (low [3], high [3]) of the solid, holes not considered."""
        x, y, z = (self.rotation * self.half).T
        if self.kind == "ellipsoid":
            reach = np.sqrt(x**2 + y**2 + z**2)
            return self.center - reach, self.center + reach
        # The ends at z = -1 and z = 1 reach this far to either side of their own centers.
        if self.kind in ("box", "frustum"):
            start = np.abs(x) + np.abs(y)
            end = np.abs(self.taper[0] * x) + np.abs(self.taper[1] * y)
        else:
            start = np.hypot(x, y)
            end = self.taper[0] * start
        low, high = np.minimum(-z - start, z - end), np.maximum(start - z, z + end)
        return self.center + low, self.center + high

    def corners(self) -> np.ndarray:
        """[8, 3] corners of the oriented box about the solid."""
        return self.center + (_CORNERS * self.half) @ self.rotation.T


def box(center, half, rotation=None, hole: Solid | None = None) -> Solid:
    """A box from its center [3], half extents [3] (meters) and optional rotation [3, 3].

    Raises:
      CaperError: wrong shapes, or half extents that are not positive (as do the other kinds).
    """
    return _solid("box", center, half, rotation, hole)


def cylinder(center, half, rotation=None, hole: Solid | None = None) -> Solid:
    """An elliptic cylinder along its local z; half = (radius x, radius y, half height)."""
    return _solid("cylinder", center, half, rotation, hole)


def ellipsoid(center, half, rotation=None, hole: Solid | None = None) -> Solid:
    """An ellipsoid; half = its three radii."""
    return _solid("ellipsoid", center, half, rotation, hole)


def frustum(center, half, taper, rotation=None, hole: Solid | None = None) -> Solid:
    """A box whose x and y half extents shrink linearly along its local z.

    They are full at z = -half[2] and ``taper`` = (x, y) times that at z = half[2].

    Raises:
      CaperError: as for ``box``, or a taper outside (0, 1].
    """
    return _solid("frustum", center, half, rotation, hole, _tapers("frustum", taper, 2))


def cone(center, half, taper: float, rotation=None, hole: Solid | None = None) -> Solid:
    """An elliptic cylinder whose radii shrink along its local z to ``taper`` times theirs.

    Raises:
      CaperError: as for ``box``, or a taper outside (0, 1].
    """
    return _solid("cone", center, half, rotation, hole, _tapers("cone", taper, 1) * 2)


def _tapers(kind: Kind, taper, count: int) -> tuple[float, ...]:
    values = tuple(float(value) for value in np.ravel(taper))
    if len(values) != count or not all(0.0 < value <= 1.0 for value in values):
        wanted = "one number" if count == 1 else f"{count} numbers"
        raise CaperError(f"{kind}: taper must be {wanted} in (0, 1], got {taper}")
    return values


def _solid(kind: Kind, center, half, rotation, hole, taper=(1.0, 1.0)) -> Solid:
    center, half = np.asarray(center, np.float64), np.asarray(half, np.float64)
    rotation = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    for name, value, shape in (
        ("center", center, (3,)),
        ("half", half, (3,)),
        ("rotation", rotation, (3, 3)),
    ):
        checked_array(f"{kind}: {name}", value, shape)
    if not (half > 0).all():
        raise CaperError(f"{kind}: half extents must be positive, got {half}")
    return Solid(kind, center, half, rotation, hole, taper)


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
    starts, ends = edges.T.copy()
    outside, met = np.zeros(len(points), bool), []
    for normal, offset in zip(*_planes(solid.hole), strict=True):
        height = points @ normal - offset
        beyond = height >= 0
        outside |= beyond
        crossing = beyond[starts] != beyond[ends]
        first, second = starts[crossing], ends[crossing]
        share = height[first] / (height[first] - height[second])
        met.append(points[first] + share[:, None] * (points[second] - points[first]))
    remaining = np.concatenate([points[outside], *met])
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


def surface_points(
    solids: list[Solid], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Points on a union of solids that reach its exact bounds.

    Args:
      solids: one part's.
      count: random points, shared among the solids by the area of their boxes; those that fall in
        a solid's hole are left out.
      rng: draws them.

    Returns:
      [n, 3] meters: the random points, then the outermost ones of every solid.
    """
    areas = np.array([(s.half * np.roll(s.half, 1)).sum() for s in solids])
    clouds = []
    for solid, number in zip(solids, rng.multinomial(count, areas / areas.sum()), strict=True):
        points = _points(solid, _random_unit(solid, number, rng))
        clouds.append(points if solid.hole is None else points[~_inside(solid.hole, points)])
    return np.concatenate([*clouds, *(_outermost(solid) for solid in solids)])


def _outermost(solid: Solid) -> np.ndarray:
    """The points of a solid, its hole cut away, that give its bounds."""
    points = _extremes(solid)
    if solid.hole is None:
        return points
    cut = _inside(solid.hole, points)
    return np.concatenate([points[~cut], corners_after_cut(solid)]) if cut.any() else points


def _random_unit(solid: Solid, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points [count, 3] on the unit solid before it is tapered."""
    if solid.kind == "ellipsoid":
        unit = rng.normal(size=(count, 3))
        return unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    unit = rng.uniform(-1.0, 1.0, (count, 3))
    if solid.kind in ("box", "frustum"):
        half = solid.half
        pair = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
        face = rng.choice(3, count, p=pair / pair.sum())
        unit[np.arange(count), face] = rng.choice((-1.0, 1.0), count)
        return unit
    angle = rng.uniform(0.0, 2 * np.pi, count)
    radius_x, radius_y, height = solid.half
    cap = rng.random(count) < radius_x * radius_y / (
        radius_x * radius_y + height * (radius_x + radius_y)
    )
    radius = np.where(cap, np.sqrt(rng.random(count)), 1.0)
    z = np.where(cap, np.sign(unit[:, 2]), unit[:, 2])
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


def _inside(solid: Solid, points: np.ndarray) -> np.ndarray:
    """[n] bool: strictly inside the solid."""
    unit = (points - solid.center) @ solid.rotation / solid.half
    if solid.kind == "ellipsoid":
        return (unit**2).sum(-1) < 1
    share = np.clip((unit[:, 2:] + 1) / 2, 0, 1)
    flat = unit[:, :2] / (1 + share * (np.array(solid.taper) - 1))
    if solid.kind in ("box", "frustum"):
        return (np.abs(flat).max(-1) < 1) & (np.abs(unit[:, 2]) < 1)
    return ((flat**2).sum(-1) < 1) & (np.abs(unit[:, 2]) < 1)


def _extremes(solid: Solid) -> np.ndarray:
    """Points of the solid without its hole, farthest along and against every coordinate axis."""
    if solid.kind in ("box", "frustum"):
        return _points(solid, _CORNERS)
    # Directions of the coordinate axes in the frame of the unit solid, times its radii.
    reach = solid.rotation * solid.half
    if solid.kind == "ellipsoid":
        unit = reach / np.linalg.norm(reach, axis=-1, keepdims=True)
        return _points(solid, np.concatenate([unit, -unit]))
    flat = reach[:, :2] / np.maximum(np.linalg.norm(reach[:, :2], axis=-1), 1e-12)[:, None]
    flat = np.concatenate([flat, -flat])
    ends = [np.concatenate([flat, np.full((6, 1), z)], axis=-1) for z in (-1.0, 1.0)]
    return _points(solid, np.concatenate(ends))
