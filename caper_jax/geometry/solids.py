"""Solids of constructive geometry: affine images of five unit solids, minus an optional other one.

Pure numpy data; the ray caster (data/synthetic/caster.py) intersects them exactly.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from caper_jax.errors import CaperError

Kind = Literal["box", "cylinder", "ellipsoid", "frustum", "cone"]
TAPERED: tuple[Kind, ...] = ("frustum", "cone")


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
        unit = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        return self.center + (unit * self.half) @ self.rotation.T


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
        if value.shape != shape or not np.isfinite(value).all():
            raise CaperError(f"{kind}: {name} must be finite numbers of shape {shape}, got {value}")
    if not (half > 0).all():
        raise CaperError(f"{kind}: half extents must be positive, got {half}")
    return Solid(kind, center, half, rotation, hole, taper)
