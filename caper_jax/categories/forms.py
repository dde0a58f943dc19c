"""What several categories are made of: rotations, beams, chains, handles and stands.

Meters, y up; handles sit on fronts that face +z.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from caper_jax.geometry.solids import Solid, box, cone, cylinder, ellipsoid, frustum

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


def rotated(solid: Solid, rotation: np.ndarray, pivot=(0.0, 0.0, 0.0)) -> Solid:
    """The solid (and its hole) rotated by ``rotation`` [3, 3] about ``pivot`` [3]."""
    hole = None if solid.hole is None else rotated(solid.hole, rotation, pivot)
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


def open_box(center, half, wall: float, floor: float) -> Solid:
    """A box without a top, meters; one without a bottom where ``floor`` is negative."""
    center, half = np.asarray(center, np.float64), np.asarray(half, np.float64)
    return box(center, half, hole=box(center + (0, floor, 0), half - (wall, 0, wall)))


def chain(points, half, up, closed: bool = False, round_: bool = False) -> Iterator[Solid]:
    """Beams that join ``points`` [n, 3] one after the other; ``closed`` joins the ends too.

    Each reaches a little beyond its corners, so that no gap shows on the outside of a bend.

    Args:
      half, up, round_: as for ``beam``.
    """
    points = np.asarray(points, np.float64)
    ends = np.roll(points, -1, axis=0) if closed else points[1:]
    for start, end in zip(points[: len(ends)], ends, strict=True):
        way = end - start
        reach = 0.35 * half[0] / math.sqrt(way @ way) * way
        yield beam(start - reach, end + reach, half, up, None, round_)


UP = (0.0, 1.0, 0.0)
TURN_X = about("y", np.pi / 2)  # takes the axis of a cylinder from z to x
TURN_Y = about("x", -np.pi / 2)  # and from z to y
UPSIDE_DOWN = about("x", np.pi / 2)  # takes z to -y: tapers downwards

HandleStyle = Literal["none", "rod", "staple", "knob", "ball", "cup", "lip", "tag"]


@dataclass(frozen=True)
class Handle:
    """A handle, drawn once for an object and then mounted on each of its fronts.

    Attributes:
      style: "rod" is a round bar on two posts, "staple" a square one of one piece, "knob" a disc
        on a stem, "ball" an ellipsoid, "cup" a shell to reach under, "lip" an edge as wide as the
        front, "tag" a rod with a frame for a label above it.
      share: length over the front's width.
      reach: how far it stands out of the front.
      half: half its thickness; of knobs the radius.
      pair: two of it side by side on a front that is wide enough.
      inset: the posts' distance from the ends of a rod, as a share of its length.
    """

    style: HandleStyle
    share: float
    reach: float
    half: float
    pair: bool = False
    inset: float = 0.1

    @staticmethod
    def draw(rng: np.random.Generator, style: HandleStyle, scale: float, wide: bool) -> Handle:
        """A handle of real size times ``scale`` (1 for furniture, less for desktop boxes).

        On ``wide`` fronts knobs may come in pairs.
        """
        if style in ("knob", "ball"):
            half, reach = rng.uniform(0.011, 0.021), rng.uniform(0.018, 0.034)
        elif style == "cup":
            half, reach = rng.uniform(0.013, 0.022), rng.uniform(0.015, 0.027)
        else:
            half, reach = rng.uniform(0.004, 0.009), rng.uniform(0.02, 0.048)
        long = rng.random() < 0.35
        return Handle(
            style,
            share=rng.uniform(0.5, 0.92) if long else rng.uniform(0.18, 0.5),
            reach=scale * reach,
            half=scale * half,
            pair=wide and rng.random() < 0.5,
            inset=rng.uniform(0.02, 0.14),
        )

    def on(self, center, width: float, height: float) -> Iterator[Solid]:
        """The solids, at most four and mostly one or two, on a front [width, height].

        Args:
          center: [3] where the handle's middle touches the front.
        """
        x, y, z = center
        half = min(self.half, 0.4 * height)
        if self.style == "lip":
            half = min(half, 0.1 * height)
            yield box((x, y, z + 0.35 * self.reach), (0.499 * width, half, 0.4 * self.reach))
        elif self.style in ("rod", "staple", "tag"):
            yield from self._bar((x, y, z), 0.5 * self.share * width, half, height)
        elif self.style != "none":
            spread = 0.27 * width
            for place in (x - spread, x + spread) if self.pair else (x,):
                yield from self._knob((place, y, z), half)

    def _bar(self, center, reach_x: float, half: float, height: float) -> Iterator[Solid]:
        x, y, z = center
        out = self.reach
        if self.style == "staple":
            hole = box((x, y, z), (reach_x - 2 * half, 2 * half, out - 1.6 * half))
            yield box((x, y, z + out / 2), (reach_x, half, out / 2), hole=hole)
            return
        post = reach_x * (1 - 2 * self.inset) - half
        yield cylinder((x, y, z + out - half), (half, half, reach_x), TURN_X)
        for side in (-1, 1):
            place = (x + side * post, y, z + (out - half) / 2)
            yield box(place, (0.8 * half, 0.8 * half, (out - half) / 2))
        if self.style == "tag":
            rise = min(0.028, 0.22 * height)
            yield box((x, y + 1.5 * rise, z), (0.6 * reach_x, 0.5 * rise, half / 2))

    def _knob(self, center, half: float) -> Iterator[Solid]:
        x, y, z = center
        out = self.reach
        if self.style == "cup":
            yield ellipsoid((x, y, z + 0.35 * out), (2.6 * half, half, 0.65 * out))
            return
        make = cylinder if self.style == "knob" else ellipsoid
        if self.pair:  # of one piece each
            yield make((x, y, z + 0.4 * out), (half, half, out / 2))
            return
        yield cylinder((x, y, z + 0.4 * out), (0.45 * half, 0.45 * half, 0.4 * out))
        if self.style == "knob":
            yield cylinder((x, y, z + 0.82 * out), (half, half, 0.18 * out))
        else:
            yield ellipsoid((x, y, z + out - 0.75 * half), (half, half, 0.75 * half))


StandStyle = Literal["floor", "plinth", "tapered", "square", "round", "castors", "runners", "sides"]


def stand(
    rng: np.random.Generator, style: StandStyle, size: tuple[float, float, float]
) -> Iterator[Solid]:
    """What carries a cabinet: at most four solids between y = 0 and y = height.

    Args:
      style: "floor" is nothing at all (then height is 0), "plinth" a block set back from the
        front, "runners" two skids from front to back, "sides" the side panels drawn down.
      size: (width, height, depth); x is centered, the front is at z = 0.
    """
    width, height, depth = size
    half = np.array([width, height, depth]) / 2
    if style == "floor":
        return
    if style == "plinth":
        back = rng.uniform(0.0, 0.12) * depth
        aside = rng.uniform(0.0, 0.04) * width
        front = rng.uniform(0.005, 0.12) * depth
        z = (-front - (depth - back)) / 2
        yield box((0, half[1], z), (half[0] - aside, half[1], (depth - front - back) / 2))
        return
    if style in ("runners", "sides"):
        thick = width * (rng.uniform(0.015, 0.035) if style == "sides" else 0.035)
        inset = 0.0 if style == "sides" else rng.uniform(0.0, 0.08) * width
        for side in (-1, 1):
            place = (side * (half[0] - thick - inset), half[1], -half[2])
            yield box(place, (thick, half[1], half[2]))
        return
    thick = min(rng.uniform(0.018, 0.04) * np.sqrt(width * depth), 0.6 * height + 0.006)
    inset = thick + rng.uniform(0.0, 0.1) * min(width, depth)
    taper = rng.uniform(0.4, 0.8, size=2)
    for x in (-half[0] + inset, half[0] - inset):
        for z in (-inset, -depth + inset):
            place = (x, half[1], z)
            if style == "tapered":
                yield frustum(place, (thick, thick, half[1]), taper, UPSIDE_DOWN)
            elif style == "square":
                yield box(place, (thick, half[1], thick))
            elif style == "round":
                yield cylinder(place, (thick, thick, half[1]), TURN_Y)
            else:  # castors: wheels as high as the gap that they fill
                yield cylinder(place, (half[1], half[1], 0.45 * thick), TURN_X)
