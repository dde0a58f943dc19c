"""robotarm: seven links in a row, from the base (root) to the tip, with six revolute joints.

y is up from the base and z forward. Rest is the pose of zero joint angles, which every family of
arms has its own of (chains.py). At rest each joint axis lies along a canonical axis, and
a state is positive about its positive direction: +y where the axis is vertical, +x where it lies
across, +z where it points forward. So a positive turn about a vertical axis takes forward (z) to
the side (x), and a positive pitch leans what stands upright (y) forward (z).

The last link carries the end effector. Not every link is seen in every frame: base, shoulder and
wrist hide behind the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.categories.forms import about, along
from caper_jax.categories.robotarm import chains
from caper_jax.geometry.solids import Solid, box, cone, cylinder, ellipsoid, frustum

_UNIT = dict(zip("xyz", np.eye(3), strict=True))
_ALONG = {"x": about("y", np.pi / 2), "y": about("x", -np.pi / 2), "z": np.eye(3)}  # z -> axis

_FAMILIES = (
    chains.offset_cobot,
    chains.panda,
    chains.upright,
    chains.upright_offset,
    chains.industrial,
    chains.folded,
    chains.outstretched,
)
_SHARES = (0.22, 0.24, 0.12, 0.08, 0.2, 0.08, 0.06)


@dataclass(frozen=True)
class _Style:
    """How the links of one arm look.

    Attributes:
      radius: [7] half thickness of each link, meters.
      boxy: links 1 to 3 are cast boxes rather than tubes.
      taper: thickness of the end of a long tube over that of its start.
      slim: thickness of long tubes over that of joints.
      joint: "split" joints are two discs side by side, "fork" ones a disc that shows on both sides
        of a wider one, "ball" ones have a round end.
      bulge: radius of a joint that crosses the links over their thickness.
      width: half length of such a joint over its radius.
    """

    radius: np.ndarray
    boxy: bool
    taper: float
    slim: float
    joint: str
    bulge: float
    width: float


def _style(rng: np.random.Generator, radius: float, cast: bool) -> _Style:
    return _Style(
        radius=radius * rng.uniform(0.8, 1.2) * rng.uniform(0.9, 0.98) ** np.arange(7),
        boxy=cast and rng.random() < 0.75,
        taper=rng.uniform(0.65, 0.95) if rng.random() < 0.5 else 1.0,
        slim=rng.uniform(0.68, 0.95),
        joint=("split", "fork", "ball")[rng.integers(3)],
        bulge=rng.uniform(1.0, 1.2),
        width=rng.uniform(0.75, 1.1),
    )


def _link(k: int, chain: chains.Chain, style: _Style) -> list[Solid]:
    """The solids of link k: tubes along its path, discs about its two joints."""
    path, radius = chain.paths[k], style.radius[k]
    before = chain.axes[k - 1] if k > 0 else None
    after = chain.axes[k] if k < 6 else None
    way = np.diff(path, axis=0)
    length = np.sqrt((way * way).sum(axis=1))
    forward = way / length[:, None]
    on_axis = np.zeros(len(way), bool)  # pieces that lie on a joint's axis
    if before is not None:
        on_axis[0] = abs(forward[0, "xyz".index(before)]) > 0.99
    if after is not None:
        on_axis[-1] |= abs(forward[-1, "xyz".index(after)]) > 0.99
    long = length > 2.5 * radius
    thick = np.where(long, style.slim, 1.0) * radius

    start, end = path[:-1].copy(), path[1:].copy()
    for bend in range(len(way) - 1):
        # One of the two pieces reaches through the bend: that on a joint's axis, or the first.
        if on_axis[bend + 1] and not on_axis[bend]:
            start[bend + 1] -= thick[bend] * forward[bend + 1]
        else:
            end[bend] += thick[bend + 1] * forward[bend]
    boxy = style.boxy and k in (1, 2, 3)
    taper = np.where(long & (k in (2, 3, 4)), style.taper, 1.0)
    solids = [_tube(start[i], end[i], thick[i], taper[i], boxy) for i in range(len(way))]
    if before is not None and not on_axis[0]:
        solids.append(_joint(path[0], before, style.radius[k - 1], style, child=True))
    if after is not None and not on_axis[-1]:
        solids.append(_joint(path[-1], after, radius, style, child=False))
    return solids


def _tube(start, end, thick: float, taper: float, boxy: bool) -> Solid:
    way = end - start
    length = np.sqrt(way @ way)
    side = _UNIT["y"] if abs(way[0]) > 0.9 * length else _UNIT["x"]
    rotation = along(way, side)
    center, half = (start + end) / 2, (thick, thick, length / 2)
    if taper == 1.0:
        return (box if boxy else cylinder)(center, half, rotation)
    if boxy:
        return frustum(center, half, (taper, taper), rotation)
    return cone(center, half, taper, rotation)


def _joint(place, axis: str, radius: float, style: _Style, child: bool) -> Solid:
    """One link's half of a joint that crosses the link: about ``axis``, centered at ``place``."""
    radius = style.bulge * radius
    width, rotation = style.width * radius, _ALONG[axis]
    if axis != "x" or style.joint == "split":
        offset = (0.5 if child else -0.5) * width * _UNIT[axis]
        return cylinder(place + offset, (radius, radius, width / 2), rotation)
    if not child:
        return cylinder(place, (radius, radius, 0.85 * width), rotation)
    if style.joint == "ball":
        return ellipsoid(place, (1.08 * radius, 1.08 * radius, 1.1 * width), rotation)
    return cylinder(place, (0.82 * radius, 0.82 * radius, width), rotation)


