"""The fronts of eyeglasses: lens outlines, rims, lenses, bridges, nose pads, end pieces, shields.

Pieces are built for the right (+x) half where both halves are alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caper_jax.categories.forms import UP, about, along, beam, chain
from caper_jax.geometry.solids import Solid, cylinder, ellipsoid


@dataclass(frozen=True)
class Front:
    """What all pieces of a frame's front share, meters; right means +x."""

    scale: float  # of a head, 1 for a grown-up's
    width: float  # between the outsides of the two end pieces
    gap: float  # between the two rims, at the nose
    # [n, 2] corners of the right lens about ``center``, counterclockwise from +x.
    outline: np.ndarray
    center: float  # x of the right lens
    half: tuple[float, float]  # (a, b) half extents of the lens before its outline is deformed
    rim: tuple[float, float]  # (half width in the plane of the lens, half depth) of the rims
    curve: float  # the front lies at z = -curve x^2
    metal: bool  # wire rather than plastic

    def place(self, x: float, y: float, forward: float = 0.0) -> np.ndarray:
        """[3] the point of the front above (x, y), or ``forward`` of it."""
        return np.array([x, y, forward - self.curve * x * x])

    def normal(self, x: float) -> np.ndarray:
        """[3] direction out of the front at x."""
        return np.array([2 * self.curve * x, 0.0, 1.0])

    def edge(self, y: float, side: float) -> float:
        """x of the right rim's middle line at height y: its outer (side 1) or inner (-1) one."""
        half = self.outline[self.outline[:, 0] * side > 0.25 * self.half[0]]
        half = half[np.argsort(half[:, 1])]
        return self.center + np.interp(y, half[:, 1], half[:, 0]) + side * self.rim[0]


def draw_front(rng: np.random.Generator, metal: bool, large: bool) -> tuple[Front, str]:
    """Sizes and lens outline: round, oval, rectangular, wayfarer, aviator, cat-eye, polygon."""
    names = ["round", "oval", "rectangle", "wayfarer", "aviator", "cat-eye", "polygon"]
    weights = [0.16, 0.12, 0.28, 0.14, 0.1, 0.12, 0.08]
    if large:
        weights = [0.12, 0.05, 0.13, 0.3, 0.22, 0.14, 0.04]
    name = str(rng.choice(names, p=weights))
    scale = rng.uniform(0.76, 0.9) if rng.random() < 0.1 else rng.uniform(0.9, 1.06)
    width = scale * rng.uniform(0.128, 0.148)
    gap = scale * (rng.uniform(0.012, 0.02) if metal else rng.uniform(0.01, 0.018))
    rim = (rng.uniform(0.0005, 0.0012), rng.uniform(0.0006, 0.0014))
    if not metal:
        rim = (rng.uniform(0.0012, 0.0036), rng.uniform(0.0012, 0.0028))
    end = scale * rng.uniform(0.002, 0.008)
    a = (width - gap) / 4 - rim[0] - end / 2
    low, high = {
        "round": (0.92, 1.02),
        "oval": (0.55, 0.78),
        "rectangle": (0.5, 0.85),
        "wayfarer": (0.68, 0.88),
        "aviator": (0.8, 0.98),
        "cat-eye": (0.6, 0.85),
        "polygon": (0.75, 0.98),
    }[name]
    b = a * rng.uniform(low, high)
    count = int(rng.choice([6, 8])) if name == "polygon" else 12
    square = {
        "rectangle": rng.uniform(3, 6),
        "wayfarer": rng.uniform(2.6, 4),
        "cat-eye": rng.uniform(2.2, 3.2),
    }.get(name, 2.0)
    # Straight sides need no corner in their middle, so that more are left for their ends.
    turn = 2 * np.pi * (np.arange(count) + (0.5 if square > 3 or count == 8 else 0.0)) / count
    cos, sin = np.cos(turn), np.sin(turn)
    x = a * np.sign(cos) * np.abs(cos) ** (2 / square)
    y = b * np.sign(sin) * np.abs(sin) ** (2 / square)
    keystone = 0.0
    if name in ("wayfarer", "cat-eye") or (name == "rectangle" and rng.random() < 0.5):
        keystone = rng.uniform(0.03, 0.14)
    if name == "aviator":  # flat above, and a drop that hangs outwards
        keystone = rng.uniform(0.05, 0.14)
        x = x + 0.1 * a * np.maximum(0.0, -y / b)
        y = np.where(y > 0, rng.uniform(0.75, 0.9) * y, rng.uniform(1.0, 1.15) * y)
    x = x * (1 + keystone * y / b)
    if name in ("cat-eye", "wayfarer"):  # the outer upper corner is drawn up
        lift = rng.uniform(0.2, 0.5) if name == "cat-eye" else rng.uniform(0.0, 0.15)
        y = y + lift * b * np.clip(x / a, 0, 1) ** 2 * np.clip(y / b + 0.4, 0, 1)
    curve = rng.uniform(0.001, 0.009) * (1.4 if large else 1.0) / (width / 2) ** 2
    outline = np.stack([x, y], axis=1)
    center = gap / 2 + 2 * rim[0] + a
    return Front(scale, width, gap, outline, center, (a, b), rim, curve, metal), name


