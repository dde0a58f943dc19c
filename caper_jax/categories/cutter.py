"""cutter: a handle (root) and a blade that slides out of it along x; retracted at rest.

x points along the travel towards the tip, y out of the flat face, z across. The slider under the
thumb moves with the blade and belongs to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from caper_jax.articulation import urdf_rule as urdf
from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.articulation.conversions import ReArtConversion, StoredObject
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.categories.forms import TURN_X, TURN_Y, UP, along, beam
from caper_jax.geometry.solids import Solid, box, cylinder, ellipsoid

_TRAVEL = np.array([[1.0, 0.0, 0.0]])

_LONGEST = 0.115  # meters of extension that any instance allows
_SHARE = 0.9  # of the slider's way that is used

# Probability; length, width and height of the handle and width of the blade, meters. "wide" and
# "slim" are those of the nine ReArt-48 cutters: handle 105-163 x 22-34 x 11-20 mm, blade with
# carrier 78-134 x 12-22 mm, 71-97 mm of travel, slider up to 5 mm above the face.
_TYPES = {
    "slim": (0.27, (0.105, 0.15), (0.016, 0.026), (0.008, 0.015), (0.008, 0.013)),
    "wide": (0.38, (0.13, 0.178), (0.025, 0.036), (0.011, 0.021), (0.016, 0.023)),
    "utility": (0.2, (0.13, 0.175), (0.026, 0.042), (0.014, 0.026), (0.017, 0.02)),
    "card": (0.08, (0.06, 0.095), (0.018, 0.034), (0.005, 0.01), (0.008, 0.018)),
    "pen": (0.07, (0.12, 0.16), (0.01, 0.015), (0.009, 0.014), (0.006, 0.008)),
}


@dataclass(frozen=True)
class _Plan:
    """Measures in meters; the handle spans x in [0, length] and y in [-height / 2, height / 2]."""

    length: float  # of the handle
    width: float
    height: float
    back: float  # x of the ends of its body, between its round end and its nose
    front: float
    floor: float  # y of the underside of the blade's channel
    gap: float  # height of the channel
    blade: float  # width of the blade
    aside: float  # z of the middle of blade and slot
    slot: tuple[float, float]  # x of the slot's ends
    slot_width: float  # its width
    slider: float  # length of the slider
    edge: bool  # the slider runs on the narrow side (-z) instead of the flat face


def _draw_plan(rng: np.random.Generator, name: str) -> _Plan:
    _, *ranges = _TYPES[name]
    length, width, height, blade = (rng.uniform(*row) for row in ranges)
    blade = min(blade, 0.8 * width)
    slider = length * rng.uniform(0.09, 0.2)
    edge = name == "utility" and rng.random() < 0.4
    if name == "utility" and rng.random() < 0.5:
        back = length * rng.uniform(0.25, 0.45)
    else:
        back = width / 2 * rng.uniform(0.3, 1.0) if rng.random() < 0.5 and name != "pen" else 0.0
    # The slot, and with it the travel: long for snap-off blades, short for trapezoid ones.
    share = rng.uniform(0.16, 0.34) if name in ("utility", "pen") else rng.uniform(0.46, 0.74)
    way = min(share * length, 0.98 * _LONGEST / _SHARE)
    ahead = rng.uniform(0.14, 0.3) if name in ("utility", "pen") else rng.uniform(0.05, 0.2)
    end = length * (1 - ahead)
    start = max(end - way - slider, back + 0.03 * length)
    front = length
    if name in ("utility", "pen") or rng.random() < 0.5:
        front = end + (length - end) * rng.uniform(0.2, 0.6)
    gap = min(rng.uniform(0.0012, 0.003), 0.25 * height)
    return _Plan(
        length=length,
        width=width,
        height=height,
        back=back,
        front=front,
        floor=-height / 2 + rng.uniform(0.3, 0.6) * (height - gap),
        gap=gap,
        blade=blade,
        aside=rng.uniform(-0.3, 0.3) * (width - blade) if rng.random() < 0.5 else 0.0,
        slot=(start, end),
        slot_width=min(rng.uniform(0.003, 0.009), 0.5 * blade),
        slider=slider,
        edge=edge,
    )


def _handle(rng: np.random.Generator, plan: _Plan, name: str) -> Iterator[Solid]:
    """Two shells with the channel of the blade between them, or one round body; and trimmings."""
    back, front = plan.back, plan.front
    middle, reach = (back + front) / 2, (front - back) / 2
    low, top, high = -plan.height / 2, plan.floor + plan.gap, plan.height / 2
    half = plan.width / 2
    slot = _slot(plan, (plan.slot[0] + plan.slot[1]) / 2, (plan.slot[1] - plan.slot[0]) / 2)
    style = rng.random()
    if name == "pen" or (style < 0.15 and not plan.edge):
        radii = (half, plan.height / 2, reach)
        yield cylinder((middle, 0, 0), radii, TURN_X, hole=slot)
    else:
        # Rounded or tapered, but never so that the sides come into the channel.
        rim = (half - plan.blade / 2 - abs(plan.aside) - 0.0005) / 2
        round_ = min(rim, rng.uniform(0.4, 1.1) * plan.height / 2)
        round_ = round_ if style < 0.6 and not plan.edge else 0.0
        narrow, flat = 1.0, 1.0
        if style > 0.75:
            inner = plan.blade + 2 * abs(plan.aside) + 0.001
            narrow = max(rng.uniform(0.5, 1.0), inner / half / 2)
            flat = rng.uniform(0.6, 1.0)
        channel = box((middle + 0.004, top, plan.aside), (reach, plan.gap, plan.blade / 2 + 0.0003))
        for bottom, height, hole, share in (
            (low, top - low, channel, 1.0),
            (top, high - top, slot, flat),
        ):
            section = (half - round_, height / 2)
            y = bottom + height / 2
            end = y - (1 - share) * height / 2
            shell = beam((back, y, 0), (front, end, 0), section, UP, _taper(narrow, share))
            yield replace(shell, hole=hole)
        for side in (-1, 1) if round_ > 0.0008 else ():
            place = (middle, 0, side * (half - round_))
            yield cylinder(place, (round_, plan.height / 2, reach), TURN_X)
        if style > 0.9 and not plan.edge:  # a belly for the hand
            length, wide = reach * rng.uniform(0.5, 0.85), half * rng.uniform(1.05, 1.35)
            radii = (length, 0.499 * plan.height, wide)
            yield ellipsoid((back + radii[0], 0, 0), radii, hole=slot)
    yield from _front(rng, plan, name)
    yield from _back(rng, plan, name)
    if rng.random() < 0.35 and not plan.edge:  # pads for the fingers, on the long sides
        for side in (-1, 1):
            length = reach * rng.uniform(0.1, 0.5)
            place = (front - length - reach * rng.uniform(0.05, 0.3), 0, side * half)
            yield box(place, (length, plan.height * rng.uniform(0.15, 0.35), 0.001))


def _taper(narrow: float, flat: float) -> tuple[float, float] | None:
    return None if narrow == flat == 1.0 else (min(narrow, 1.0), flat)


def _slot(plan: _Plan, middle: float, half: float) -> Solid:
    """What the slot takes from the upper shell: through its face, or into its narrow side."""
    top, high = plan.floor + plan.gap, plan.height / 2
    if plan.edge:
        center = (middle, (top + high) / 2, -plan.width / 2)
        return box(center, (half, 0.3 * (high - top), 0.3 * plan.width))
    depth = high + 0.001 - plan.floor
    center = (middle, plan.floor + depth / 2, plan.aside)
    return box(center, (half, depth / 2, plan.slot_width / 2))


def _front(rng: np.random.Generator, plan: _Plan, name: str) -> Iterator[Solid]:
    """From the end of the body to the mouth: a nose, or a sheet metal sleeve open at the top."""
    start, end = plan.front, plan.length
    middle, reach = (start + end) / 2, (end - start) / 2
    if reach < 0.001:
        return
    if name in ("utility", "pen"):
        # Nose: narrower to the mouth, and on knives for packing leaning to the edge's side.
        half = plan.width / 2
        mouth = min(1.0, (plan.blade + 2 * abs(plan.aside) + 0.0015) / plan.width)
        narrow = 0.6 if name == "pen" else rng.uniform(mouth, 1.0)
        lean = (1 - narrow) * half * rng.uniform(-0.7, 0.7) if name == "utility" else 0.0
        flat = narrow if name == "pen" else rng.uniform(0.5, 1.0)
        ends, taper = ((start, 0, 0), (end, 0, lean)), narrow if name == "pen" else (narrow, flat)
        yield beam(*ends, (half, plan.height / 2), UP, taper, round_=name == "pen")
        return
    wall = rng.uniform(0.0006, 0.0015)
    low = plan.floor - wall
    high = min(plan.floor + plan.gap + wall, plan.height / 2)
    half = plan.blade / 2 + wall
    open_half = (2 * reach, high - plan.floor, half * rng.uniform(0.4, 0.85))
    open_ = box((middle, high, plan.aside), open_half)
    center = (middle - 0.002, (low + high) / 2, plan.aside)
    yield box(center, (reach + 0.002, (high - low) / 2, half), hole=open_)


def _back(rng: np.random.Generator, plan: _Plan, name: str) -> Iterator[Solid]:
    """A round end, a cap, or a grip that bends away; perhaps a wheel, a lanyard hole, a clip."""
    half, thick = plan.width / 2, plan.height / 2
    style = rng.random()
    if plan.back > 0 and name == "utility" and style < 0.6:
        lean = np.sin(np.radians(rng.uniform(-4, 14)))
        start = (plan.back + 0.004, 0, 0)
        end = (0, 0, lean * plan.back)
        taper = (rng.uniform(0.7, 1.0), rng.uniform(0.8, 1.0))
        yield beam(start, end, (half, 0.98 * thick), UP, taper)
    elif plan.back > 0:
        # Its front half lies in the body, where it must leave slot and channel free.
        hole = box((2 * plan.back, 0, 0), (plan.back, plan.height, plan.width))
        if plan.slot[0] > 2 * plan.back and rng.random() < 0.5:  # for a lanyard
            radius = min(0.3 * half, 0.4 * plan.back)
            hole = cylinder((0.55 * plan.back, 0, 0), (radius, radius, half), TURN_Y)
        radii = (plan.back, half, thick * rng.uniform(0.7, 0.99))
        yield cylinder((plan.back, 0, 0), radii, TURN_Y, hole=hole)
    if name == "pen" or rng.random() < 0.15:  # a cap
        reach = plan.length * rng.uniform(0.03, 0.07)
        radii = (0.8 * half, 0.9 * thick, reach)
        yield cylinder((plan.back - 0.3 * reach, 0, 0), radii, TURN_X)
    if name in ("wide", "slim") and rng.random() < 0.12 and plan.slot[0] - plan.back > 0.014:
        radius = min(0.4 * half, 0.007)
        place = ((plan.slot[0] + plan.back) / 2 - 0.002, thick + 0.001, 0)
        yield cylinder(place, (radius, radius, 0.0025), TURN_Y)
    if (name == "pen" or (name == "slim" and rng.random() < 0.25)) and plan.back < 0.01:
        reach = plan.length * rng.uniform(0.12, 0.2)
        place = (plan.back + reach, -thick - 0.0015, 0)
        yield box(place, (reach, 0.0004, 0.0022))
        yield box((plan.back + 0.0015, -thick - 0.0006, 0), (0.0015, 0.0013, 0.0022))


def _blade(rng: np.random.Generator, plan: _Plan, name: str) -> Iterator[Solid]:
    """The blade, its tip cut at an angle, and the carrier, neck and slider that move with it."""
    thick = min(rng.uniform(0.0004, 0.0009), 0.7 * plan.gap)
    level = plan.floor + plan.gap / 2
    tip = plan.length - rng.uniform(0.0003, 0.003)
    at = plan.slot[0] + plan.slider / 2 + 0.0005
    tail = max(at - plan.slider / 2 - rng.uniform(0.0, 0.12) * plan.length, plan.back + 0.002)
    side = 1.0 if plan.edge or rng.random() < 0.5 else -1.0  # the edge, with the tip, is here
    angle = np.radians(rng.uniform(28, 50) if name == "pen" else rng.uniform(35, 68))
    point = np.array([tip, level, plan.aside + side * plan.blade / 2])
    normal = np.array([np.sin(angle), 0.0, -side * np.cos(angle)])
    frame = along(normal, UP)
    size = 2 * plan.blade / np.sin(angle)
    cut = box(point + size * normal, (size, size, size), frame)
    start = tail if name not in ("utility", "pen") else max(tail, tip - rng.uniform(0.045, 0.062))
    center, half = (start + tip) / 2, (tip - start) / 2
    yield box((center, level, plan.aside), (half, thick / 2, plan.blade / 2), hole=cut)
    reach = (max(start, at + plan.slider / 2) + 0.003 - tail) / 2
    place = (tail + reach, level, plan.aside)
    yield box(place, (reach, 0.46 * plan.gap, 0.42 * plan.blade))
    yield from _slider(rng, plan, at)


def _slider(rng: np.random.Generator, plan: _Plan, at: float) -> Iterator[Solid]:
    """The neck through the slot and what the thumb pushes, around x = ``at``."""
    reach = plan.slider / 2
    rise = rng.uniform(0.0012, 0.0055)
    if plan.edge:
        middle = (plan.floor + plan.gap + plan.height / 2) / 2
        half_y = 0.25 * (plan.height / 2 - plan.floor - plan.gap)
        inner, outer = -plan.width * 0.22, -plan.width / 2 - rise
        neck_z = ((inner + outer) / 2, (inner - outer) / 2)
        drop = (middle - half_y + plan.floor) / 2, (middle + half_y - plan.floor) / 2
        yield box((at, drop[0], inner), (0.8 * reach, drop[1], 0.0015))
        yield box((at, middle, neck_z[0]), (0.8 * reach, half_y, neck_z[1]))
        yield box((at, middle, outer + rise / 2), (reach, min(2 * half_y, 0.004), 0.8 * rise / 2))
        return
    face = plan.height / 2 + 0.0002
    half = min(rng.uniform(0.6, 1.6) * plan.slot_width, 0.45 * plan.width)
    neck = (face + 0.0005 - plan.floor - 0.2 * plan.gap) / 2
    place = (at, face + 0.0005 - neck, plan.aside)
    yield box(place, (0.8 * reach, neck, 0.42 * plan.slot_width))
    style = rng.random()
    if style < 0.45:  # a plate with ribs
        yield box((at, face + rise / 2, plan.aside), (reach, rise / 2, half))
        count = int(rng.integers(0, 4))
        for rib in range(count):
            x = at + reach * (2 * (rib + 0.5) / count - 1)
            yield box((x, face + rise, plan.aside), (0.0008, 0.0007, 0.9 * half))
    elif style < 0.65:  # a hump
        center = (at, face - 0.0001, plan.aside)
        below = box((at, face - rise, plan.aside), (2 * reach, rise, 2 * half))
        yield ellipsoid(center, (reach, 1.3 * rise, half), hole=below)
    elif style < 0.85:  # a ramp that the thumb leans against
        foot, head = (at - reach, face, plan.aside), (at + reach, face, plan.aside)
        ramp = beam(head, foot, (half, 1.3 * rise), UP, (1.0, rng.uniform(0.2, 0.7)))
        below = box((at, face - 2 * rise, plan.aside), (2 * reach, 2 * rise, 2 * half))
        yield replace(ramp, hole=below)
    else:  # a plate with the wheel that locks it
        yield box((at, face + rise / 4, plan.aside), (reach, rise / 4, half))
        radius = min(rng.uniform(0.0035, 0.008), 0.45 * plan.width, reach)
        height = rng.uniform(0.001, 0.003)
        place = (at, face + rise / 2 + height - 0.0001, plan.aside)
        yield cylinder(place, (radius, radius, height), TURN_Y)


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one cutter; two in three have the proportions of the ReArt-48 ones."""
    name = str(rng.choice(list(_TYPES), p=[row[0] for row in _TYPES.values()]))
    plan = _draw_plan(rng, name)
    handle, blade = list(_handle(rng, plan, name)), list(_blade(rng, plan, name))
    way = plan.slot[1] - plan.slot[0] - plan.slider - 0.001
    limits = np.array([[0.0, min(_SHARE * way, _LONGEST)]])
    mouth = np.array([[plan.length, plan.floor + plan.gap / 2, plan.aside]])
    return ObjectModel([handle, blade], _TRAVEL, mouth, limits)


