"""scissors: two blades on a pivot along y; x to the tips, blades 20 deg apart at rest.

The frame and the root follow from the object itself:

* x halves the angle between the blades; a blade's line runs from the pivot to its tip.
* The root is the blade whose handle reaches farther back (for more fingers, or with a finger
  rest). Of equal halves either is: a half turn about x exchanges them (the declared symmetry).
* y points to where the root's tip lies to the right (+z) of x. So the root's tip is at +z, its
  handle (unless bent) at -z, and right-handed scissors have the root on top (+y).
* A positive state turns the other blade about +y: its tip goes to -z, the scissors open. The
  whole opening is 20 deg plus the state.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel, Symmetry, Viewpoint
from caper_jax.articulation.conversions import (
    ArtImageConversion,
    AxisMap,
    CaptraConversion,
    ReArtConversion,
    RestObject,
)
from caper_jax.categories.forms import TURN_Y, UP, about, beam, chain, mirrored, rotated
from caper_jax.categories.scissors_urdf import URDF_RULE
from caper_jax.errors import CaperError
from caper_jax.geometry.solids import Solid, box, cylinder

_HALF_TURN = np.diag([1.0, -1.0, -1.0])
_REST = np.radians(20.0)
_CLOSED, _WIDE = np.radians(3.0), np.radians(60.0)


@dataclass(frozen=True)
class _Half:
    """One blade with its handle, closed: tip at +x, handle at -x and -z; lengths in meters."""

    blade: float  # from the pivot to the tip
    width: float  # of the blade at the pivot
    tip: float  # width of the blade at its tip
    belly: float  # where the blade starts to narrow, as a share of its length
    round_tip: bool  # a disc as wide as ``tip`` ends the blade
    metal: float  # thickness of the blade
    shank: float  # from the pivot to the handle's loop
    # (a, b) half extents of the opening for the fingers, along and across the handle.
    loop: tuple[float, float]
    # Share of the opening's half width that its inner side is flattened to, 1 for an oval.
    flat: float
    egg: float  # how much wider the loop is towards its end than its middle
    tube: tuple[float, float]  # (half width, half thickness) of the loop's section
    ring: bool  # a ring with upright sides instead of a round tube
    splay: float  # angle of the loop to the handle's line, radians
    gap: float  # least distance of the handle from the middle when closed
    # (half width, half thickness) of the plastic around the shank, or None.
    sheath: tuple[float, float] | None
    screw: tuple[float, float]  # (radius, height) of the disc at the pivot
    teeth: int = 0  # number of bosses on the inner side of the shank
    rest: float = 0.0  # length of the finger rest behind the loop, or 0
    bend: float = 0.0  # angle of the handle to the blade, radians; positive turns it to +z


def _blade(half: _Half) -> Iterator[Solid]:
    """Above the plane y = 0 in which the blades meet; the line to the tip is the x axis."""
    y, across = half.metal / 2, half.metal / 2
    heel = np.array([-0.55 * half.width, y, 0.0])
    neck = np.array([half.belly * half.blade, y, 0.0])
    reach = half.blade - (half.tip / 2 if half.round_tip else 0.0)
    point = np.array([reach, y, 0.0])
    wide = half.width / 2
    waist = wide + (half.tip / 2 - wide) * 0.45 * half.belly
    yield beam(heel, neck, (wide, across), UP, (waist / wide, 1.0))
    yield beam(neck, point, (waist, across), UP, (half.tip / 2 / waist, 1.0))
    if half.round_tip:
        yield cylinder(point, (half.tip / 2, half.tip / 2, across), TURN_Y)
    radius, height = half.screw
    extents = (radius, radius, (half.metal + height) / 2)
    yield cylinder((0, half.metal / 2 + height / 2, 0), extents, TURN_Y)


def _loop(half: _Half) -> tuple[Iterable[Solid], np.ndarray]:
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
        return chain(middle, half.tube, UP, closed=True, round_=True), middle
    turn_flat = splay @ TURN_Y
    outer = (a + half.tube[0], b + half.tube[0], half.tube[1])
    hole = cylinder(center, (*half.loop, 2 * half.tube[1]), turn_flat)
    return [cylinder(center, outer, turn_flat, hole)], middle


def _handle(half: _Half) -> Iterator[Solid]:
    """Shank, sheath, loop and what is on them, in line with the blade (before the bend)."""
    loop, middle = _loop(half)
    yield from loop
    width = half.sheath[0] if half.sheath else 0.3 * half.width
    start = np.array([-0.3 * half.width, half.metal / 2, 0.0])
    # Behind the pivot the shank bends to its own side of the middle.
    elbow = np.array([-0.35 * half.shank - 0.3 * half.width, 0.0, -half.gap - width])
    nearest = middle[np.argmin(np.linalg.norm(middle - elbow, axis=1))]
    tang = (0.36 * half.width, half.metal / 2)
    yield beam(start, elbow + (0, half.metal / 2, 0), tang, UP)
    way = nearest - elbow
    if half.sheath:
        taper = np.minimum(1.0, np.array(half.tube) / half.sheath)
        yield beam(elbow - 0.1 * way, nearest, half.sheath, UP, taper)
    else:
        thick = max(half.metal / 2, 0.7 * half.tube[1])
        yield beam(elbow - 0.1 * way, nearest, (width, thick), UP, (0.8, 1.0))
    for tooth in range(half.teeth):
        place = elbow + way * (0.3 + 0.35 * tooth) + (0, 0, 0.45 * width)
        size = (0.12 * np.abs(way[0]), 0.5 * half.tube[1], 0.5 * width)
        yield box(place, size)
    if half.rest:
        end = middle[np.argmin(middle[:, 0])]
        out = np.array([-0.9 * half.rest, 0.0, -0.45 * half.rest])
        yield beam(end, end + out, half.tube, UP, round_=True)


def _office(rng: np.random.Generator) -> tuple[_Half, _Half]:
    """Household and office scissors, metal or with plastic handles, 120-230 mm."""
    blade = rng.uniform(0.052, 0.105)
    plastic = rng.random() < 0.75
    tube = rng.uniform(0.0022, 0.0046), rng.uniform(0.003, 0.009)
    if not plastic:
        tube = rng.uniform(0.0016, 0.0028), rng.uniform(0.0015, 0.003)
    width = rng.uniform(0.09, 0.17) * blade + 0.003
    half = _Half(
        blade=blade,
        width=width,
        tip=rng.uniform(0.0012, 0.35 * width),
        belly=rng.uniform(0.3, 0.7),
        round_tip=rng.random() < 0.25,
        metal=rng.uniform(0.001, 0.0026),
        shank=blade * rng.uniform(0.22, 0.5),
        loop=(rng.uniform(0.011, 0.021), rng.uniform(0.008, 0.0125)),
        flat=rng.uniform(0.55, 1.0),
        egg=rng.uniform(-0.15, 0.25),
        tube=tube,
        ring=rng.random() < 0.35,
        splay=np.radians(rng.uniform(0, 25)),
        gap=rng.uniform(0.0004, 0.002),
        sheath=(rng.uniform(0.0035, 0.006), tube[1] * rng.uniform(0.8, 1.1)) if plastic else None,
        screw=(rng.uniform(0.002, 0.0045), rng.uniform(0.0004, 0.0025)),
    )
    if rng.random() < 0.55:
        return half, half
    return _uneven(rng, half, half.loop[0] * rng.uniform(1.12, 1.9), rng.uniform(1.05, 1.25))


def _kitchen(rng: np.random.Generator) -> tuple[_Half, _Half]:
    """Broad and short-bladed, with big loops and often a bottle opener between the handles."""
    half, _ = _office(rng)
    tube = rng.uniform(0.0028, 0.005), rng.uniform(0.0045, 0.0075)
    half = replace(
        half,
        blade=rng.uniform(0.075, 0.11),
        width=rng.uniform(0.016, 0.027),
        tip=rng.uniform(0.003, 0.008),
        metal=rng.uniform(0.0018, 0.003),
        shank=rng.uniform(0.03, 0.05),
        loop=(rng.uniform(0.018, 0.03), rng.uniform(0.01, 0.015)),
        tube=tube,
        sheath=(rng.uniform(0.005, 0.009), tube[1] * rng.uniform(0.9, 1.1)),
        screw=(rng.uniform(0.004, 0.0075), rng.uniform(0.001, 0.003)),
        teeth=int(rng.integers(0, 3)),
    )
    if rng.random() < 0.45:
        return half, half
    return _uneven(rng, half, half.loop[0] * rng.uniform(1.15, 1.6), rng.uniform(1.0, 1.2))


def _child(rng: np.random.Generator) -> tuple[_Half, _Half]:
    """Short, blunt and round-tipped, with plastic loops that are large for the blades."""
    half, _ = _office(rng)
    tip = rng.uniform(0.005, 0.01)
    tube = rng.uniform(0.0025, 0.004), rng.uniform(0.003, 0.006)
    half = replace(
        half,
        blade=rng.uniform(0.045, 0.068),
        width=max(rng.uniform(0.011, 0.017), 1.1 * tip),
        tip=tip,
        round_tip=True,
        metal=rng.uniform(0.0012, 0.0035),
        shank=rng.uniform(0.014, 0.028),
        tube=tube,
        sheath=(rng.uniform(0.0035, 0.006), tube[1] * rng.uniform(0.8, 1.1)),
    )
    if rng.random() < 0.75:
        return half, half
    return _uneven(rng, half, half.loop[0] * rng.uniform(1.3, 1.6), rng.uniform(1.0, 1.2))


def _tailor(rng: np.random.Generator) -> tuple[_Half, _Half]:
    """Long shears whose handles are bent upwards, for four fingers and for the thumb."""
    half, _ = _office(rng)
    tube = rng.uniform(0.003, 0.0048), rng.uniform(0.0045, 0.0075)
    blade = rng.uniform(0.09, 0.145)
    half = replace(
        half,
        blade=blade,
        width=rng.uniform(0.016, 0.026),
        tip=rng.uniform(0.0025, 0.007),
        metal=rng.uniform(0.002, 0.0035),
        shank=blade * rng.uniform(0.28, 0.45),
        loop=(rng.uniform(0.013, 0.018), rng.uniform(0.011, 0.0145)),
        tube=tube,
        sheath=(rng.uniform(0.0055, 0.0085), tube[1] * rng.uniform(0.8, 1.1)),
        screw=(rng.uniform(0.004, 0.007), rng.uniform(0.001, 0.004)),
        bend=np.radians(rng.uniform(6, 24)),
    )
    root, other = _uneven(rng, half, rng.uniform(0.026, 0.04), rng.uniform(1.0, 1.3))
    # The finger half is the broader one and has the blunter tip.
    return replace(root, tip=root.tip * rng.uniform(1.0, 1.6)), other


def _hair(rng: np.random.Generator) -> tuple[_Half, _Half]:
    """Slim, all metal, with small round loops on long shanks; perhaps a finger rest."""
    half, _ = _office(rng)
    width = rng.uniform(0.006, 0.01)
    radius = rng.uniform(0.0095, 0.0125)
    half = replace(
        half,
        blade=rng.uniform(0.055, 0.095),
        width=width,
        tip=rng.uniform(0.001, 0.002),
        belly=rng.uniform(0.1, 0.4),
        round_tip=False,
        metal=rng.uniform(0.0014, 0.0026),
        shank=rng.uniform(0.035, 0.065),
        loop=(radius, radius * rng.uniform(0.85, 1.0)),
        flat=1.0,
        egg=0.0,
        tube=(rng.uniform(0.0016, 0.0026), rng.uniform(0.0016, 0.0028)),
        sheath=None,
        screw=(rng.uniform(0.002, 0.0035), rng.uniform(0.0004, 0.002)),
    )
    if rng.random() < 0.5:
        return half, half
    offset = half.shank * rng.uniform(0.0, 0.25)  # the thumb's shank may be shorter
    return (
        replace(half, rest=rng.uniform(0.009, 0.018)),
        replace(half, shank=half.shank - offset),
    )


def _nail(rng: np.random.Generator) -> tuple[_Half, _Half]:
    """Nail and embroidery scissors: all metal, 80-120 mm, short pointed blades."""
    half, _ = _hair(rng)
    half = replace(
        half,
        rest=0.0,
        blade=rng.uniform(0.022, 0.045),
        width=rng.uniform(0.005, 0.0085),
        shank=rng.uniform(0.018, 0.036),
        tip=rng.uniform(0.001, 0.0018),
        tube=(rng.uniform(0.0014, 0.0022), rng.uniform(0.0014, 0.0024)),
    )
    return half, half


def _uneven(
    rng: np.random.Generator, half: _Half, length: float, wider: float
) -> tuple[_Half, _Half]:
    """The half with a loop for several fingers (``length`` its half length), and that half."""
    large = replace(
        half,
        loop=(length, half.loop[1] * wider),
        flat=half.flat * rng.uniform(0.8, 1.0),
        ring=half.ring and rng.random() < 0.5,
        splay=half.splay * rng.uniform(0.3, 1.0),
    )
    return large, half


_KINDS = (_office, _kitchen, _child, _tailor, _hair, _nail)
_SHARES = (0.48, 0.12, 0.12, 0.12, 0.1, 0.06)


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one pair; half of them have equal halves, one in ten is left-handed."""
    kind = _KINDS[rng.choice(len(_KINDS), p=_SHARES)]
    root_half, other_half = kind(rng)
    other_half = replace(other_half, bend=-other_half.bend)  # the same way, after the half turn
    parts = []
    for half, side, angle in (
        (root_half, np.eye(3), -_REST / 2),
        (other_half, _HALF_TURN, _REST / 2),
    ):
        handle = (rotated(solid, about("y", half.bend)) for solid in _handle(half))
        half_turned = (rotated(solid, side) for solid in (*_blade(half), *handle))
        parts.append([rotated(solid, about("y", angle)) for solid in half_turned])
    if rng.random() < 0.1:
        parts = [[mirrored(solid, "y") for solid in part] for part in parts]
    widest = rng.uniform(np.radians(42), _WIDE)
    limits = np.array([(_CLOSED - _REST, widest - _REST)])
    return ObjectModel(parts, np.array([UP]), np.zeros((1, 3)), limits)


