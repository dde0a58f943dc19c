"""stapler: a base (root) and an arm on a hinge along x at its back; closed at rest, y up.

The arm carries magazine, cover and handle; x runs along the hinge, z to the front.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.articulation.conversions import ReArtConversion, StoredObject
from caper_jax.articulation.urdf_rule import UrdfRule, X, closed_states, hinged_axes, opens_along
from caper_jax.categories.forms import TURN_X, TURN_Y, UP, about, beam, rotated
from caper_jax.geometry.solids import Solid, box, cylinder, ellipsoid

# Positive opens: the arm, in front of the hinge (+z), swings up (+y), which is about -x.
_HINGE = np.array([[-1.0, 0.0, 0.0]])
_OPEN = np.radians(60)

# Probability, length and width of the base in meters, scale of the thicknesses. "half" are those
# of the seven ReArt-48 staplers: base 120-162 x 34-42 mm and 28-35 high with the hinge's cheeks,
# hinge 2-10 mm inside the back and 23-29 mm above the underside, arm 27-32 mm wide.
_TYPES = {
    "half": (0.42, (0.105, 0.17), (0.028, 0.045), (0.8, 1.2)),
    "desk": (0.2, (0.15, 0.215), (0.032, 0.048), (0.9, 1.3)),
    "mini": (0.12, (0.045, 0.08), (0.017, 0.03), (0.55, 0.85)),
    "long": (0.08, (0.28, 0.42), (0.036, 0.06), (1.0, 1.4)),
    "heavy": (0.1, (0.22, 0.32), (0.05, 0.085), (1.4, 2.2)),
    "plier": (0.08, (0.08, 0.12), (0.016, 0.026), (0.9, 1.3)),
}


@dataclass(frozen=True)
class _Plan:
    """Measures in meters; the underside of the base is y = 0, the hinge z = 0, x is centered."""

    scale: float  # of thicknesses and small parts, 1 for an office stapler
    back: float  # z of the ends of the base
    front: float
    width: float  # of its plate
    plate: float  # its thickness
    hinge: float  # height of the hinge
    under: float  # y of the underside of the arm
    magazine: float  # heights of the magazine and the cover
    cover: float
    arm: float  # its width
    head: float  # z of the back and the front of its head
    reach: float


def _draw_plan(rng: np.random.Generator, name: str) -> _Plan:
    _, lengths, widths, scales = _TYPES[name]
    length, width, scale = rng.uniform(*lengths), rng.uniform(*widths), rng.uniform(*scales)
    back = -length * rng.uniform(0.02, 0.09)
    front = length + back
    plate = scale * rng.uniform(0.0035, 0.0105)
    under = plate + scale * rng.uniform(0.002, 0.009)
    magazine = scale * rng.uniform(0.006, 0.012)
    reach = front * rng.uniform(0.88, 1.04)
    head = back * rng.uniform(0.2, 1.0)
    if name == "long":  # the head is as long as that of an office stapler, at the end of a bar
        head = reach - rng.uniform(0.09, 0.15)
    return _Plan(
        scale=scale,
        back=back,
        front=front,
        width=width,
        plate=plate,
        hinge=under + magazine * rng.uniform(0.4, 1.3),
        under=under,
        magazine=magazine,
        cover=scale * rng.uniform(0.007, 0.02) * (1.4 if name == "heavy" else 1.0),
        arm=width * rng.uniform(0.62, 0.93),
        head=head,
        reach=reach,
    )


def _base(rng: np.random.Generator, plan: _Plan, name: str) -> Iterator[Solid]:
    """Plate with rounded or tapered ends, anvil, what stands under it and what carries the pin."""
    half, middle = plan.width / 2, (plan.front + plan.back) / 2
    foot = 0.0
    if rng.random() < 0.4:  # a rubber sole a little smaller than the plate, or four pads
        foot = plan.plate * rng.uniform(0.2, 0.5)
        share = rng.uniform(0.8, 0.97)
        if rng.random() < 0.6:
            reach = share * (plan.front - plan.back) / 2
            yield box((0, foot / 2, middle), (share * half, foot / 2, reach))
        else:
            for x in (-1, 1):
                for z in (plan.back + 0.8 * half, plan.front - 0.8 * half):
                    place = (x * half * 0.7, foot / 2, z)
                    yield cylinder(place, (half * 0.25, half * 0.25, foot / 2), TURN_Y)
    thick = plan.plate - foot
    level = foot + thick / 2
    nose = half * rng.uniform(0.3, 1.0) if rng.random() < 0.65 else 0.0
    body = (plan.back, plan.front - nose)
    narrow = rng.uniform(0.7, 1.0) if rng.random() < 0.4 else 1.0
    if name == "long":  # a bar that widens to a table under the head
        bar = max(half * rng.uniform(0.5, 0.9), plan.arm / 2 + 0.001)
        table = (plan.head + plan.back) / 2
        reach = (table - plan.back) / 2 + 0.002
        yield box((0, level, (plan.back + table) / 2), (bar, thick / 2, reach))
        body = (table, plan.front - nose)
    start, end = (0.0, level, body[0]), (0.0, level, body[1])
    yield beam(start, end, (half, thick / 2), UP, (narrow, 1.0) if narrow < 1.0 else None)
    if nose:
        round_ = (narrow * half, nose, thick / 2)
        yield cylinder((0, level, body[1]), round_, TURN_Y)
    yield from _anvil(rng, plan)
    yield from _cheeks(rng, plan)
    if rng.random() < 0.3:  # the leaf spring that keeps the arm up
        first = plan.back + (plan.front - plan.back) * rng.uniform(0.3, 0.45)
        last = first + (plan.front - plan.back) * rng.uniform(0.15, 0.3)
        section = (half * rng.uniform(0.1, 0.25), 0.0004)
        rise = (0, plan.under - 0.0008, last)
        yield beam((0, plan.plate - 0.0005, first), rise, section, UP)


def _anvil(rng: np.random.Generator, plan: _Plan) -> Iterator[Solid]:
    """The plate with two grooves under the head, that bends the staples."""
    gap = plan.under - plan.plate
    height = gap * rng.uniform(0.15, 0.7)
    half = plan.width / 2 * rng.uniform(0.35, 0.8), plan.scale * rng.uniform(0.004, 0.009)
    place = min(plan.reach, plan.front - 0.3 * plan.width) - half[1]
    groove = None
    if rng.random() < 0.7:
        depth = min(0.5 * height, 0.0015)
        extents = (half[0] * 0.6, depth, half[1] * rng.uniform(0.2, 0.4))
        groove = box((0, plan.plate + height, place), extents)
    # Sunk into the plate so that it is one piece with it.
    center = (0, plan.plate + height / 2 - 0.0005, place)
    yield box(center, (half[0], height / 2 + 0.0005, half[1]), hole=groove)


def _cheeks(rng: np.random.Generator, plan: _Plan) -> Iterator[Solid]:
    """Two cheeks beside the arm, or a block between its sides, and the pin of the hinge."""
    radius = plan.scale * rng.uniform(0.0015, 0.004)
    top = plan.hinge + radius * rng.uniform(0.8, 2.0)
    thick = max(plan.scale * rng.uniform(0.001, 0.003), (plan.width - plan.arm) / 2 - 0.0005)
    inner = plan.arm / 2 + 0.0004
    depth = plan.front * rng.uniform(0.08, 0.3)
    back = plan.back * rng.uniform(0.6, 1.0)
    bottom = plan.plate * 0.5
    style, narrow = rng.random(), rng.uniform(0.3, 0.9)
    for side in (-1, 1):
        x = side * (inner + thick / 2)
        if style < 0.4:
            center = (x, (top + bottom) / 2, (back + depth) / 2)
            yield box(center, (thick / 2, (top - bottom) / 2, (depth - back) / 2))
        elif style < 0.75:  # narrower at the top, which still holds the pin
            middle, reach = (depth + back) / 2, (depth - back) / 2
            share = max(narrow, min(1.0, (middle + radius) / reach))
            start, end = (x, bottom, middle), (x, top, middle)
            yield beam(start, end, (thick / 2, reach), (0.0, 0.0, 1.0), (1.0, share))
        else:  # round about the pin
            round_ = (top - plan.plate * 0.6) / 2
            center = (x, plan.plate * 0.6 + round_, 0)
            half = (round_, round_ * rng.uniform(0.9, 1.3), thick / 2)
            yield cylinder(center, half, about("x", np.pi / 2) @ TURN_X)
    length = inner + thick * rng.uniform(1.0, 1.2)
    yield cylinder((0, plan.hinge, 0), (radius, radius, length), TURN_X)


def _cover(rng: np.random.Generator, plan: _Plan) -> Iterator[Solid]:
    """The cover over the magazine, from back to front; its underside is level before tilting."""
    bottom, height, half = plan.under + 0.55 * plan.magazine, plan.cover, plan.arm / 2
    back, front = plan.head, plan.reach
    middle, reach = (back + front) / 2, (front - back) / 2
    below = box((0, bottom - 2 * height, middle), (plan.width, 2 * height, 2 * reach))
    style = rng.random()
    narrow, low = rng.uniform(0.6, 1.0), rng.uniform(0.4, 1.0)
    if style < 0.2:  # a bar, its front perhaps rounded
        narrow = low = 1.0
        yield box((0, bottom + height / 2, middle), (half, height / 2, reach))
    elif style < 0.45:  # falling and narrowing to the front
        start, end = (0, bottom + height / 2, back), (0, bottom + low * height / 2, front)
        yield beam(start, end, (half, height / 2), UP, (narrow, low))
    elif style < 0.6:  # half round
        low, narrow = 1.0, rng.uniform(0.75, 1.0)
        yield cylinder((0, bottom, middle), (half, height, reach), hole=below)
    elif style < 0.78:  # arched like a bow
        yield ellipsoid((0, bottom, middle), (half, 1.25 * height, 1.06 * reach), hole=below)
    else:  # a hump for the hand, at the back or towards the front
        at = back + 2 * reach * rng.uniform(0.3, 0.7)
        rear = rng.uniform(0.4, 0.9)
        top, section = (0, bottom + height / 2, at), (half, height / 2)
        yield beam(top, (0, bottom + rear * height / 2, back), section, UP, (1.0, rear))
        yield beam(top, (0, bottom + low * height / 2, front), section, UP, (narrow, low))
    if not 0.6 <= style < 0.78 and rng.random() < 0.6:
        radii = (narrow * half, half * rng.uniform(0.3, 1.0), low * height / 2)
        yield cylinder((0, bottom + low * height / 2, front), radii, TURN_Y)
    if rng.random() < 0.3:  # a pad for the hand
        length = reach * rng.uniform(0.15, 0.35)
        place = (0, bottom + 0.55 * low * height, front - length - 0.1 * reach)
        rise = height * rng.uniform(0.5, 0.6)
        yield box(place, (0.75 * narrow * half, rise, length))


def _arm(rng: np.random.Generator, plan: _Plan, name: str) -> Iterator[Solid]:
    """Magazine, cover and nose plate, perhaps a bar that carries them or a lever above them."""
    half = plan.arm / 2
    inner = half * rng.uniform(0.5, 0.95)
    # The corner below and behind the hinge must pass the plate when the arm swings up.
    below, room = plan.hinge - plan.under, plan.hinge - plan.plate - 0.0005
    behind = min(-plan.back * 0.9, np.sqrt(max(room**2 - below**2, 0.0)))
    start = plan.head if name == "long" else -behind
    front = plan.reach - plan.scale * rng.uniform(-0.001, 0.004)
    level = plan.under + plan.magazine / 2
    place = (0, level, (start + front) / 2)
    yield box(place, (inner, plan.magazine / 2, (front - start) / 2))
    tilt = np.radians(rng.uniform(0.5, 7)) if rng.random() < 0.5 and name != "long" else 0.0
    for solid in _cover(rng, plan):
        yield rotated(solid, about("x", -tilt), (0.0, plan.hinge, 0.0))
    if rng.random() < 0.5:  # the plate at the nose behind which the staples are driven down
        rise = (plan.magazine + plan.cover * rng.uniform(0.1, 0.4)) / 2
        yield box((0, plan.under + rise, front), (inner * 0.9, rise, plan.scale * 0.0008))
    if name == "long":
        section = (half * rng.uniform(0.4, 0.9), plan.magazine * rng.uniform(0.35, 0.5))
        yield beam((0, plan.hinge, 0), (0, level, plan.head + 0.02), section, UP)
    if name == "heavy":
        yield from _lever(rng, plan)
    # What turns on the pin, between the cheeks.
    radius = min(0.8 * room, 0.5 * plan.magazine)
    yield cylinder((0, plan.hinge, 0), (radius, radius, half), TURN_X)


def _lever(rng: np.random.Generator, plan: _Plan) -> Iterator[Solid]:
    """The long lever of heavy staplers, over the cover and perhaps beyond it."""
    reach, top = plan.reach, plan.under + plan.magazine
    foot = (0.0, top, reach * rng.uniform(0.05, 0.3))
    high = top + plan.cover + plan.scale * rng.uniform(0.004, 0.02)
    knee = (0.0, high, reach * rng.uniform(0.5, 0.7))
    tip = (0.0, high + plan.scale * rng.uniform(-0.006, 0.012), reach * rng.uniform(0.9, 1.3))
    section = (plan.arm * rng.uniform(0.12, 0.35), plan.scale * rng.uniform(0.002, 0.005))
    grip = (min(1.15 * section[0], 0.02), 1.3 * section[1] + 0.001)
    yield beam(foot, knee, section, UP)
    yield beam(knee, tip, grip, UP, round_=rng.random() < 0.5)


def _plier(rng: np.random.Generator, plan: _Plan) -> tuple[list[Solid], list[Solid]]:
    """Stapling pliers: each part is a jaw in front of the pin and a handle behind it.

    As in any pliers the parts cross at the pin: the lower jaw goes on as the upper handle, so
    that the handles part when the jaws do.
    """
    half, scale = plan.width / 2, plan.scale
    pin = (0.0, plan.hinge, 0.0)
    thick = plan.plate / 2
    base = [beam((0, thick, 0), (0, thick, plan.front), (half, thick), UP)]
    base += _anvil(rng, plan)
    wall = half * rng.uniform(0.12, 0.2)
    for side in (-1, 1):  # its sides rise to the pin and carry the handle
        place = (side * (half - wall / 2), plan.hinge / 2 + thick / 2, 0.0)
        base.append(box(place, (wall / 2, plan.hinge / 2 + thick / 2, 0.012 * scale)))
    inner = half - wall - 0.0004
    level = plan.under + plan.magazine / 2
    length = plan.front * rng.uniform(0.94, 1.02)
    arm = [box((0, level, length / 2), (inner, plan.magazine / 2, length / 2))]
    head = length * rng.uniform(0.2, 0.45)
    rise = plan.cover / 2 + plan.magazine / 2
    half_head = (inner * rng.uniform(0.9, 1.15), rise, head)
    arm.append(box((0, plan.under + rise, length - head), half_head))
    radius = scale * rng.uniform(0.002, 0.004)
    base.append(cylinder(pin, (radius, radius, 1.1 * half), TURN_X))

    reach = -rng.uniform(0.08, 0.13)
    spread = np.radians(rng.uniform(16, 26))
    section = (half * rng.uniform(0.75, 0.95), scale * rng.uniform(0.003, 0.006))
    round_ = rng.random() < 0.4
    for solids, sense in ((base, 1.0), (arm, -1.0)):
        width = section[0] if solids is base else min(section[0], inner)
        angle = sense * spread / 2 + np.radians(4)
        bend = np.array([0.0, plan.hinge - reach * 0.45 * np.sin(angle), reach * 0.45])
        tip = bend + (0.0, -reach * 0.55 * np.sin(0.4 * angle), reach * 0.55)
        start = np.array(pin) + (0.0, sense * section[1], 0.0)
        solids.append(beam(start, bend, (width, section[1]), UP))
        solids.append(beam(bend, tip, (width, section[1]), UP, round_=round_))
    return base, arm


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one stapler; four in ten have the proportions of the ReArt-48 ones."""
    name = str(rng.choice(list(_TYPES), p=[row[0] for row in _TYPES.values()]))
    plan = _draw_plan(rng, name)
    if name == "plier":
        base, arm = _plier(rng, plan)
        high = np.radians(rng.uniform(14, 25))
    else:
        base, arm = list(_base(rng, plan, name)), list(_arm(rng, plan, name))
        high = min(np.radians(rng.uniform(30, 90)), _OPEN)
    pivot = np.array([[0.0, plan.hinge, 0.0]])
    return ObjectModel([base, arm], _HINGE, pivot, np.array([[0.0, high]]))