def _urdf_axes(ref: MeshObject) -> urdf.CanonicalAxes:
    """X where the blade goes, y out of the flat face, on the side of the slider.

    The face is where the blade, with its slider, clearly stands out of the handle; of a cutter
    without such a slider, the face across the handle's thin direction.
    """
    travel = ref.axis[0] * urdf.opening_sign(ref, 0)

    def shift(direction: np.ndarray) -> float:
        """Of the blade's middle from the handle's, as a share of the handle."""
        handle, blade = (part.vertices @ direction for part in ref.parts)
        apart = blade.max() + blade.min() - handle.max() - handle.min()
        return float(apart / 2 / np.ptp(handle))

    sides = [axis for axis in np.eye(3) if abs(axis @ travel) < 0.5]
    up = max(sides, key=lambda direction: abs(shift(direction)))
    if abs(shift(up)) < 0.24:
        across = np.eye(3) - np.outer(travel, travel)
        second = across @ ref.parts[0].moments()[2] @ across
        # The travel itself has the value 0; the thin direction comes next.
        up = np.linalg.eigh(second)[1][:, 1]
    up = up * np.sign(shift(up)) if abs(shift(up)) > 0.05 else urdf.along_positive(up)
    return urdf.CanonicalAxes(up, np.cross(travel, up))


