"""box: a tray (root) and a lid on a hinge along x; closed at rest, z to the front, y up."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel, Symmetry
from caper_jax.articulation.conversions import ReArtConversion
from caper_jax.articulation.urdf_rule import UrdfRule, X, closed_states, hinged_axes, opens_along
from caper_jax.categories.forms import TURN_X, TURN_Y, UPSIDE_DOWN, open_box
from caper_jax.geometry.solids import Solid, box, cylinder, ellipsoid, frustum

# Positive opens: the lid, in front of the hinge (+z), swings up (+y), which is about -x.
_HINGE = np.array([[-1.0, 0.0, 0.0]])


def _pencil_case(rng: np.random.Generator) -> ObjectModel:
    """Flat cases with the proportions of the eight measured ReArt-48 boxes.

    Measured there, in mm: length 201-243, height 24-38, depth 74-94; lid 7-24 thick, as deep as
    the base within 10 %; hinge 14-54 % of the height below the top and 2-10 % of the depth
    inside the back.
    """
    scale = rng.uniform(0.72, 1.3)
    length = scale * rng.uniform(0.19, 0.25)
    height = scale * rng.uniform(0.022, 0.042)
    depth = scale * rng.uniform(0.068, 0.105)
    wall = scale * rng.uniform(0.002, 0.011)
    lid_depth = depth * rng.uniform(0.9, 1.06)
    lid_length = length * rng.uniform(0.95, 1.02)
    on_top = rng.random() < 0.4
    if on_top:  # a clamshell: the lid is a second, shallower tray
        lid_thickness = height * rng.uniform(0.3, 0.8)
        lid_bottom = height / 2
        hinge_y = height / 2 - height * rng.uniform(-0.1, 0.35)
    else:  # a lid let into the rim, or just over it
        lid_thickness = height * rng.uniform(0.18, 0.55)
        lid_bottom = height / 2 - lid_thickness + scale * rng.uniform(-0.006, 0.004)
        lid_length = min(lid_length, length - 1.2 * wall) if lid_bottom < height / 2 else lid_length
        hinge_y = height / 2 - height * rng.uniform(0.1, 0.45)
    hinge_z = -depth / 2 + depth * rng.uniform(0.0, 0.1)
    # Soft cases are round at the front and the sides.
    edge = scale * rng.uniform(0.004, 0.014) if rng.random() < 0.3 else 0.0

    # Cavity, open at the top. Most cases have an inlay: what shows is its upper side, often
    # halfway up.
    floor = wall if rng.random() < 0.3 else rng.uniform(0.2, 0.7) * height
    if not on_top:  # room for a lid let in
        floor = min(floor, max(wall, lid_bottom - 0.002 + height / 2))
    size = (length, height, depth)
    inset = wall + edge
    if edge:
        base = list(_soft_tray((0.0, 0.0, 0.0), size, edge, wall, floor))
    elif rng.random() < 0.2:
        inset += _slope(rng, size)
        base = [_tapered_tray(size, inset - wall, wall, floor)]
    else:
        base = [open_box((0, 0, 0), np.array(size) / 2, wall, floor)]
    base += _contents(rng, size, inset, floor, lid_bottom)
    if not on_top and rng.random() < 0.5:
        # The back wall with the hinge stays as high as the rim.
        half = (length * rng.uniform(0.2, 0.48), lid_thickness / 2, wall / 2)
        base.append(box((0, height / 2 - lid_thickness / 2, hinge_z - wall / 2), half))
    lid_front = hinge_z + lid_depth
    lid_center = (0.0, lid_bottom + lid_thickness / 2, (hinge_z + lid_front) / 2)
    lid_size = (lid_length, lid_thickness, lid_depth)
    if rng.random() < 0.4:
        # A thin plate; a lip around it makes the lid's box as thick as measured.
        plate = min(scale * rng.uniform(0.002, 0.005), lid_thickness)
        above = (0, lid_bottom + lid_thickness - plate / 2, lid_center[2])
        ahead = (0, lid_center[1], lid_front - plate / 2)
        lid = [
            box(above, (lid_length / 2, plate / 2, lid_depth / 2)),
            box(ahead, (lid_length / 2, lid_thickness / 2, plate / 2)),
        ]
    elif edge and on_top:
        lid_floor = max(0.25 * lid_thickness, 0.002)
        lid = list(_soft_tray(lid_center, lid_size, edge, wall, -lid_floor))
    else:
        lid = [_lid_shell(rng, lid_center, lid_size, wall)]
    if rng.random() < 0.5:
        lid.append(_clasp(rng, lid_center, lid_size, height))
    if not edge and rng.random() < 0.4:
        radius = min(0.5 * lid_thickness, scale * 0.006)
        half_length = length * rng.uniform(0.1, 0.45)
        base.append(cylinder((0, hinge_y, hinge_z), (radius, radius, half_length), TURN_X))
    high = np.radians(rng.uniform(170, 200))
    return _model(base, lid, (0.0, hinge_y, hinge_z), (np.radians(-3), high))


def _chest(rng: np.random.Generator) -> ObjectModel:
    """Deeper boxes: gift boxes, tool boxes and trunks, with plate, lipped or domed lids."""
    length, depth = rng.uniform(0.1, 0.38), rng.uniform(0.08, 0.28)
    height = rng.uniform(0.04, 0.22)
    wall = rng.uniform(0.002, 0.009)
    floor = wall + (0.0 if rng.random() < 0.6 else rng.uniform(0.0, 0.6) * height)
    size = (length, height, depth)
    slope = _slope(rng, size) if rng.random() < 0.3 else 0.0
    if slope:
        base = [_tapered_tray(size, slope, wall, floor)]
    else:
        base = [open_box((0, 0, 0), np.array(size) / 2, wall, floor)]
    base += _contents(rng, size, wall + slope, floor, height / 2)
    thickness = rng.uniform(0.003, 0.012)
    hinge = (0.0, height / 2, -depth / 2)
    style = rng.random()
    if style < 0.3:  # plate, perhaps with a lip that goes into the base
        over = rng.uniform(-0.002, 0.012)
        size = (length + 2 * over, thickness, depth + over)
        lid = [box((0, height / 2 + thickness / 2, over / 2), np.array(size) / 2)]
        if rng.random() < 0.3:
            lip = min(rng.uniform(0.004, 0.015), 0.2 * height)
            inner = (length / 2 - 1.5 * wall - 0.001, lip / 2, depth / 2 - 1.5 * wall - 0.002)
            lid.append(box((0, height / 2 - lip / 2, 0.001), inner))
    elif style < 0.42:  # a lid with sloping sides, as of gift boxes, trunks and caskets
        rise = rng.uniform(0.1, 0.45) * min(depth, 2 * height)
        half = (length / 2, depth / 2, rise / 2)
        hole = box((0, height / 2, 0), (0.6 * half[0], rise * rng.uniform(0.3, 0.7), 0.6 * half[1]))
        taper = rng.uniform(0.62, 0.95, 2)
        lid = [frustum((0, height / 2 + rise / 2, 0), half, taper, TURN_Y, hole=hole)]
    elif style < 0.75:  # a lid with a rim around the base
        rim = height * rng.uniform(0.1, 0.4)
        size = (length + 2 * wall + 0.002, rim + thickness, depth + wall + 0.001)
        center = (0, height / 2 + thickness - size[1] / 2, wall / 2)
        cut = (length / 2 + 0.001, size[1] / 2, depth / 2 + 0.02)
        hole = box((0, center[1] - thickness, -0.02 + 0.0005), cut)
        lid = [box(center, np.array(size) / 2, hole=hole)]
    else:  # a dome: half of an elliptic cylinder along x, hollow
        rise = depth * rng.uniform(0.15, 0.5)
        below = box((0, height / 2 - rise, 0), (length, rise, depth))
        lid = [cylinder((0, height / 2, 0), (depth / 2, rise, length / 2), TURN_X, hole=below)]
    if rng.random() < 0.4:
        lid.append(_clasp(rng, (0, height / 2, 0), (length, 2 * thickness, depth), height))
    elif rng.random() < 0.3:  # a knob to lift it by
        knob = rng.uniform(0.005, 0.011)
        lid.append(ellipsoid((0, height / 2 + knob, depth / 2 + 0.6 * knob), (knob, knob, knob)))
    style = rng.random()
    foot = rng.uniform(0.004, 0.015)
    x, y, z = 0.45 * length - foot - slope, -height / 2 - foot / 2, 0.45 * depth - foot - slope
    if style < 0.15:
        for place in ((-x, y, -z), (-x, y, z), (x, y, -z), (x, y, z)):
            base.append(cylinder(place, (foot, foot, foot / 2), TURN_Y))
    elif style < 0.3:  # runners
        for side in (-x, x):
            base.append(box((side, y, 0), (foot, foot / 2, 0.45 * depth - slope)))
    high = np.radians(rng.uniform(95, 185))
    return _model(base, lid, hinge, (0.0, high))


def _soft_tray(center, size, edge: float, wall: float, floor: float) -> Iterator[Solid]:
    """A tray whose front and sides bulge by ``edge`` meters, flat at the back."""
    length, height, depth = size
    middle = np.asarray(center, float)
    inner = np.array([length - 2 * edge, height, depth - edge])
    yield open_box(middle - (0, 0, edge / 2), inner / 2, wall, floor)
    front = middle + (0, 0, depth / 2 - edge)
    yield cylinder(front, (edge, height / 2, length / 2 - edge), TURN_X)
    for side in (-1, 1):
        end = (side * (length / 2 - edge), 0, 0)
        flank = middle - (0, 0, edge / 2) + end
        yield cylinder(flank, (edge, height / 2, depth / 2 - edge / 2))
        yield ellipsoid(front + end, (edge, height / 2, edge))


def _slope(rng: np.random.Generator, size) -> float:
    """How far, in meters, the walls of a tapered tray come in towards its bottom."""
    length, height, depth = size
    return min(rng.uniform(0.03, 0.15) * height, 0.12 * min(length, depth))


def _tapered_tray(size, slope: float, wall: float, floor: float) -> Solid:
    """An open box that is narrower at the bottom; the cavity has upright walls."""
    half = np.array([size[0], size[2], size[1]]) / 2
    inner = half[:2] - slope - wall
    hole = box((0, floor, 0), (inner[0], half[2], inner[1]))
    return frustum((0, 0, 0), half, 1 - slope / half[:2], UPSIDE_DOWN, hole=hole)


def _lid_shell(rng: np.random.Generator, center, size, wall: float) -> Solid:
    """A plate, or a hollow shell when thick enough."""
    if size[1] > 0.009 and rng.random() < 0.75:
        floor = max(0.25 * size[1], 0.002)
        return open_box(center, np.array(size) / 2, min(wall, 0.2 * size[1]) + 0.001, -floor)
    return box(center, np.array(size) / 2)


def _contents(
    rng: np.random.Generator, size, wall: float, floor: float, top: float
) -> Iterator[Solid]:
    """Dividers, pens and blocks in the tray, below ``top`` (y, meters)."""
    length, height, depth = size
    bottom = -height / 2 + floor
    room = min(top, height / 2) - bottom
    if room < 0.006:
        return
    dividers = rng.integers(0, 3)
    for _ in range(dividers):
        reach = 0.5 * room * rng.uniform(0.4, 0.95)
        if rng.random() < 0.5:
            place = (rng.uniform(-0.35, 0.35) * length, bottom + reach, 0)
            yield box(place, (0.0012, reach, depth / 2 - wall))
        else:
            place = (0, bottom + reach, rng.uniform(-0.3, 0.3) * depth)
            yield box(place, (length / 2 - wall, reach, 0.0012))
    inner = np.array([length, depth]) / 2 - wall
    for _ in range(rng.integers(0, 3 if dividers < 2 else 2)):
        rise = 0.5 * room * rng.uniform(0.2, 0.9)
        spot = rng.uniform(-0.25, 0.25, 2) * (length, depth)
        lying = rng.random() < 0.5  # a pen or a tube
        if lying:
            rise = min(rise, 0.4 * inner[1])
            half = np.array([length * rng.uniform(0.1, 0.22), rise])
        else:
            half = rng.uniform(0.05, 0.2, 2) * (length, depth)
        half = np.minimum(half, 0.9 * inner)
        x, z = np.clip(spot, half - inner, inner - half)
        if lying:
            yield cylinder((x, bottom + rise, z), (rise, rise, half[0]), TURN_X)
        else:
            yield box((x, bottom + rise, z), (half[0], rise, half[1]))


def _clasp(rng: np.random.Generator, center, size, height: float) -> Solid:
    """A tab at the front edge of the lid that hangs over the base's front wall."""
    drop = min(0.5 * height, rng.uniform(0.006, 0.02))
    place = (
        rng.uniform(-0.2, 0.2) * size[0] * (rng.random() < 0.3),
        center[1] + size[1] / 2 - drop / 2,
        center[2] + size[2] / 2 + 0.0015,
    )
    return box(place, (size[0] * rng.uniform(0.03, 0.1), drop / 2, 0.0015))


