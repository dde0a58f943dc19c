"""dishwasher: a body (root) and a door hinged along x at its lower front edge; y up, front +z.

The door is built shut, as body.py measures it, and opened by 90 deg for the rest pose.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from caper_jax.articulation import urdf_rule as urdf
from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.articulation.conversions import ArtImageConversion, Front
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.categories.dishwasher.body import TYPES, Plan, body, controls, draw_plan, inside
from caper_jax.categories.forms import TURN_X, TURN_Y, Handle, HandleStyle, about, rotated
from caper_jax.geometry.solids import Solid, box, cylinder, frustum

_OPEN = about("x", np.pi / 2)  # takes the shut door (y up) to the open one (towards +z)


def _door(rng: np.random.Generator, plan: Plan, kind: str, fascia: bool) -> Iterator[Solid]:
    """The door as it stands when shut: plate, what is on its outside, inner panel."""
    back, face = 0.002, 0.002 + plan.thick
    low, high, half_x = plan.low, plan.high, plan.half_door
    height = high - low
    built_in = kind == "built_in"
    relief = rng.choice(
        ("plain", "bevel", "bow", "shaker", "leaves", "pocket"),
        p=(0.34, 0.1, 0.0, 0.26, 0.14, 0.16) if built_in else (0.4, 0.1, 0.12, 0.04, 0.08, 0.26),
    )
    styles: tuple[HandleStyle, ...] = ("none", "rod", "staple", "knob", "ball", "cup", "lip")
    style: HandleStyle = rng.choice(styles, p=(0.12, 0.36, 0.16, 0.06, 0.06, 0.08, 0.16))
    if relief == "pocket" or (style == "lip" and relief in ("bevel", "bow")):
        style = "none"
    strip = 0.0
    if not (fascia or built_in) and relief != "leaves" and rng.random() < 0.6:
        strip = rng.uniform(0.1, 0.19) * height
    upper = high - strip  # of the panel below the control strip
    center = np.array([0.0, (low + upper) / 2, (back + face) / 2])
    half = np.array([half_x, (upper - low) / 2, plan.thick / 2])
    at, hole = face, None
    if relief == "shaker":
        rim, depth = rng.uniform(0.03, 0.09), rng.uniform(0.3, 0.6) * plan.thick
        hole = box((0, center[1], face), (half_x - rim, half[1] - rim, depth))
    elif relief == "pocket":
        reach = rng.uniform(0.012, 0.03)
        y = upper - reach - rng.uniform(-0.01, 0.06)
        depth = rng.uniform(0.4, 0.8) * plan.thick
        hole = box((0, y, face), (rng.uniform(0.15, 0.9) * half_x, reach, depth))
    elif relief == "bow":
        bulge = min(rng.uniform(0.3, 0.95) * plan.thick, 0.4 * plan.thick + 0.02)
        yield cylinder((0, center[1], face), (half_x, bulge, half[1]), TURN_Y)
        at = face + 0.35 * bulge  # the ends of a long handle must still touch the curve
    elif relief == "leaves":
        yield from _leaves(rng, low, upper, half_x, face)
    if relief == "bevel":
        taper = 1 - rng.uniform(0.3, 1.0) * min(plan.thick, 0.015) / half[:2]
        yield frustum(center, half, taper)
    else:
        yield box(center, half, hole=hole)
    if strip:
        yield from _strip(rng, plan, upper, face)
    elif relief == "plain" and rng.random() < 0.3:  # a rounded upper edge
        yield cylinder((0, high, center[2]), (half[2], 0.004, half_x), TURN_X)
    handle = Handle.draw(rng, style, 1.0, wide=False)
    y = upper - max(rng.uniform(0.02, 0.12) * height, 0.016 + handle.half)
    if style == "lip":
        y, at = upper - handle.half, face - 0.005
    elif relief == "shaker" and style != "none":  # on the frame
        y = upper - 0.02
    # The open door's handle hangs down; it must not reach the floor.
    if at + handle.reach - plan.hinge[1] < plan.hinge[0] - 0.004:
        yield from handle.on((0, y, at), 2 * half_x, height)
    yield from _inner_panel(rng, plan)


def _leaves(
    rng: np.random.Generator, low: float, high: float, half_x: float, face: float
) -> list[Solid]:
    """Boards that make the front look like drawers."""
    count = int(rng.integers(2, 4))
    shares = rng.uniform(0.6, 1.4, size=count)
    edges = low + (high - low) * np.concatenate([[0.0], np.cumsum(shares) / shares.sum()])
    return [
        box((0, (y0 + y1) / 2, face + 0.006), (half_x, (y1 - y0) / 2 - 0.004, 0.006))
        for y0, y1 in itertools.pairwise(edges)
    ]


def _strip(rng: np.random.Generator, plan: Plan, low: float, face: float) -> Iterator[Solid]:
    """The control strip as the upper end of the door; some lean back."""
    out = face + plan.thick * rng.uniform(-0.3, 0.35)
    half = np.array([plan.half_door, (plan.high - low) / 2, (out - 0.002) / 2])
    center = (0, low + half[1], 0.002 + half[2])
    if rng.random() < 0.25:  # thinner upwards on both sides; a plate closes the back
        yield frustum(center, half[[0, 2, 1]], (1.0, rng.uniform(0.5, 0.85)), TURN_Y)
        yield box((0, center[1], 0.007), (half[0], half[1], 0.005))
    else:
        yield box(center, half)
        yield from controls(rng, center[1], out, half[0], half[1])


def _inner_panel(rng: np.random.Generator, plan: Plan) -> Iterator[Solid]:
    """What closes the opening: a plug, often hollow, with the detergent box in it."""
    low, high = plan.cavity
    margin = rng.uniform(0.004, 0.02)
    # With the hinge behind it, the plug's lower edge sinks by about plug (behind - plug / 2) / a on
    # its way out, a being its height above the hinge; it must still pass the sill.
    hinge_y, hinge_z = plan.hinge
    sill = max(low[1], plan.low) - hinge_y
    sinks = plan.plug * max(-hinge_z - plan.plug / 2, 0.0)
    bottom = hinge_y + (sill + np.sqrt(sill**2 + 4 * sinks)) / 2 + margin
    top = min(high[1], plan.high) - margin
    if plan.plug:
        depth = plan.plug + 0.002
        half = np.array([high[0] - margin, (top - bottom) / 2, depth / 2])
        center = np.array([0.0, (bottom + top) / 2, 0.002 - depth / 2])
        hole = None
        if rng.random() < 0.65:
            rim, deep = rng.uniform(0.015, 0.06), depth * rng.uniform(0.5, 0.98)
            hole = box(center - (0, 0, depth / 2), (half[0] - rim, half[1] - rim, deep))
        yield box(center, half, hole=hole)
    if rng.random() < 0.75:  # detergent box and rinse aid cap
        half = np.array([rng.uniform(0.04, 0.09), rng.uniform(0.03, 0.06), 0.0])
        half[2] = (plan.plug + rng.uniform(0.003, 0.01)) / 2
        x = rng.uniform(-0.4, 0.4) * high[0]
        y = bottom + (top - bottom) * rng.uniform(0.4, 0.65)
        yield box((x, y, 0.003 - half[2]), half)
        if rng.random() < 0.5:
            place = (min(x + half[0] + 0.03, high[0] - 0.03), y, 0.003 - half[2])
            yield cylinder(place, (0.02, 0.02, half[2]))


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one dishwasher: standard, slim, built-in or for a table top."""
    kind = rng.choice(tuple(TYPES), p=[row[0] for row in TYPES.values()])
    fascia = rng.random() < (0.1 if kind == "built_in" else 0.3)
    plan = draw_plan(rng, kind, fascia)
    solids = list(body(rng, plan, kind, fascia))
    solids += inside(rng, plan.cavity, plan.plug, kind == "table_top")
    pivot = np.array([0.0, *plan.hinge])
    door = [rotated(solid, _OPEN, pivot) for solid in _door(rng, plan, kind, fascia)]
    limits = np.array([[-np.pi / 2, 0.0]])
    return ObjectModel([solids, door], np.array([[1.0, 0.0, 0.0]]), pivot[None], limits)


