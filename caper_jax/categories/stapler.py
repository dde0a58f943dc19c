"""stapler: a base (root) and an arm on a hinge along x at its back; closed at rest, y up.

The arm carries magazine, cover and handle; x runs along the hinge, z to the front.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.categories.forms import about, beam, rotated
from caper_jax.geometry.solids import Solid, box, cylinder, ellipsoid

# Positive opens: the arm, in front of the hinge (+z), swings up (+y), which is about -x.
_HINGE = np.array([[-1.0, 0.0, 0.0]])
_TURN_X = about("y", np.pi / 2)  # cylinder z -> x
_TURN_Y = about("x", -np.pi / 2)  # cylinder z -> y
_UP = (0.0, 1.0, 0.0)
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
    """Measures in meters; the underside of the base is y = 0, the hinge z = 0, x is centered.

    Attributes:
      scale: of thicknesses and small parts, 1 for an office stapler.
      back, front: z of the ends of the base.
      width, plate: width and thickness of its plate.
      hinge: height of the hinge.
      under, magazine, cover: underside of the arm, height of its magazine and of its cover.
      arm, head, reach: width of the arm, z of the back and the front of its head.
    """

    scale: float
    back: float
    front: float
    width: float
    plate: float
    hinge: float
    under: float
    magazine: float
    cover: float
    arm: float
    head: float
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


def _base(rng: np.random.Generator, plan: _Plan, name: str) -> list[Solid]:
    """Plate with rounded or tapered ends, anvil, what stands under it and what carries the pin."""
    half, middle = plan.width / 2, (plan.front + plan.back) / 2
    foot = 0.0
    solids: list[Solid] = []
    if rng.random() < 0.4:  # a rubber sole a little smaller than the plate, or four pads
        foot = plan.plate * rng.uniform(0.2, 0.5)
        share = rng.uniform(0.8, 0.97)
        if rng.random() < 0.6:
            reach = share * (plan.front - plan.back) / 2
            solids.append(box((0, foot / 2, middle), (share * half, foot / 2, reach)))
        else:
            for x in (-1, 1):
                for z in (plan.back + 0.8 * half, plan.front - 0.8 * half):
                    place = (x * half * 0.7, foot / 2, z)
                    solids.append(cylinder(place, (half * 0.25, half * 0.25, foot / 2), _TURN_Y))
    thick = plan.plate - foot
    level = foot + thick / 2
    nose = half * rng.uniform(0.3, 1.0) if rng.random() < 0.65 else 0.0
    body = (plan.back, plan.front - nose)
    narrow = rng.uniform(0.7, 1.0) if rng.random() < 0.4 else 1.0
    if name == "long":  # a bar that widens to a table under the head
        bar = max(half * rng.uniform(0.5, 0.9), plan.arm / 2 + 0.001)
        table = (plan.head + plan.back) / 2
        reach = (table - plan.back) / 2 + 0.002
        solids.append(box((0, level, (plan.back + table) / 2), (bar, thick / 2, reach)))
        body = (table, plan.front - nose)
    start, end = (0.0, level, body[0]), (0.0, level, body[1])
    if narrow < 1.0:
        solids.append(beam(start, end, (half, thick / 2), _UP, (narrow, 1.0)))
    else:
        solids.append(beam(start, end, (half, thick / 2), _UP))
    if nose:
        round_ = (narrow * half, nose, thick / 2)
        solids.append(cylinder((0, level, body[1]), round_, _TURN_Y))
    solids += _anvil(rng, plan)
    solids += _cheeks(rng, plan)
    if rng.random() < 0.3:  # the leaf spring that keeps the arm up
        first = plan.back + (plan.front - plan.back) * rng.uniform(0.3, 0.45)
        last = first + (plan.front - plan.back) * rng.uniform(0.15, 0.3)
        section = (half * rng.uniform(0.1, 0.25), 0.0004)
        rise = (0, plan.under - 0.0008, last)
        solids.append(beam((0, plan.plate - 0.0005, first), rise, section, _UP))
    return solids


def _anvil(rng: np.random.Generator, plan: _Plan) -> list[Solid]:
    """The plate with two grooves under the head, that bends the staples."""
    gap = plan.under - plan.plate
    height = gap * rng.uniform(0.15, 0.7)
    half = plan.width / 2 * rng.uniform(0.35, 0.8), plan.scale * rng.uniform(0.004, 0.009)
    place = min(plan.reach, plan.front - 0.3 * plan.width) - half[1]
    groove = None
    if rng.random() < 0.7:
        depth = min(0.5 * height, 0.0015)
        groove = box(
            (0, plan.plate + height, place), (half[0] * 0.6, depth, half[1] * rng.uniform(0.2, 0.4))
        )
    # Sunk into the plate so that it is one piece with it.
    center = (0, plan.plate + height / 2 - 0.0005, place)
    return [box(center, (half[0], height / 2 + 0.0005, half[1]), hole=groove)]


def _cheeks(rng: np.random.Generator, plan: _Plan) -> list[Solid]:
    """Two cheeks beside the arm, or a block between its sides, and the pin of the hinge."""
    radius = plan.scale * rng.uniform(0.0015, 0.004)
    top = plan.hinge + radius * rng.uniform(0.8, 2.0)
    thick = max(plan.scale * rng.uniform(0.001, 0.003), (plan.width - plan.arm) / 2 - 0.0005)
    inner = plan.arm / 2 + 0.0004
    depth = plan.front * rng.uniform(0.08, 0.3)
    back = plan.back * rng.uniform(0.6, 1.0)
    bottom = plan.plate * 0.5
    style, narrow = rng.random(), rng.uniform(0.3, 0.9)
    solids = []
    for side in (-1, 1):
        x = side * (inner + thick / 2)
        if style < 0.4:
            center = (x, (top + bottom) / 2, (back + depth) / 2)
            solids.append(box(center, (thick / 2, (top - bottom) / 2, (depth - back) / 2)))
        elif style < 0.75:  # narrower at the top, which still holds the pin
            middle, reach = (depth + back) / 2, (depth - back) / 2
            share = max(narrow, min(1.0, (middle + radius) / reach))
            start, end = (x, bottom, middle), (x, top, middle)
            solids.append(beam(start, end, (thick / 2, reach), (0.0, 0.0, 1.0), (1.0, share)))
        else:  # round about the pin
            round_ = (top - plan.plate * 0.6) / 2
            center = (x, plan.plate * 0.6 + round_, 0)
            half = (round_, round_ * rng.uniform(0.9, 1.3), thick / 2)
            solids.append(cylinder(center, half, about("x", np.pi / 2) @ _TURN_X))
    length = inner + thick * rng.uniform(1.0, 1.2)
    solids.append(cylinder((0, plan.hinge, 0), (radius, radius, length), _TURN_X))
    return solids


def _cover(rng: np.random.Generator, plan: _Plan) -> list[Solid]:
    """The cover over the magazine, from back to front; its underside is level before tilting."""
    bottom, height, half = plan.under + 0.55 * plan.magazine, plan.cover, plan.arm / 2
    back, front = plan.head, plan.reach
    middle, reach = (back + front) / 2, (front - back) / 2
    below = box((0, bottom - 2 * height, middle), (plan.width, 2 * height, 2 * reach))
    style = rng.random()
    narrow, low = rng.uniform(0.6, 1.0), rng.uniform(0.4, 1.0)
    if style < 0.2:  # a bar, its front perhaps rounded
        narrow = low = 1.0
        solids = [box((0, bottom + height / 2, middle), (half, height / 2, reach))]
    elif style < 0.45:  # falling and narrowing to the front
        start, end = (0, bottom + height / 2, back), (0, bottom + low * height / 2, front)
        solids = [beam(start, end, (half, height / 2), _UP, (narrow, low))]
    elif style < 0.6:  # half round
        low = 1.0
        narrow = rng.uniform(0.75, 1.0)
        center, radii = (0, bottom, middle), (half, height, reach)
        solids = [cylinder(center, radii, hole=below)]
    elif style < 0.78:  # arched like a bow
        center, radii = (0, bottom, middle), (half, 1.25 * height, 1.06 * reach)
        solids = [ellipsoid(center, radii, hole=below)]
    else:  # a hump for the hand, at the back or towards the front
        at = back + 2 * reach * rng.uniform(0.3, 0.7)
        rear = rng.uniform(0.4, 0.9)
        top = (0, bottom + height / 2, at)
        solids = [
            beam(top, (0, bottom + rear * height / 2, back), (half, height / 2), _UP, (1.0, rear)),
            beam(
                top, (0, bottom + low * height / 2, front), (half, height / 2), _UP, (narrow, low)
            ),
        ]
    if not 0.6 <= style < 0.78 and rng.random() < 0.6:
        radii = (narrow * half, half * rng.uniform(0.3, 1.0), low * height / 2)
        solids.append(cylinder((0, bottom + low * height / 2, front), radii, _TURN_Y))
    if rng.random() < 0.3:  # a pad for the hand
        length = reach * rng.uniform(0.15, 0.35)
        place = (0, bottom + 0.55 * low * height, front - length - 0.1 * reach)
        rise = height * rng.uniform(0.5, 0.6)
        solids.append(box(place, (0.75 * narrow * half, rise, length)))
    return solids


def _arm(rng: np.random.Generator, plan: _Plan, name: str) -> list[Solid]:
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
    arm = [box(place, (inner, plan.magazine / 2, (front - start) / 2))]
    tilt = np.radians(rng.uniform(0.5, 7)) if rng.random() < 0.5 and name != "long" else 0.0
    cover = _cover(rng, plan)
    arm += [rotated(solid, about("x", -tilt), (0.0, plan.hinge, 0.0)) for solid in cover]
    if rng.random() < 0.5:  # the plate at the nose behind which the staples are driven down
        rise = (plan.magazine + plan.cover * rng.uniform(0.1, 0.4)) / 2
        arm.append(box((0, plan.under + rise, front), (inner * 0.9, rise, plan.scale * 0.0008)))
    if name == "long":
        section = (half * rng.uniform(0.4, 0.9), plan.magazine * rng.uniform(0.35, 0.5))
        bar = beam((0, plan.hinge, 0), (0, level, plan.head + 0.02), section, _UP)
        arm.append(bar)
    if name == "heavy":
        arm += _lever(rng, plan)
    # What turns on the pin, between the cheeks.
    radius = min(0.8 * room, 0.5 * plan.magazine)
    arm.append(cylinder((0, plan.hinge, 0), (radius, radius, half), _TURN_X))
    return arm


def _lever(rng: np.random.Generator, plan: _Plan) -> list[Solid]:
    """The long lever of heavy staplers, over the cover and perhaps beyond it."""
    rise = plan.under + plan.magazine + plan.cover
    foot = (0.0, plan.under + plan.magazine, plan.reach * rng.uniform(0.05, 0.3))
    knee = (0.0, rise + plan.scale * rng.uniform(0.004, 0.02), plan.reach * rng.uniform(0.5, 0.7))
    tip = (
        0.0,
        knee[1] + plan.scale * rng.uniform(-0.006, 0.012),
        plan.reach * rng.uniform(0.9, 1.3),
    )
    section = (plan.arm * rng.uniform(0.12, 0.35), plan.scale * rng.uniform(0.002, 0.005))
    grip = (min(1.15 * section[0], 0.02), 1.3 * section[1] + 0.001)
    return [
        beam(foot, knee, section, _UP),
        beam(knee, tip, grip, _UP, round_=rng.random() < 0.5),
    ]


def _plier(rng: np.random.Generator, plan: _Plan) -> tuple[list[Solid], list[Solid]]:
    """Stapling pliers: each part is a jaw in front of the pin and a handle behind it.

    As in any pliers the parts cross at the pin: the lower jaw goes on as the upper handle, so
    that the handles part when the jaws do.
    """
    half, scale = plan.width / 2, plan.scale
    pin = (0.0, plan.hinge, 0.0)
    thick = plan.plate / 2
    base = [beam((0, thick, 0), (0, thick, plan.front), (half, thick), _UP)]
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
    arm.append(
        box((0, plan.under + rise, length - head), (inner * rng.uniform(0.9, 1.15), rise, head))
    )
    radius = scale * rng.uniform(0.002, 0.004)
    base.append(cylinder(pin, (radius, radius, 1.1 * half), _TURN_X))

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
        solids.append(beam(start, bend, (width, section[1]), _UP))
        solids.append(beam(bend, tip, (width, section[1]), _UP, round_=round_))
    return base, arm


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one stapler; four in ten have the proportions of the ReArt-48 ones."""
    name = str(rng.choice(list(_TYPES), p=[row[0] for row in _TYPES.values()]))
    plan = _draw_plan(rng, name)
    if name == "plier":
        base, arm = _plier(rng, plan)
        high = np.radians(rng.uniform(14, 25))
    else:
        base, arm = _base(rng, plan, name), _arm(rng, plan, name)
        high = min(np.radians(rng.uniform(30, 90)), _OPEN)
    pivot = np.array([[0.0, plan.hinge, 0.0]])
    return ObjectModel([base, arm], _HINGE, pivot, np.array([[0.0, high]]))


STAPLER = Category(
    name="stapler",
    parts=("base", "arm"),
    joints=(Joint("revolute", parent=0, limits=(0.0, _OPEN)),),
    directions=("y", "z"),
    directions_reason="mirror-symmetric in the y-z plane, so y and z are what the shape shows",
    unit=10.4,
    mean_size=((0.04, 0.028, 0.176), (0.03, 0.031, 0.175)),
    mean_center=((0.0, -0.008, -0.002), (0.0, 0.006, 0.0)),
    shape=shape,
)
