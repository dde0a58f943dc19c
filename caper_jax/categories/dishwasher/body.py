"""Dishwashers without their door: measures, body, and what stands in it.

Measured with the door shut: floor at y = 0, opening at z = 0, x centered.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caper_jax.categories.forms import TURN_X, TURN_Y, about, open_box, stand
from caper_jax.geometry.solids import Solid, box, cylinder, ellipsoid

# Probability, and ranges of width, height (without worktop) and depth in meters.
TYPES = {
    "standard": (0.4, (0.56, 0.64), (0.78, 0.9), (0.5, 0.66)),
    "slim": (0.2, (0.42, 0.48), (0.78, 0.88), (0.48, 0.64)),
    "built_in": (0.25, (0.44, 0.62), (0.7, 0.9), (0.48, 0.62)),
    "table_top": (0.15, (0.4, 0.6), (0.38, 0.5), (0.4, 0.55)),
}
_GAP = 0.004  # between the door and what is around it, meters


@dataclass(frozen=True)
class Plan:
    """Measures in meters, door shut; x centered."""

    width: float  # outer extents; the height counts from the floor
    height: float
    depth: float
    base: float  # lower edge of the tub; below it only the plinth
    side: float  # thickness of the tub's walls
    floor: float
    back: float
    ceiling: float  # y of the upper edge of the opening
    thick: float  # of the door's plate
    half_door: float  # half its width
    low: float  # y of its lower and upper edge
    high: float
    hinge: tuple[float, float]  # (y, z)
    recess: float  # how far the plinth must stand back to let the door's lower edge pass
    plug: float  # depth of the door's inner panel, which lies in the opening; 0 for none

    @property
    def cavity(self) -> tuple[np.ndarray, np.ndarray]:
        """Low and high corner [3] of the tub's inside."""
        half_x = self.width / 2 - self.side
        low = np.array([-half_x, self.base + self.floor, -self.depth + self.back])
        return low, np.array([half_x, self.ceiling, 0.0])


def draw_plan(rng: np.random.Generator, kind: str, fascia: bool) -> Plan:
    _, *ranges = TYPES[kind]
    width, height, depth = (rng.uniform(*bounds) for bounds in ranges)
    small = kind == "table_top"
    thick = rng.uniform(0.016, {"built_in": 0.03, "table_top": 0.04}.get(kind, 0.06))
    base = rng.uniform(0.012, 0.05) if small else rng.uniform(0.05, 0.17)
    floor = rng.uniform(0.01, 0.06)
    if small or rng.random() < 0.65:
        # The door turns about its own lower edge and stays in front of the body.
        low = max(base + floor * rng.uniform(-0.3, 0.8), 1.5 * thick + 0.024)
        base = max(base, low - 0.8 * floor)
        hinge = (low, 0.002 + thick * rng.uniform(0.0, 0.8))
        recess = 0.002
    else:
        # The hinge lies behind the door, whose lower edge swings back over the plinth.
        behind, below = rng.uniform(0.005, 0.04), rng.uniform(0.02, min(0.09, 0.6 * base))
        hinge = (max(base - 0.003, 1.5 * thick + behind + 0.02), -behind)
        base = hinge[0] + 0.003
        low = hinge[0] - below
        recess = behind + below + 0.006
    roof = rng.uniform(0.09, 0.16) * height if fascia else rng.uniform(0.012, 0.05)
    ceiling = height - roof
    side = rng.uniform(0.008, 0.05) * width / 0.6
    return Plan(
        width=width,
        height=height,
        depth=depth,
        base=base,
        side=side,
        floor=floor,
        back=rng.uniform(0.01, 0.09),
        ceiling=ceiling,
        thick=thick,
        half_door=width / 2 + rng.uniform(-min(0.5 * side, 0.008), 0.002),
        low=low,
        high=ceiling + (0.008 if fascia else rng.uniform(0.5, 1.0) * roof - _GAP),
        hinge=hinge,
        recess=recess,
        plug=0.0 if rng.random() < 0.12 else rng.uniform(0.006, 0.03),
    )