def rim(rng: np.random.Generator, front: Front, style: str) -> Iterator[Solid]:
    """The right rim, a chain; only its upper part in half-rim frames."""
    width, depth = front.rim
    middle = front.outline * (1 + width / front.half[0])
    points = np.array([front.place(front.center + x, y) for x, y in middle])
    normal = front.normal(front.center)
    if style == "full":
        yield from chain(points, (width, depth), normal, closed=True)
        return
    upper = middle[:, 1] > -0.2 * front.half[1]
    # The outline starts at +x and goes up, so its upper part is contiguous up to one roll.
    first = int(np.argmax(upper & ~np.roll(upper, 1)))
    arc = np.roll(points, -first, axis=0)[: upper.sum()]
    if style == "half":
        yield from chain(arc, (width, depth), normal)
        return
    thick = (rng.uniform(0.002, 0.0035), rng.uniform(0.0015, 0.0025))  # a browline
    yield from chain(arc, thick, normal)
    lower = np.roll(points, -first - upper.sum() + 1, axis=0)[: (~upper).sum() + 2]
    yield from chain(lower, (0.0007, 0.0008), normal)


def lens(rng: np.random.Generator, front: Front) -> Iterator[Solid]:
    """The right lens: the largest ellipse within its outline, and three upright strips."""
    corners = front.outline
    before = np.roll(corners, 1, axis=0)
    points = np.concatenate([corners, (corners + before) / 2])
    low, high = points.min(0), points.max(0)
    middle, half = (low + high) / 2, (high - low) / 2
    normal = front.normal(front.center)
    thickness = rng.uniform(0.0005, 0.0013)
    under = 1.3 * front.rim[0]  # it is held in the middle of the rim

    disc = np.hypot(*((points - middle) / half).T).min() * half + under
    place = front.place(front.center + middle[0], middle[1])
    yield cylinder(place, (*disc, thickness), along(normal, UP))

    stations = middle[0] + half[0] * np.array([-0.94, -0.66, 0.66, 0.94])
    way = corners - before
    slanted = np.abs(way[:, 0]) > 1e-9  # upright edges lie at the sides, beyond every station
    ends = []
    for x in stations:
        share = (x - before[slanted, 0]) / way[slanted, 0]
        crossed = (before[slanted] + share[:, None] * way[slanted])[(share >= 0) & (share <= 1), 1]
        ends.append((crossed.min(), crossed.max()))
    for wide, narrow in ((1, 0), (2, 3)):
        bottom, top = ends[wide]
        height, tall = (bottom + top) / 2, (top - bottom) / 2 + under
        least = min(ends[narrow][1] - height, height - ends[narrow][0]) + under
        start, end = (front.place(front.center + stations[i], height) for i in (wide, narrow))
        taper = (np.clip(least / tall, 0.15, 1.0), 1.0)
        yield beam(start, end, (tall, thickness), normal, taper)
    (low_1, high_1), (low_2, high_2) = ends[1:3]
    start = front.place(front.center + stations[1], (low_1 + high_1) / 2)
    end = front.place(front.center + stations[2], (low_2 + high_2) / 2)
    tall = (high_1 - low_1 + high_2 - low_2) / 4 + under
    yield beam(start, end, (tall, thickness), normal)