def _effector(rng: np.random.Generator, chain: chains.Chain, radius: float) -> list[Solid]:
    """A two-finger gripper, a suction cup or a bare flange at the tip."""
    tip, place = chain.tip, chain.paths[6][-1]
    # The wide side of a hand that hangs in front of the forearm is turned across it.
    sideways = tip[1] < 0 or (tip[0] == 0 and rng.random() < 0.6)
    across = _UNIT["x"] if sideways else np.roll(np.abs(tip), 1)
    rotation = along(tip, across)
    style = rng.random()

    def at(x: float, y: float, z: float) -> np.ndarray:
        return place + rotation @ (x, y, z)

    if style < 0.2:
        return [cylinder(at(0, 0, 0), (0.9 * radius, 0.9 * radius, 0.12 * radius), rotation)]
    if style < 0.4:
        stem, cup = radius * rng.uniform((0.3, 0.35), (1.0, 0.8))
        return [
            cylinder(at(0, 0, stem), (0.3 * radius, 0.3 * radius, stem), rotation),
            cone(at(0, 0, 2 * stem), (cup, cup, 0.3 * radius), 0.5, rotation @ about("x", np.pi)),
        ]
    palm = radius * rng.uniform((0.45, 1.0, 0.4), (0.7, 2.0, 0.9))
    finger = radius * rng.uniform((0.15, 0.12, 0.4), (0.35, 0.25, 0.75))
    gap = rng.uniform(finger[1], palm[1] - finger[1])
    solids = [box(at(0, 0, palm[2]), palm, rotation)]
    for side in (-1, 1):
        solids.append(box(at(0, side * gap, 2 * palm[2] + 0.98 * finger[2]), finger, rotation))
    return solids