def _stored_opening(stored: StoredObject) -> float:
    """Angle by which a stapler of ReArt-48 is open as the file stores it.

    The hinge is along x at the back (-y) of the base, the arm leans back over it, and a box about
    a leaning arm does not tell its angle. Here the closed arm's tip, in the file the corner of its
    box farthest from the hinge, lies a third of the hinge's height below the hinge: the seven
    public models then are open by 151-161 deg, 110-142 mm long and 23-30 high, and end 1-8 mm
    behind the base's front. Other plausible rules differ by up to 5 deg, and so do rest pose and
    states. Closed, an arm is taken to be a bar along the base; its size is that of the bar whose
    leaning box is the one in the file.
    """
    hinge, lowest = stored.pivot[0], stored.low[0, 2]
    ends = np.array([stored.low[1], stored.high[1]]) - hinge
    farthest = np.abs(ends).argmax(0)
    along, above = ends[farthest[1], 1], ends[farthest[2], 2]
    reach = np.hypot(along, above)
    drop = min((hinge[2] - lowest) / 3, reach)
    return float(np.arctan2(above, along) + np.arcsin(drop / reach))


STAPLER = Category(
    name="stapler",
    parts=("base", "arm"),
    joints=(Joint("revolute", parent=0, limits=(0.0, _OPEN)),),
    directions=("y", "z"),
    stands=False,
    directions_reason="mirror-symmetric in the y-z plane, so y and z are what the shape shows",
    unit=10.4,
    mean_size=((0.04, 0.028, 0.176), (0.03, 0.031, 0.175)),
    mean_center=((0.0, -0.008, -0.002), (0.0, 0.006, 0.0)),
    shape=shape,
    urdf_rule=UrdfRule(
        rest=closed_states,
        axes=hinged_axes,
        opening=opens_along(-X),
        partnet_classes=("Stapler",),
    ),
    datasets={
        "reart": ReArtConversion(
            2,
            ("stapler",),
            axes=((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
            opening=(1.0, 0.0, 0.0),
            stored_state=_stored_opening,
            square_at_rest=True,
            test_objects=(10, 11),
        ),
    },
)