def _model(base: list[Solid], lid: list[Solid], hinge, limits) -> ObjectModel:
    return ObjectModel([base, lid], _HINGE, np.array([hinge]), np.array([limits]))


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one box: seven in ten are flat cases, the others deeper boxes and trunks."""
    return _pencil_case(rng) if rng.random() < 0.7 else _chest(rng)


BOX = Category(
    name="box",
    parts=("base", "lid"),
    joints=(Joint("revolute", parent=0, limits=(np.radians(-3), np.radians(200))),),
    directions=("x", "z"),
    directions_reason="the hinge line and the way from hinge to front show at any opening angle",
    unit=7.0,
    mean_size=((0.227, 0.062, 0.116), (0.224, 0.022, 0.117)),
    mean_center=((0.0, -0.007, -0.003), (0.0, 0.026, 0.002)),
    shape=shape,
    symmetries=(
        Symmetry(
            permutation=(1, 0),
            rotation=((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
            reason="a case whose lid is as deep as its base may exchange the two",
        ),
    ),
    urdf_rule=UrdfRule(
        rest=closed_states,
        axes=hinged_axes,
        opening=opens_along(-X),
        child_words=("lid", "cover"),
        partnet_classes=("Box",),
    ),
    datasets={
        # The lid lies flat open, 180 deg from closed; the hinge is along y, the lid towards -x.
        "reart": ReArtConversion(
            1,
            ("box",),
            axes=((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
            opening=(0.0, -1.0, 0.0),
            stored_state=lambda _: np.pi,
            test_objects=(0, 1),
        ),
    },
)
