"""One half of a pair of scissors: blade, pivot, shank, sheath and loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caper_jax.categories.forms import about, beam, chain, turned
from caper_jax.geometry.solids import Solid, box, cylinder

_Y = np.array([0.0, 1.0, 0.0])
_FLAT = about("x", -np.pi / 2)  # cylinder z -> y


@dataclass(frozen=True)
class Half:
    """One blade with its handle, closed: tip at +x, handle at -x and -z; lengths in meters.

    Attributes:
      blade: from the pivot to the tip.
      width: of the blade at the pivot.
      tip: width of the blade at its tip.
      belly: where the blade starts to narrow, as a share of its length.
      round_tip: a disc as wide as ``tip`` ends the blade.
      metal: thickness of the blade.
      shank: from the pivot to the handle's loop.
      loop: (a, b) half extents of the opening for the fingers, along and across the handle.
      flat: share of the opening's half width that its inner side is flattened to, 1 for an oval.
      egg: how much wider the loop is towards its end than its middle.
      tube: (half width, half thickness) of the loop's section.
      ring: a ring with upright sides instead of a round tube.
      splay: angle of the loop to the handle's line, radians.
      gap: least distance of the handle from the middle when closed.
      sheath: (half width, half thickness) of the plastic around the shank, or None.
      screw: (radius, height) of the disc at the pivot.
      teeth: number of bosses on the inner side of the shank.
      rest: length of the finger rest behind the loop, or 0.
      bend: angle of the handle to the blade, radians; positive turns it to +z.
    """

    blade: float
    width: float
    tip: float
    belly: float
    round_tip: bool
    metal: float
    shank: float
    loop: tuple[float, float]
    flat: float
    egg: float
    tube: tuple[float, float]
    ring: bool
    splay: float
    gap: float
    sheath: tuple[float, float] | None
    screw: tuple[float, float]
    teeth: int = 0
    rest: float = 0.0
    bend: float = 0.0


def blade_solids(half: Half) -> list[Solid]:
    """Above the plane y = 0 in which the blades meet; the line to the tip is the x axis."""
    y, across = half.metal / 2, half.metal / 2
    heel = np.array([-0.55 * half.width, y, 0.0])
    neck = np.array([half.belly * half.blade, y, 0.0])
    reach = half.blade - (half.tip / 2 if half.round_tip else 0.0)
    point = np.array([reach, y, 0.0])
    wide = half.width / 2
    waist = wide + (half.tip / 2 - wide) * 0.45 * half.belly
    solids = [
        beam(heel, neck, (wide, across), _Y, (waist / wide, 1.0)),
        beam(neck, point, (waist, across), _Y, (half.tip / 2 / waist, 1.0)),
    ]
    if half.round_tip:
        solids.append(cylinder(point, (half.tip / 2, half.tip / 2, across), _FLAT))
    radius, height = half.screw
    solids.append(
        cylinder(
            (0, half.metal / 2 + height / 2, 0), (radius, radius, (half.metal + height) / 2), _FLAT
        )
    )
    return solids


def _loop(half: Half) -> tuple[list[Solid], np.ndarray]:
    """The loop for the fingers, and the corners [n, 3] of its middle line."""
    turn = 2 * np.pi * np.arange(12) / 12
    a, b = half.loop[0] + half.tube[0], half.loop[1] + half.tube[0]
    x, z = a * np.cos(turn), b * np.sin(turn)
    if not half.ring:
        z = np.minimum(z, half.flat * b) * (1 - half.egg * x / a)
    splay = about("y", -half.splay)
    middle = np.stack([x, np.zeros(12), z], axis=1) @ splay.T
    # Behind the shank, and to its own side of the middle. The ring bulges between its corners.
    bulge = half.tube[0] + (0.04 * b if half.ring else 0.0)
    center = np.array([-half.shank, 0.0, -half.gap]) - (bulge, 0.0, bulge) - middle.max(axis=0)
    middle = middle + center
    if not half.ring:
        return chain(middle, half.tube, _Y, closed=True, round_=True), middle
    turn_flat = splay @ _FLAT
    outer = (a + half.tube[0], b + half.tube[0], half.tube[1])
    hole = cylinder(center, (*half.loop, 2 * half.tube[1]), turn_flat)
    return [cylinder(center, outer, turn_flat, hole)], middle


def handle_solids(half: Half) -> list[Solid]:
    """Shank, sheath, loop and what is on them."""
    solids, middle = _loop(half)
    width = half.sheath[0] if half.sheath else 0.3 * half.width
    start = np.array([-0.3 * half.width, half.metal / 2, 0.0])
    # Behind the pivot the shank bends to its own side of the middle.
    elbow = np.array([-0.35 * half.shank - 0.3 * half.width, 0.0, -half.gap - width])
    nearest = middle[np.argmin(np.linalg.norm(middle - elbow, axis=1))]
    tang = (0.36 * half.width, half.metal / 2)
    solids.append(beam(start, elbow + (0, half.metal / 2, 0), tang, _Y))
    way = nearest - elbow
    if half.sheath:
        taper = np.minimum(1.0, np.array(half.tube) / half.sheath)
        solids.append(beam(elbow - 0.1 * way, nearest, half.sheath, _Y, taper))
    else:
        thick = max(half.metal / 2, 0.7 * half.tube[1])
        solids.append(beam(elbow - 0.1 * way, nearest, (width, thick), _Y, (0.8, 1.0)))
    for tooth in range(half.teeth):
        place = elbow + way * (0.3 + 0.35 * tooth) + (0, 0, 0.45 * width)
        size = (0.12 * np.abs(way[0]), 0.5 * half.tube[1], 0.5 * width)
        solids.append(box(place, size))
    if half.rest:
        end = middle[np.argmin(middle[:, 0])]
        out = np.array([-0.9 * half.rest, 0.0, -0.45 * half.rest])
        solids.append(beam(end, end + out, half.tube, _Y, round_=True))
    return [turned(solid, about("y", half.bend)) for solid in solids]
