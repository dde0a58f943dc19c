"""Solids of constructive geometry: affine images of a unit box or cylinder, minus an optional one.

Pure numpy data; the ray caster (data/synthetic/caster.py) intersects them exactly.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

Kind = Literal["box", "cylinder"]


@dataclass(frozen=True)
class Solid:
    """The image of a unit solid under ``p = center + rotation @ (half * unit)``, minus ``hole``.

    The unit box is [-1, 1]^3; the unit cylinder has radius 1 about z and spans z in [-1, 1].

    Attributes:
      kind: "box" or "cylinder" (elliptic when half[0] != half[1]).
      center: [3] metres, object rest-canonical frame.
      half: [3] half extents, metres.
      rotation: [3, 3].
      hole: a convex solid cut away (its own hole is ignored), or None.
    """

    kind: Kind
    center: np.ndarray
    half: np.ndarray
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    hole: Solid | None = None

    def moved(self, offset: np.ndarray) -> Solid:
        """This solid (and its hole) shifted by ``offset`` [3] metres."""
        hole = None if self.hole is None else self.hole.moved(offset)
        return replace(self, center=self.center + offset, hole=hole)

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Exact axis-aligned bounds (low [3], high [3]) of the solid, holes not considered."""
        axes = self.rotation * self.half
        if self.kind == "box":
            reach = np.abs(axes).sum(axis=1)
        else:
            reach = np.hypot(axes[:, 0], axes[:, 1]) + np.abs(axes[:, 2])
        return self.center - reach, self.center + reach

    def corners(self) -> np.ndarray:
        """[8, 3] corners of the solid's own oriented box."""
        unit = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        return self.center + (unit * self.half) @ self.rotation.T


def box(center, half, rotation=None, hole: Solid | None = None) -> Solid:
    """A box from its centre [3], half extents [3] (metres) and optional rotation [3, 3]."""
    return _solid("box", center, half, rotation, hole)


def cylinder(center, half, rotation=None, hole: Solid | None = None) -> Solid:
    """An elliptic cylinder along its local z; half = (radius x, radius y, half height)."""
    return _solid("cylinder", center, half, rotation, hole)


def _solid(kind: Kind, center, half, rotation, hole) -> Solid:
    return Solid(
        kind,
        np.asarray(center, np.float64),
        np.asarray(half, np.float64),
        np.eye(3) if rotation is None else np.asarray(rotation, np.float64),
        hole,
    )


def bounds(solids: list[Solid]) -> tuple[np.ndarray, np.ndarray]:
    """Axis-aligned bounds (low [3], high [3]) of a union of solids."""
    low, high = zip(*(solid.extent() for solid in solids), strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)
