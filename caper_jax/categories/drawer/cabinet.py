"""Cabinets for three drawers: measures and carcasses; front at z = 0, floor at y = 0, y up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caper_jax.categories.forms import TURN_X, TURN_Y, Handle, StandStyle
from caper_jax.geometry.solids import Solid, box, cylinder, frustum

# Probability, and ranges of width, height (without stand) and depth in meters.
TYPES = {
    "chest": (0.24, (0.6, 1.4), (0.55, 1.15), (0.38, 0.58)),
    "tall": (0.2, (0.32, 0.55), (0.6, 1.25), (0.38, 0.62)),
    "kitchen": (0.17, (0.4, 1.0), (0.66, 0.82), (0.46, 0.62)),
    "bedside": (0.15, (0.32, 0.55), (0.38, 0.65), (0.3, 0.45)),
    "desktop": (0.15, (0.11, 0.36), (0.17, 0.4), (0.17, 0.32)),
    "cart": (0.09, (0.28, 0.5), (0.5, 0.85), (0.3, 0.46)),
}
STANDS: dict[str, tuple[StandStyle, ...]] = {
    "chest": ("floor", "plinth", "tapered", "square", "round", "runners", "sides"),
    "tall": ("floor", "floor", "plinth", "castors", "square", "runners", "sides"),
    "kitchen": ("floor", "plinth", "plinth", "round"),
    "bedside": ("floor", "plinth", "tapered", "tapered", "square", "round", "castors", "sides"),
    "desktop": ("floor", "floor", "floor", "round", "square", "plinth"),
    "cart": ("floor", "castors", "castors", "round"),
}
# Heights of stands as shares of the cabinet's.
_LIFT = {
    "floor": (0.0, 0.0),
    "plinth": (0.05, 0.16),
    "tapered": (0.08, 0.45),
    "square": (0.03, 0.35),
    "round": (0.02, 0.3),
    "castors": (0.05, 0.1),
    "runners": (0.03, 0.1),
    "sides": (0.05, 0.25),
}


@dataclass(frozen=True)
class Plan:
    """Measures of a cabinet in meters; x centered, floor at y = 0, carcass front at z = 0."""

    width: float  # outer extents of the carcass
    height: float
    depth: float
    base: float  # height of the stand below it
    side: float  # thickness of its walls
    roof: float
    floor: float
    back: float
    scale: float  # of small parts, 1 for furniture and less for desktop boxes
    front: float  # thickness of the drawers' fronts
    inset: bool  # fronts lie inside the carcass instead of on it
    cover: float  # share of the walls that fronts on the carcass hide
    divider: float  # thickness of what separates two drawers, 0 for nothing
    # [4] heights of the bottom of the lowest drawer's opening, the boundaries between drawers, and
    # the top of the highest one's.
    levels: np.ndarray

    @property
    def top(self) -> float:
        return self.base + self.height

    @property
    def gap(self) -> float:
        """Between two fronts, or a front and what frames it."""
        return 0.003 * self.scale

    @property
    def face(self) -> tuple[float, float]:
        """z of the back and the outside of the fronts."""
        return (-self.front, 0.0) if self.inset else (0.001, 0.001 + self.front)

    @property
    def half_front(self) -> float:
        """Half the width of the fronts."""
        hidden = -self.gap if self.inset else self.cover * self.side
        return self.width / 2 - self.side + hidden

    def front_levels(self, index: int) -> tuple[float, float]:
        """y of the lower and upper edge of drawer ``index``'s front."""
        low, high = self.levels[index], self.levels[index + 1]
        if self.inset:
            space = self.divider / 2 + self.gap
            return low + (space if index else self.gap), high - (space if index < 2 else self.gap)
        space = self.gap / 2
        reach_low, reach_high = self.cover * self.floor, self.cover * self.roof
        return low + (space if index else -reach_low), high + (-space if index < 2 else reach_high)