def bridge(rng: np.random.Generator, front: Front, rims: bool) -> Iterator[Solid]:
    """A bar over the nose, straight or arched, and perhaps another between the rims' tops."""
    b = front.half[1]
    height = rng.uniform(0.0, 0.55) * b
    rise = rng.uniform(0.0, 0.25) * b
    half = (front.rim[0] * 1.1 if front.metal else rng.uniform(0.0018, 0.0045), front.rim[1])
    inner = front.edge(height, -1.0) + front.rim[0]
    arch = front.place(0.0, height + rise, rng.uniform(0.0, 0.003))
    points = [front.place(-inner, height), arch, front.place(inner, height)]
    yield from chain(points, half, front.normal(0.0))
    if rims and front.metal and rng.random() < 0.3:
        top = min(height + rise + rng.uniform(0.2, 0.4) * b, front.outline[:, 1].max())
        reach = front.edge(top, -1.0) + front.rim[0]
        yield beam(front.place(-reach, top), front.place(reach, top), half, front.normal(0.0))


def nose_pad(rng: np.random.Generator, front: Front, low: float) -> Iterator[Solid]:
    """The right nose pad, on a wire arm or moulded to the rim; ``low`` in half heights."""
    height = rng.uniform(low, low + 0.4) * front.half[1]
    edge = front.edge(height, -1.0)
    tilt = about("y", rng.uniform(0.2, 0.7)) @ about("z", -rng.uniform(0.1, 0.35))
    if not front.metal:
        half = front.scale * np.array([0.0022, rng.uniform(0.005, 0.008), 0.0035])
        place = front.place(edge, height, -front.rim[1] - 0.001)
        yield ellipsoid(place, half, tilt)
        return
    half = front.scale * np.array([0.0013, rng.uniform(0.005, 0.0075), rng.uniform(0.0025, 0.004)])
    back = rng.uniform(0.004, 0.008)
    place = front.place(max(edge - 0.002, 0.004), height, -back)
    yield ellipsoid(place, half, tilt)
    yield beam(front.place(edge, height), place, (0.0006, 0.0006), UP)


def end_piece(rng: np.random.Generator, front: Front, hinge: np.ndarray, half) -> Iterator[Solid]:
    """The right end piece, from the rim out and back to the hinge, and the hinge's barrel."""
    height = hinge[1]
    x = front.edge(height, 1.0)
    corner = front.place(hinge[0] - 0.3 * half[0], height)
    if x < corner[0] - 1e-4:
        yield beam(front.place(x - front.rim[0], height), corner, half[::-1], front.normal(x))
    behind = np.array([hinge[0], height, hinge[2]])
    yield beam(corner, behind, (half[0], half[1]), UP)
    radius = rng.uniform(0.0009, 0.0018)
    barrel = (radius, radius, min(half[1], rng.uniform(0.0015, 0.004)))
    yield cylinder(hinge - (half[0], 0, 0), barrel, along(UP, np.array([0, 0, 1.0])))


def shield(rng: np.random.Generator, front: Front) -> Iterator[Solid]:
    """One lens over both eyes, of upright plates, with a notch for the nose."""
    half = front.half[1] * rng.uniform(0.75, 1.0)
    thickness = rng.uniform(0.0007, 0.0016)
    edges = np.linspace(-1, 1, 14)
    middle = (edges[:-1] + edges[1:]) / 2
    notch = rng.uniform(0.4, 0.9) * np.exp(-((middle / rng.uniform(0.14, 0.25)) ** 2))
    drawn_in = rng.uniform(0.1, 0.9) * np.abs(middle) ** 3
    low = -half * (1 - notch - drawn_in)
    high = half * (1 - rng.uniform(0.0, 0.4) * middle**2)
    x = edges * front.width / 2
    for i, (y, tall) in enumerate(zip((low + high) / 2, (high - low) / 2, strict=True)):
        yield beam(front.place(x[i], y), front.place(x[i + 1], y), (thickness, tall), UP)
    if rng.random() < 0.6:  # a bar along the brows
        brow = [front.place(x[i], high[i]) for i in range(0, 7, 2)]
        brow += [point * (-1, 1, 1) for point in brow[::-1]]
        yield from chain(brow, (rng.uniform(0.001, 0.0025), rng.uniform(0.0015, 0.003)), UP)