def body(rng: np.random.Generator, plan: Plan, kind: str, fascia: bool) -> Iterator[Solid]:
    low, high = plan.cavity
    half = np.array([plan.width, plan.height - plan.base, plan.depth]) / 2
    center = np.array([0.0, plan.base + half[1], -half[2]])
    high = high + (0, 0, 0.1)
    housing = kind == "built_in" and not fascia and rng.random() < 0.2
    if housing:  # open above, as a kitchen unit before the worktop lies on it
        high[1] = plan.height + 0.1
    backless = rng.random() < 0.05
    if backless:
        low = low - (0, 0, 0.1)
    yield box(center, half, hole=box((low + high) / 2, (high - low) / 2))
    if housing:
        thick, deep = plan.height - plan.ceiling, rng.uniform(0.03, 0.1)
        for z in (-deep / 2, -plan.depth + plan.back + deep / 2):
            yield box((0, plan.ceiling + thick / 2, z), (high[0], thick / 2, deep / 2))
    yield from _base(rng, plan, kind)
    if fascia:
        yield from _fascia(rng, plan)
    if not housing and rng.random() < {"built_in": 0.2, "table_top": 0.3}.get(kind, 0.6):
        yield from _worktop(rng, plan, panels=kind == "built_in")
    if not backless and rng.random() < 0.15:  # connections at the back
        extents = np.array([rng.uniform(0.1, 0.4) * plan.width, rng.uniform(0.03, 0.1), 0.015])
        yield box((0, plan.base + extents[1] + 0.02, -plan.depth - 0.014), extents)


def _base(rng: np.random.Generator, plan: Plan, kind: str) -> Iterator[Solid]:
    """Plinth or feet from the floor to the tub."""
    if kind == "table_top" or rng.random() < 0.25:
        style = rng.choice(("round", "square"))
        room = plan.depth - 1.5 * plan.recess
        feet = stand(rng, style, (plan.width, plan.base, room))
        yield from (foot.moved(np.array([0.0, 0.0, room - plan.depth])) for foot in feet)
        return
    front = -plan.recess - rng.uniform(0.0, 0.06) * (rng.random() < 0.7)
    back = -plan.depth + rng.uniform(0.0, 0.1)
    half = (plan.width * rng.uniform(0.46, 0.5), plan.base / 2, (front - back) / 2)
    yield box((0, plan.base / 2, (front + back) / 2), half)


def _fascia(rng: np.random.Generator, plan: Plan) -> Iterator[Solid]:
    """The control strip above the door, part of the body."""
    low, high = plan.high + _GAP, plan.height
    out = plan.thick * rng.uniform(0.6, 1.15) + 0.002
    middle, half = (low + high) / 2, np.array([plan.half_door, (high - low) / 2, out / 2])
    yield box((0, middle, out / 2), half)
    yield from controls(rng, middle, out, half[0], half[1])


def controls(
    rng: np.random.Generator, y: float, z: float, half_x: float, half_y: float
) -> Iterator[Solid]:
    """Buttons, a dial or a display on a strip that faces +z."""
    radius = min(0.4 * half_y, 0.007)
    start, step = rng.uniform(0.2, 0.5) * half_x, rng.uniform(2.6, 4.0) * radius
    for index in range(rng.integers(0, 4)):
        yield cylinder((start + index * step, y, z), (radius, radius, 0.003))
    if rng.random() < 0.35:
        dial = min(0.6 * half_y, rng.uniform(0.012, 0.022))
        yield cylinder((-0.7 * half_x, y, z + 0.005), (dial, dial, 0.009))
    if rng.random() < 0.4:
        place = (rng.uniform(-0.3, 0.0) * half_x, y, z)
        yield box(place, (0.15 * half_x, 0.5 * half_y, 0.002))


def _worktop(rng: np.random.Generator, plan: Plan, panels: bool) -> Iterator[Solid]:
    """A plate on top, in a kitchen with cabinet sides under it."""
    thick = rng.uniform(0.015, 0.045)
    front = plan.thick * rng.uniform(0.0, 1.4)
    back = -plan.depth - rng.uniform(0.0, 0.03)
    half_x = plan.width / 2 + rng.uniform(0.0, 0.01)
    board = rng.uniform(0.008, 0.012) if panels and rng.random() < 0.6 else 0.0
    if board:
        half_x = plan.width / 2 + 2 * board + 0.001
    y = plan.height + thick / 2
    yield box((0, y, (front + back) / 2), (half_x, thick / 2, (front - back) / 2))
    if board:
        half = np.array([board, plan.height / 2, plan.depth / 2])
        for side in (-1, 1):
            yield box((side * (half_x - board), half[1], -half[2]), half)
    if rng.random() < 0.3:
        yield cylinder((0, y, front), (thick / 2, thick / 2, half_x), TURN_X)