def _stand(rng: np.random.Generator, chain: chains.Chain, radius: float) -> list[Solid]:
    """Foot and connectors, which tell the front from the back, and what the arm stands on."""
    height = chain.paths[0][-1][1]
    foot = radius * rng.uniform(1.15, 1.6)
    thick = min(radius * rng.uniform(0.15, 0.4), 0.5 * height)
    solids: list[Solid] = []
    behind = 0.0
    round_ = rng.random() < 0.5
    if round_:
        solids.append(cylinder((0, thick / 2, 0), (foot, foot, thick / 2), _ALONG["y"]))
    else:
        behind = foot * rng.uniform(0.0, 0.6)
        half = (foot, thick / 2, foot + behind / 2)
        solids.append(box((0, thick / 2, -behind / 2), half))
    if behind < 0.2 * foot or rng.random() < 0.6:
        depth = radius * rng.uniform(0.35, 1.1)
        tall = height * rng.uniform(0.5, 0.95)
        place = (0, tall / 2, -0.8 * radius - depth / 2)
        solids.append(box(place, (radius * rng.uniform(0.45, 0.95), tall / 2, depth / 2)))
    style = rng.random()
    if style < 0.25:  # a pedestal
        half = (foot * rng.uniform(1.0, 1.6), rng.uniform(0.03, 0.3), foot * rng.uniform(1.0, 1.6))
        center = (0, -half[1], -behind / 2)
        if round_:
            solids.append(box(center, half))
        else:
            solids.append(cylinder(center, (half[0], half[2], half[1]), _ALONG["y"]))
    elif style < 0.45:  # a mounting plate
        half = (rng.uniform(1.2, 3.0) * foot, rng.uniform(0.005, 0.015), rng.uniform(1.2, 3) * foot)
        shift = (half[2] - foot) * rng.uniform(-0.6, 0.6)
        solids.append(box((0, -half[1], shift), half))
    return solids


def _scaled(chain: chains.Chain, factor: np.ndarray, radius: float) -> chains.Chain:
    paths = tuple(path * factor for path in chain.paths)
    return replace(chain, paths=paths, tip=chain.tip * np.sign(factor), radius=radius)


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one arm: a family, its lengths, how its links look, base and end effector."""
    family = _FAMILIES[rng.choice(len(_FAMILIES), p=_SHARES)]
    chain = family(rng)
    size = rng.uniform(0.75, 1.25)
    side = -1.0 if rng.random() < 0.2 else 1.0  # some arms are built the other way round
    chain = _scaled(chain, size * np.array([side, 1.0, 1.0]), size * chain.radius)
    style = _style(rng, chain.radius, cast=family is chains.industrial)
    parts = [_link(k, chain, style) for k in range(7)]
    parts[0] += _stand(rng, chain, style.radius[0])
    parts[6] += _effector(rng, chain, style.radius[6])
    return ObjectModel(
        parts,
        axis=np.array([_UNIT[axis] for axis in chain.axes]),
        pivot=np.array([path[0] for path in chain.paths[1:]]),
        limits=np.radians(chain.limits * rng.uniform(0.8, 1.0, (6, 2))),
    )


ROBOTARM = Category(
    name="robotarm",
    closed=None,
    parts=("base", "link 1", "link 2", "link 3", "link 4", "link 5", "link 6"),
    joints=tuple(
        Joint("revolute", parent=j, limits=(np.radians(low), np.radians(high)))
        for j, (low, high) in enumerate(
            [(-170, 170), (-140, 85), (-190, 170), (-170, 170), (-200, 170), (-200, 175)]
        )
    ),
    directions=("y", "z"),
    directions_reason="the column stands along y; foot and connectors tell the front from the back",
    unit=1.6,
    mean_size=(
        (0.251, 0.210, 0.270),
        (0.130, 0.186, 0.137),
        (0.133, 0.344, 0.251),
        (0.123, 0.177, 0.243),
        (0.106, 0.169, 0.147),
        (0.104, 0.135, 0.096),
        (0.129, 0.152, 0.121),
    ),
    mean_center=(
        (-0.020, -0.352, -0.159),
        (-0.019, -0.157, -0.145),
        (0.013, 0.022, -0.078),
        (-0.013, 0.177, 0.041),
        (0.003, 0.245, 0.136),
        (0.009, 0.297, 0.170),
        (0.027, 0.315, 0.210),
    ),
    shape=shape,
)