def draw_plan(rng: np.random.Generator, kind: str, style: StandStyle) -> Plan:
    _, *ranges = TYPES[kind]
    width, height, depth = (rng.uniform(*bounds) for bounds in ranges)
    base = height * rng.uniform(*_LIFT[style])
    small = kind == "desktop"
    scale = rng.uniform(0.35, 0.6) if small else 1.0
    thickness = scale * rng.uniform((0.01, 0.01, 0.01, 0.004), (0.028, 0.032, 0.032, 0.02))
    side, roof, floor, back = thickness
    low, high = base + floor, base + height - roof
    # Some cabinets hold more than the three drawers: an open compartment or a blind front.
    spare = rng.random()
    if kind != "cart" and spare < 0.14:
        high -= rng.uniform(0.12, 0.3) * height
    elif kind != "cart" and spare < 0.22:
        low += rng.uniform(0.12, 0.3) * height
    return Plan(
        width=width,
        height=height,
        depth=depth,
        base=base,
        side=side,
        roof=roof,
        floor=floor,
        back=back,
        scale=scale,
        front=scale * rng.uniform(0.01, 0.024),
        inset=kind == "cart" or rng.random() < (0.7 if small else 0.42),
        cover=rng.uniform(0.3, 1.0),
        divider=scale * rng.uniform(0.004, 0.026) if rng.random() < 0.75 else 0.0,
        levels=low + (high - low) * _shares(rng),
    )


def _shares(rng: np.random.Generator) -> np.ndarray:
    """[4] boundaries of the drawers from 0 to 1, bottom up; the lowest is often the highest."""
    style = rng.random()
    if style < 0.38:
        heights = np.ones(3)
    elif style < 0.72:
        heights = rng.uniform(1.08, 1.65) ** np.array([2.0, 1.0, 0.0])
    elif style < 0.87:
        heights = np.array([1.0, 1.0, rng.uniform(0.4, 0.8)])
    else:
        heights = rng.uniform(0.6, 1.4, size=3)
    return np.concatenate([[0.0], np.cumsum(heights) / heights.sum()])


def carcass(
    rng: np.random.Generator, plan: Plan, open_top: bool, handle: Handle
) -> Iterator[Solid]:
    """Walls, what separates the drawers, and what fills the rest of the front."""
    half = np.array([plan.width, plan.height, plan.depth]) / 2
    center = np.array([0.0, plan.base + half[1], -half[2]])
    # The cavity goes through the front; through the back of a few cabinets too.
    low = np.array([-half[0] + plan.side, plan.base + plan.floor, -plan.depth + plan.back])
    high = np.array([half[0] - plan.side, plan.top - plan.roof, 0.1])
    if rng.random() < 0.05:
        low[2] -= 0.1
    if open_top:
        high[1] = plan.top + 0.1
    yield box(center, half, hole=box((low + high) / 2, (high - low) / 2))
    inner = half[0] - plan.side
    if open_top:  # stretchers hold the sides together
        deep = rng.uniform(0.04, 0.12)
        for z in (-deep / 2, -plan.depth + plan.back + deep / 2)[: rng.integers(1, 3)]:
            yield box((0, plan.top - plan.roof / 2, z), (inner, plan.roof / 2, deep / 2))
    if plan.divider:
        deep = plan.depth - plan.back if rng.random() < 0.45 else min(0.05, 0.2 * plan.depth)
        for y in plan.levels[1:3]:
            yield box((0, y, -deep / 2), (inner, plan.divider / 2, deep / 2))
    deep = (plan.depth - plan.back) / 2
    blind = rng.random() < 0.5
    above = (plan.levels[3], plan.top - plan.roof, plan.roof, 1)
    below = (plan.levels[0], plan.base + plan.floor, plan.floor, -1)
    for edge, end, thick, sign in (above, below):
        if abs(end - edge) < 1e-6:
            continue
        yield box((0, edge + sign * thick / 2, -deep), (inner, thick / 2, deep))
        if blind:
            hidden = 0.0 if plan.inset else plan.cover * thick
            y0, y1 = sorted((edge + sign * (hidden + plan.gap), end + sign * hidden))
            back, front = min(plan.face[0], 0.0), plan.face[1]
            half_x = plan.half_front + plan.gap
            middle = (0, (y0 + y1) / 2, (back + front) / 2)
            yield box(middle, (half_x, (y1 - y0) / 2, (front - back) / 2))
            yield from handle.on((0, middle[1], front), 2 * half_x, y1 - y0)