def _stored_extension(stored: StoredObject) -> float:
    """Way (meters) of the tip of a cutter of ReArt-48 beyond the end of the body.

    The files store the blade fully out, towards -y. Retracted, its tip is flush with the body's
    end.
    """
    return float((stored.low[1, 1] - stored.low[0, 1]) / stored.axis[0, 1])


CUTTER = Category(
    name="cutter",
    parts=("body", "blade"),
    joints=(Joint("prismatic", parent=0, limits=(0.0, _LONGEST)),),
    directions=("x", "y"),
    stands=False,
    directions_reason="the long way of the handle shows x, the slider and the flat face show y",
    unit=13.8,
    mean_size=((0.141, 0.015, 0.029), (0.114, 0.013, 0.017)),
    mean_center=((0.0, -0.002, 0.0), (0.012, 0.003, 0.0)),
    shape=shape,
    urdf_rule=urdf.UrdfRule(
        rest=urdf.closed_states,
        axes=_urdf_axes,
        opening=urdf.opens_along(urdf.X),
        partnet_classes=("Knife",),
    ),
    datasets={
        "reart": ReArtConversion(
            3,
            ("cutter",),
            axes=((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
            opening=(0.0, -1.0, 0.0),
            stored_state=_stored_extension,
            test_objects=(20, 21),
        ),
    },
)