def _file_axes(rest: RestObject, where: str) -> AxisMap:
    """x to the tips, y along the pivot, about which positive opens: scissors of ArtImage.

    The official files align scissors one by one, to a frame that no public source states. The tips
    are the side on which the two parts are slimmer. The rest pose is the file's, whose opening is
    not known to be our 20 deg.
    """
    axis = rest.axis[0]
    # Any frame with the axis as its second direction.
    helper = np.eye(3)[np.abs(axis).argmin()]
    across = helper - (helper @ axis) * axis
    across /= np.linalg.norm(across)
    plane = np.stack([across, np.cross(across, axis)])
    flat = [(part - rest.pivot[0]) @ plane.T for part in rest.points]
    everything = np.concatenate(flat)
    length = np.abs(everything).max()
    if length == 0:
        raise CaperError(f"{where}: no scissors, all points of their parts coincide")
    _, vectors = np.linalg.eigh(everything.T @ everything)
    candidates = [vectors[:, 1], -vectors[:, 1]]
    if np.abs(axis).max() > np.cos(np.radians(1)):
        # The file's axes serve, where the axis of the joint is one of them.
        others = np.delete(np.eye(3), np.abs(axis).argmax(), axis=0) @ plane.T
        nearest = others[np.abs(others @ vectors[:, 1]).argmax()]
        candidates = [nearest, -nearest]
    tips = min(candidates, key=lambda ahead: sum(_width(part, ahead) for part in flat))

    aside = np.array([tips[1], -tips[0]])  # axis x tips, in the plane's coordinates
    gap = np.diff([part[(part @ tips).argmax()] @ aside for part in flat])[0]
    opening = np.sign(gap) if np.abs(gap) > 0.02 * length else rest.opening[0]
    x, y = tips @ plane, opening * axis
    return AxisMap(np.stack([x, y, np.cross(x, y)]), (0, 1), np.array([opening]))


