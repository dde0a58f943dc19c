"""What is inside a dishwasher: racks, spray arms, crockery; part of the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caper_jax.categories.forms import about
from caper_jax.categories.furniture import TURN_Y
from caper_jax.geometry.solids import Solid, box, cylinder, ellipsoid


def inside(
    rng: np.random.Generator, cavity: tuple[np.ndarray, np.ndarray], plug: float, small: bool
) -> list[Solid]:
    """Solids in a tub.

    Args:
      cavity: its low and high corner [3], meters; open at z = 0.
      plug: how far the shut door reaches into it, meters.
      small: only one or two racks.
    """
    low, high = cavity
    if rng.random() < 0.08:  # empty
        return []
    room = high - low
    front = -plug - rng.uniform(0.02, 0.05)  # clear of the detergent box
    back = low[2] + rng.uniform(0.005, 0.04)
    half_x = high[0] - rng.uniform(0.004, 0.02)
    floors: tuple[float, ...]
    if small:
        floors = (0.12,) if rng.random() < 0.7 else (0.1, 0.58)
    else:
        floors = ((0.13,), (0.12, 0.53), (0.1, 0.47, 0.83))[rng.choice(3, p=(0.12, 0.56, 0.32))]
    # All racks of a machine are made alike: wires in a frame, or closed trays.
    wires = rng.random() < 0.65
    rim = rng.uniform(0.004, 0.012)
    sides = rng.uniform(0.1, 0.2) if rng.random() < 0.65 else rng.uniform(0.025, 0.06)
    solids: list[Solid] = []
    racks: list[_Rack] = []
    for level, share in enumerate(floors):
        y = low[1] + share * room[1] + rng.uniform(-0.01, 0.02)
        tall = min(sides, 0.06 if level == 2 else 1.0) * room[1]
        pulled = rng.uniform(0.0, 0.04) * (rng.random() < 0.3)
        center = np.array([0.0, y + tall / 2, (front + back) / 2 - pulled])
        half = np.array([half_x, tall / 2, (front - back) / 2 - pulled])
        racks.append(_rack(rng, center, half, rim, wires and level < 2))
        solids += racks[-1].solids
    if rng.random() < 0.45:
        solids += _plates(rng, racks[0], room[1])
    if rng.random() < 0.45:
        solids.append(_cutlery(rng, racks[0], room[1]))
    if len(racks) > 1 and rng.random() < 0.35:
        solids += _cups(rng, racks[1], room[1])
    if rng.random() < 0.6:  # spray arm over the sump
        reach = 0.85 * min(half_x, (front - back) / 2)
        place = np.array([0.0, low[1] + 0.03, (front + back) / 2])
        solids.append(box(place, (reach, 0.006, 0.02), about("y", rng.uniform(-1.5, 1.5))))
        solids.append(cylinder(place - (0, 0.015, 0), (0.05, 0.05, 0.016), TURN_Y))
    return solids


def _basket(center: np.ndarray, half: np.ndarray, wall: float) -> Solid:
    """An open box."""
    return box(center, half, hole=box(center + (0, wall, 0), half - (wall, 0, wall)))


@dataclass(frozen=True)
class _Rack:
    """A rack and where things stand in it.

    Attributes:
      solids: all of it.
      floor: y of what things stand on, meters.
      places: x of where they can stand.
      half_x: half its width inside.
      ends: z of its back and front.
    """

    solids: list[Solid]
    floor: float
    places: np.ndarray
    half_x: float
    ends: tuple[float, float]


def _rack(
    rng: np.random.Generator, center: np.ndarray, half: np.ndarray, rim: float, wires: bool
) -> _Rack:
    """A frame with wires, or a tray, on runners that reach the walls of the tub."""
    runner = 0.008
    solids = [
        box(center + (side * half[0], 0, 0), (2.5 * runner, runner, half[2])) for side in (-1, 1)
    ]
    half = half - (runner, 0, 0)
    bottom = center[1] - half[1]
    ends = (center[2] - half[2], center[2] + half[2])
    if not wires:
        solids.append(_basket(center, half, rim))
        places = rng.uniform(-0.6, 0.6, size=3) * half[0]
        return _Rack(solids, bottom + rim, places, half[0] - rim, ends)
    count = int(rng.integers(2, 5))
    places = half[0] * (2 * (np.arange(count) + 0.5) / count - 1)
    solids.append(box(center, half, hole=box(center, half + (-rim, 1.0, -rim))))
    solids += [
        box((x, bottom + 0.004, center[2]), (rim / 2 + 0.003, 0.004, half[2])) for x in places
    ]
    return _Rack(solids, bottom + 0.008, places, half[0] - rim, ends)


def _plates(rng: np.random.Generator, rack: _Rack, room: float) -> list[Solid]:
    """A row of plates that lean a little."""
    back, front = rack.ends
    x = rng.choice(rack.places)
    radius = min(rng.uniform(0.075, 0.13), 0.17 * room, rack.half_x - abs(x))
    count = int(rng.integers(2, 6))
    step = min(rng.uniform(0.025, 0.05), (front - back - 0.08) / count)
    angle = rng.uniform(0.05, 0.3)
    lean = about("x", -angle)
    start = back + 0.05 + rng.uniform(0.0, 0.5) * (front - back - 0.08 - count * step)
    y = rack.floor + radius * np.cos(angle) + 0.005 * np.sin(angle) - 0.002  # between the wires
    return [cylinder((x, y, start + i * step), (radius, radius, 0.005), lean) for i in range(count)]


def _cutlery(rng: np.random.Generator, rack: _Rack, room: float) -> Solid:
    """A basket for knives and forks."""
    back, front = rack.ends
    wide, tall, deep = rng.uniform((0.03, 0.045, 0.06), (0.06, 0.065, 0.13))
    x = rng.choice(rack.places)
    wide = min(wide, rack.half_x - abs(x))
    deep, tall = min(deep, 0.3 * (front - back)), min(tall, 0.15 * room)
    return _basket(
        np.array([x, rack.floor + tall, front - deep - 0.012]), np.array([wide, tall, deep]), 0.004
    )


def _cups(rng: np.random.Generator, rack: _Rack, room: float) -> list[Solid]:
    """Cups and bowls, upside down."""
    back, front = rack.ends
    solids: list[Solid] = []
    for x in rng.permutation(rack.places)[: rng.integers(1, 4)]:
        radius = min(rng.uniform(0.032, 0.06), rack.half_x - abs(x))
        rise = min(rng.uniform(0.03, 0.055), 0.08 * room)
        z = rng.uniform(back + radius + 0.02, front - radius - 0.02)
        place = (x, rack.floor + rise - 0.002, z)
        if rng.random() < 0.6:
            solids.append(cylinder(place, (radius, radius, rise), TURN_Y))
        else:
            solids.append(ellipsoid(place, (radius, rise, radius)))
    return solids