def cart(rng: np.random.Generator, plan: Plan) -> Iterator[Solid]:
    """An open frame: posts, a plate below and above, and a ledge on each side of a drawer."""
    make = cylinder if rng.random() < 0.5 else box
    radius = plan.side / 2
    extents = (radius, radius, plan.height / 2)
    y = plan.base + plan.height / 2
    for x in (-plan.width / 2 + radius, plan.width / 2 - radius):
        for z in (-radius, -plan.depth + radius):
            yield make((x, y, z), extents, TURN_Y)
        for index in range(3):
            low, high = plan.front_levels(index)
            place = (x, low + 0.55 * (high - low), -plan.depth / 2)
            yield box(place, (0.7 * radius, 0.006, plan.depth / 2 - radius))
    floor, roof = plan.base + plan.floor / 2, plan.top - plan.roof / 2
    for y, thick in ((floor, plan.floor), (roof, plan.roof)):
        yield box((0, y, -plan.depth / 2), (plan.width / 2, thick / 2, plan.depth / 2))


def top_plate(rng: np.random.Generator, plan: Plan) -> Iterator[Solid]:
    """A plate that overhangs, perhaps with a rounded front edge or a rim at the back."""
    thick = plan.scale * rng.uniform(0.01, 0.04)
    over = plan.scale * rng.uniform(0.0, 0.03)
    front = max(plan.face[1], 0.0) + plan.scale * rng.uniform(-0.004, 0.03)
    back = -plan.depth - (over if rng.random() < 0.4 else 0.0)
    half_x = plan.width / 2 + over
    y = plan.top + thick / 2
    center = (0, y, (front + back) / 2)
    edge = rng.random()
    if edge < 0.25:  # broken all around
        extents = np.array([half_x, (front - back) / 2, thick / 2])
        taper = 1 - rng.uniform(0.3, 1.0) * thick / extents[:2]
        yield frustum(center, extents, taper, TURN_Y)
    else:
        yield box(center, (half_x, thick / 2, (front - back) / 2))
    if edge > 0.7:
        yield cylinder((0, y, front), (thick / 2, thick / 2, half_x), TURN_X)
    if rng.random() < 0.1:
        rise = rng.uniform(0.05, 0.15) * plan.height
        yield box((0, y + rise / 2, back + 0.01), (half_x, rise / 2, 0.009))


def beside(rng: np.random.Generator, plan: Plan) -> Iterator[Solid]:
    """A compartment without drawers at one side, or the rest of a desk."""
    side = rng.choice((-1.0, 1.0))
    wide = rng.uniform(0.35, 1.1) * plan.width
    middle = side * (plan.width + wide) / 2
    if rng.random() < 0.5:
        half = np.array([wide, plan.top, plan.depth]) / 2
        center = np.array([middle, half[1], -half[2]])
        hole = box(center + (0, 0, plan.back + 0.05), half - (plan.side, plan.side, -0.05))
        yield box(center, half, hole=hole if rng.random() < 0.6 else None)
        return
    wide = max(wide, 0.55)
    end = side * (plan.width / 2 + wide)
    thick = max(plan.side, 0.012)
    above = (end / 2 - side * plan.width / 4, plan.top + thick / 2, -plan.depth / 2)
    yield box(above, ((plan.width + wide) / 2, thick / 2, plan.depth / 2 + 0.01))
    aside = (end - side * thick, plan.top / 2, -plan.depth / 2)
    yield box(aside, (thick, plan.top / 2, plan.depth / 2))