def _width(part: np.ndarray, ahead: np.ndarray) -> float:
    """Width of the outer half of one blade [n, 2] on the side ``ahead`` [2] of the pivot."""
    along = part @ ahead
    outer = part[along > 0.5 * along.max()]
    if len(outer) == 0:
        return 0.0
    middle = (outer.min(0) + outer.max(0)) / 2
    return float(np.ptp(outer @ np.array([middle[1], -middle[0]])) / np.linalg.norm(middle))


_COS, _SIN = float(np.cos(np.radians(80))), float(np.sin(np.radians(80)))
SCISSORS = Category(
    name="scissors",
    parts=("root blade", "other blade"),
    joints=(Joint("revolute", parent=0, limits=(_CLOSED - _REST, _WIDE - _REST)),),
    directions=("x", "y"),
    stands=False,
    directions_reason="the way to the tips and the normal of the flat face show at any opening",
    unit=10.6,
    mean_size=((0.164, 0.01, 0.06), (0.151, 0.01, 0.063)),
    mean_center=((0.0, 0.0, -0.016), (0.006, 0.0, 0.014)),
    shape=shape,
    viewpoint=Viewpoint(either_side=True),
    symmetries=(
        Symmetry(
            permutation=(1, 0),
            rotation=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
            reason="equal halves change places by a half turn about x",
            # Halves that differ have other handles, by more than this in length or width.
            tolerance=0.05,
        ),
    ),
    urdf_rule=URDF_RULE,
    datasets={
        "artimage": ArtImageConversion(
            5, (10449, 10502, 10569, 10907), _file_axes, moved_by_base=True
        ),
        "captra": CaptraConversion("scissors", (10559, 10564, 11029)),
        # The blades cross at 90 deg, along y and x. A handle's loop lies on the outer side of its
        # blade's line, which settles the way they close (the second turns by +z towards the first)
        # but not which ends are the tips: a half turn about the pivot gives the same boxes. They
        # are taken to be those at +y and +x, nearer the pivot or as near in all public models but
        # one (by 2 mm): the handles of paper scissors reach at least as far as their blades. The
        # boxes are turned by 10 deg to our rest pose and enclose the parts more loosely there. The
        # first link is the root. Our x is half way between the tips at rest, 80 and 100 deg from
        # the file's x.
        "reart": ReArtConversion(
            5,
            ("scissor", "scissors"),
            axes=((_COS, _SIN, 0.0), (0.0, 0.0, -1.0), (-_SIN, _COS, 0.0)),
            opening=(0.0, 0.0, -1.0),
            stored_state=lambda _: np.radians(90) - _REST,
            test_objects=(40, 41),
        ),
    },
)