def inside(
    rng: np.random.Generator, cavity: tuple[np.ndarray, np.ndarray], plug: float, small: bool
) -> Iterator[Solid]:
    """Solids in a tub.

    Args:
      cavity: its low and high corner [3], meters; open at z = 0.
      plug: how far the shut door reaches into it, meters.
      small: only one or two racks.
    """
    low, high = cavity
    if rng.random() < 0.08:  # empty
        return
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
    racks: list[_Rack] = []
    for level, share in enumerate(floors):
        y = low[1] + share * room[1] + rng.uniform(-0.01, 0.02)
        tall = min(sides, 0.06 if level == 2 else 1.0) * room[1]
        pulled = rng.uniform(0.0, 0.04) * (rng.random() < 0.3)
        center = np.array([0.0, y + tall / 2, (front + back) / 2 - pulled])
        half = np.array([half_x, tall / 2, (front - back) / 2 - pulled])
        racks.append(_rack(rng, center, half, rim, wires and level < 2))
        yield from racks[-1].solids
    if rng.random() < 0.45:
        yield from _plates(rng, racks[0], room[1])
    if rng.random() < 0.45:
        yield _cutlery(rng, racks[0], room[1])
    if len(racks) > 1 and rng.random() < 0.35:
        yield from _cups(rng, racks[1], room[1])
    if rng.random() < 0.6:  # spray arm over the sump
        reach = 0.85 * min(half_x, (front - back) / 2)
        place = np.array([0.0, low[1] + 0.03, (front + back) / 2])
        yield box(place, (reach, 0.006, 0.02), about("y", rng.uniform(-1.5, 1.5)))
        yield cylinder(place - (0, 0.015, 0), (0.05, 0.05, 0.016), TURN_Y)


@dataclass(frozen=True)
class _Rack:
    """A rack and where things stand in it."""

    solids: list[Solid]  # all of it
    floor: float  # y of what things stand on, meters
    places: np.ndarray  # x of where they can stand
    half_x: float  # half its width inside
    ends: tuple[float, float]  # z of its back and front


def _rack(
    rng: np.random.Generator, center: np.ndarray, half: np.ndarray, rim: float, wires: bool
) -> _Rack:
    """A frame with wires, or a tray, on runners that reach the walls of the tub."""
    runner = 0.008
    extents = (2.5 * runner, runner, half[2])
    solids = [box(center + (side * half[0], 0, 0), extents) for side in (-1, 1)]
    half = half - (runner, 0, 0)
    bottom = center[1] - half[1]
    ends = (center[2] - half[2], center[2] + half[2])
    if not wires:
        solids.append(open_box(center, half, rim, rim))
        places = rng.uniform(-0.6, 0.6, size=3) * half[0]
        return _Rack(solids, bottom + rim, places, half[0] - rim, ends)
    count = int(rng.integers(2, 5))
    places = half[0] * (2 * (np.arange(count) + 0.5) / count - 1)
    solids.append(box(center, half, hole=box(center, half + (-rim, 1.0, -rim))))
    wire = (rim / 2 + 0.003, 0.004, half[2])
    solids += [box((x, bottom + 0.004, center[2]), wire) for x in places]
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
    place = (x, rack.floor + tall, front - deep - 0.012)
    return open_box(place, (wide, tall, deep), 0.004, 0.004)


def _cups(rng: np.random.Generator, rack: _Rack, room: float) -> Iterator[Solid]:
    """Cups and bowls, upside down."""
    back, front = rack.ends
    for x in rng.permutation(rack.places)[: rng.integers(1, 4)]:
        radius = min(rng.uniform(0.032, 0.06), rack.half_x - abs(x))
        rise = min(rng.uniform(0.03, 0.055), 0.08 * room)
        z = rng.uniform(back + radius + 0.02, front - radius - 0.02)
        place = (x, rack.floor + rise - 0.002, z)
        if rng.random() < 0.6:
            yield cylinder(place, (radius, radius, rise), TURN_Y)
        else:
            yield ellipsoid(place, (radius, rise, radius))
