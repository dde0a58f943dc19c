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

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.articulation.urdf_rule import CanonicalAxes, UrdfRule, along_positive
from caper_jax.categories.forms import TURN_X, TURN_Y, about, along, beam
from caper_jax.categories.robotarm import chains
from caper_jax.geometry.solids import Solid, box, cone, cylinder, ellipsoid

_UNIT = dict(zip("xyz", np.eye(3), strict=True))
_ALONG = {"x": TURN_X, "y": TURN_Y, "z": np.eye(3)}  # z -> axis

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
    """How the links of one arm look."""

    radius: np.ndarray  # [7] half thickness of each link, meters
    boxy: bool  # links 1 to 3 are cast boxes rather than tubes
    taper: float  # thickness of the end of a long tube over that of its start
    slim: float  # thickness of long tubes over that of joints
    # "split" joints are two discs side by side, "fork" ones a disc that shows on both sides of a
    # wider one, "ball" ones have a round end.
    joint: str
    bulge: float  # radius of a joint that crosses the links over their thickness
    width: float  # half length of such a joint over its radius


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


def _link(k: int, chain: chains.Chain, style: _Style) -> Iterator[Solid]:
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
    for i in range(len(way)):
        up = _UNIT["y"] if abs(forward[i, 0]) > 0.9 else _UNIT["x"]
        narrow = None if taper[i] == 1.0 else taper[i]
        yield beam(start[i], end[i], (thick[i], thick[i]), up, narrow, round_=not boxy)
    if before is not None and not on_axis[0]:
        yield _joint(path[0], before, style.radius[k - 1], style, child=True)
    if after is not None and not on_axis[-1]:
        yield _joint(path[-1], after, radius, style, child=False)


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


def _effector(rng: np.random.Generator, chain: chains.Chain, radius: float) -> Iterator[Solid]:
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
        yield cylinder(at(0, 0, 0), (0.9 * radius, 0.9 * radius, 0.12 * radius), rotation)
        return
    if style < 0.4:
        stem, cup = radius * rng.uniform((0.3, 0.35), (1.0, 0.8))
        yield cylinder(at(0, 0, stem), (0.3 * radius, 0.3 * radius, stem), rotation)
        yield cone(at(0, 0, 2 * stem), (cup, cup, 0.3 * radius), 0.5, rotation @ about("x", np.pi))
        return
    palm = radius * rng.uniform((0.45, 1.0, 0.4), (0.7, 2.0, 0.9))
    finger = radius * rng.uniform((0.15, 0.12, 0.4), (0.35, 0.25, 0.75))
    gap = rng.uniform(finger[1], palm[1] - finger[1])
    yield box(at(0, 0, palm[2]), palm, rotation)
    for side in (-1, 1):
        yield box(at(0, side * gap, 2 * palm[2] + 0.98 * finger[2]), finger, rotation)


def _stand(rng: np.random.Generator, chain: chains.Chain, radius: float) -> Iterator[Solid]:
    """Foot and connectors, which tell the front from the back, and what the arm stands on."""
    height = chain.paths[0][-1][1]
    foot = radius * rng.uniform(1.15, 1.6)
    thick = min(radius * rng.uniform(0.15, 0.4), 0.5 * height)
    behind = 0.0
    round_ = rng.random() < 0.5
    if round_:
        yield cylinder((0, thick / 2, 0), (foot, foot, thick / 2), TURN_Y)
    else:
        behind = foot * rng.uniform(0.0, 0.6)
        yield box((0, thick / 2, -behind / 2), (foot, thick / 2, foot + behind / 2))
    if behind < 0.2 * foot or rng.random() < 0.6:
        depth = radius * rng.uniform(0.35, 1.1)
        tall = height * rng.uniform(0.5, 0.95)
        place = (0, tall / 2, -0.8 * radius - depth / 2)
        yield box(place, (radius * rng.uniform(0.45, 0.95), tall / 2, depth / 2))
    style = rng.random()
    if style < 0.25:  # a pedestal
        half = (foot * rng.uniform(1.0, 1.6), rng.uniform(0.03, 0.3), foot * rng.uniform(1.0, 1.6))
        center = (0, -half[1], -behind / 2)
        if round_:
            yield box(center, half)
        else:
            yield cylinder(center, (half[0], half[2], half[1]), TURN_Y)
    elif style < 0.45:  # a mounting plate
        half = (rng.uniform(1.2, 3.0) * foot, rng.uniform(0.005, 0.015), rng.uniform(1.2, 3) * foot)
        shift = (half[2] - foot) * rng.uniform(-0.6, 0.6)
        yield box((0, -half[1], shift), half)


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one arm: a family, its lengths, how its links look, base and end effector."""
    family = _FAMILIES[rng.choice(len(_FAMILIES), p=_SHARES)]
    chain = family(rng)
    size = rng.uniform(0.75, 1.25)
    side = -1.0 if rng.random() < 0.2 else 1.0  # some arms are built the other way round
    paths = tuple(path * (size * np.array([side, 1.0, 1.0])) for path in chain.paths)
    tip = chain.tip * np.sign([side, 1.0, 1.0])
    chain = replace(chain, paths=paths, tip=tip, radius=size * chain.radius)
    style = _style(rng, chain.radius, cast=family is chains.industrial)
    parts = [list(_link(k, chain, style)) for k in range(7)]
    parts[0] += _stand(rng, chain, style.radius[0])
    parts[6] += _effector(rng, chain, style.radius[6])
    return ObjectModel(
        parts,
        axis=np.array([_UNIT[axis] for axis in chain.axes]),
        pivot=np.array([path[0] for path in chain.paths[1:]]),
        limits=np.radians(chain.limits * rng.uniform(0.8, 1.0, (6, 2))),
    )


def _urdf_axes(ref: MeshObject) -> CanonicalAxes:
    """Up along the first axis, from base to shoulder; front where the tip is at rest."""
    base, shoulder, tip = (ref.parts[part].bounds().mean(0) for part in (0, 1, -1))
    reach = tip - base
    up = ref.axis[0] * (1.0 if ref.axis[0] @ (shoulder - base) >= 0 else -1.0)
    level = reach - (reach @ up) * up
    if np.linalg.norm(level) < 0.03 * np.linalg.norm(np.ptp(ref.bounds(), axis=0)):
        # Straight up: x where z is up (robotics), z where y is up (graphics).
        return CanonicalAxes(up, np.roll(along_positive(up), 1), ("front",))
    return CanonicalAxes(up, level)


def _positive_axes(ref: MeshObject) -> np.ndarray:
    """Positive about the canonical axis that is nearest at rest."""
    return np.eye(3)[np.argmax(np.abs(ref.axis), axis=1)]


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
    urdf_rule=UrdfRule(axes=_urdf_axes, opening=_positive_axes, snap=50.0),
)