def _quarter_open(ref: MeshObject) -> np.ndarray:
    """90 deg from closed."""
    closed = float(urdf.closed_states(ref)[0])
    sense = urdf.opening_sign(ref.at(np.array([closed])), 0)
    return np.array([urdf.snap_state(closed + sense * np.pi / 2, ref.limits[0], 6.0)])


DISHWASHER = Category(
    name="dishwasher",
    parts=("body", "door"),
    joints=(Joint("revolute", parent=0, limits=(-np.pi / 2, 0.0)),),
    directions=("y", "z"),
    directions_reason="nearly mirror-symmetric in the y-z plane, so y and z are what shows",
    unit=1.31,
    mean_size=((0.543, 0.776, 0.58), (0.532, 0.072, 0.633)),
    mean_center=((0.0, 0.0, -0.302), (0.0, -0.291, 0.276)),
    shape=shape,
    urdf_rule=urdf.UrdfRule(
        rest=_quarter_open,
        axes=urdf.hinged_axes,
        opening=urdf.opens_along(urdf.X),
        child_words=("door",),
        partnet_classes=("Dishwasher",),
    ),
    datasets={
        # In the files the open door lies ahead of the body.
        "artimage": ArtImageConversion(
            3, (11700, 12530, 12559, 12580), Front("ahead", axes=((1, 0, 0),))
        ),
    },
)
