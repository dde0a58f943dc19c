"""drawer: a cabinet (root) and three drawers that slide out along +z; closed at rest, y up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from caper_jax.articulation import urdf_rule as urdf
from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.articulation.conversions import (
    ArtImageConversion,
    CaptraConversion,
    Front,
    NotConvertible,
)
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.categories.drawer import cabinet
from caper_jax.categories.drawer.cabinet import Plan
from caper_jax.categories.forms import TURN_Y, Handle, HandleStyle, StandStyle, open_box, stand
from caper_jax.geometry.solids import Solid, box, cylinder, ellipsoid, frustum


@dataclass(frozen=True)
class _Style:
    """What the three drawers of a cabinet share."""

    # Of the fronts: "plain", "bevel", "panel" (raised), "shaker" (sunk), "bow", "grip" (a recess at
    # the upper edge) or "notch" (an opening there).
    relief: str
    rim: float  # width of the frame about a panel, meters
    depth: float  # of the relief, meters
    handle: Handle
    handle_height: float  # 0 is the lower edge of a front, 1 the upper
    grip: float  # half width of a grip, as a share of the front's width
    clearance: float  # beside a tray, meters
    tray_height: float  # share of the opening
    tray_depth: float  # share of the room behind the front
    walls: float  # thickness of a tray's walls and floor, meters
    rails: bool  # low metal trays with a rail above each side
    full: float  # how likely a drawer holds something


_RELIEFS = ("plain", "bevel", "panel", "shaker", "bow", "grip", "notch")


def _style(rng: np.random.Generator, kind: str, plan: Plan) -> _Style:
    relief = rng.choice(_RELIEFS, p=(0.4, 0.12, 0.1, 0.14, 0.07, 0.1, 0.07))
    handle: HandleStyle
    styles: tuple[HandleStyle, ...] = ("none", "rod", "staple", "knob", "ball", "cup", "lip", "tag")
    if relief in ("grip", "notch"):
        handle = "none"
    elif relief in ("shaker", "bow", "bevel"):
        handle = rng.choice(styles, p=(0.08, 0.36, 0.0, 0.2, 0.2, 0.16, 0.0, 0.0))
    else:
        handle = rng.choice(styles, p=(0.08, 0.22, 0.18, 0.14, 0.14, 0.07, 0.1, 0.07))
    # What costs most solids does not come together.
    cart = kind == "cart"
    if cart and handle in ("rod", "tag"):
        handle = "staple"
    slender = handle not in ("rod", "tag") and relief not in ("panel", "bow")
    rails = rng.random() < 0.2 and slender and not cart
    depth = plan.scale * rng.uniform(0.003, 0.012)
    if relief in ("shaker", "grip"):
        depth = min(depth, 0.7 * plan.front)
    elif relief == "bow":
        depth = min(2.0 * depth, plan.front)
    return _Style(
        relief=relief,
        rim=plan.scale * rng.uniform(0.02, 0.06),
        depth=depth,
        handle=Handle.draw(rng, handle, plan.scale, plan.width > 0.45 and not rails),
        # A label needs the room above its rod.
        handle_height=0.5 if handle == "tag" or rng.random() < 0.55 else rng.uniform(0.6, 0.82),
        grip=rng.uniform(0.08, 0.42),
        clearance=plan.scale * rng.uniform(0.002, 0.015),
        tray_height=rng.uniform(0.2, 0.4) if rails else rng.uniform(0.4, 0.93),
        tray_depth=rng.uniform(0.78, 0.98),
        walls=plan.scale * rng.uniform(0.003, 0.014),
        rails=rails,
        full=0.6 if rng.random() < 0.4 and not (rails or cart) else 0.0,
    )


def _front(plan: Plan, style: _Style, index: int) -> Iterator[Solid]:
    low, high = plan.front_levels(index)
    back, face = plan.face
    height, half_x = high - low, plan.half_front
    half = np.array([half_x, height / 2, plan.front / 2])
    center = np.array([0.0, (low + high) / 2, (back + face) / 2])
    rim = min(style.rim, 0.25 * height)
    depth = style.depth
    at = face  # where the handle is mounted
    hole: Solid | None = None
    extra: list[Solid] = []
    if style.relief == "shaker":
        hole = box((0, center[1], face), (half_x - rim, height / 2 - rim, depth))
        at = face - depth
    elif style.relief == "panel":
        place = (0, center[1], face + depth / 2)
        extents = (half_x - rim, height / 2 - rim, depth / 2)
        taper = 1 - np.minimum(1.5 * depth / np.array(extents[:2]), 0.5)
        extra = [frustum(place, extents, taper)]
    elif style.relief == "bow":
        extra = [cylinder((0, center[1], face), (half_x, depth, height / 2), TURN_Y)]
        # The ends of a handle must still touch the curve.
        reach = max(style.handle.share, 0.55)
        at = face + 0.9 * depth * np.sqrt(1 - reach**2)
    elif style.relief == "grip":
        reach = min(0.3 * height, 0.035 * plan.scale)
        hole = box((0, high, face), (2 * style.grip * half_x, reach, depth))
    elif style.relief == "notch":
        reach = min(0.3 * height, 0.03 * plan.scale)
        hole = box((0, high, face), (min(style.grip, 0.2) * half_x, reach, 2 * plan.front))
    if style.relief == "bevel":
        # The edges are broken by about half the thickness.
        taper = 1 - np.minimum(style.depth / half[:2], 0.3)
        yield frustum(center, half, taper)
    else:
        yield box(center, half, hole=hole)
    y = min(low + style.handle_height * height, high - min(style.handle.half, 0.4 * height))
    if style.handle.style == "lip":
        y, at = high - min(style.handle.half, 0.1 * height), face - 0.4 * plan.front
    yield from extra
    yield from style.handle.on((0, y, at), 2 * half_x, height)


def _tray(rng: np.random.Generator, plan: Plan, style: _Style, index: int) -> Iterator[Solid]:
    """The open box behind the front, and what lies in it."""
    margin = plan.divider / 2 + 0.004 * plan.scale
    low, high = plan.levels[index] + margin, plan.levels[index + 1] - margin
    height = style.tray_height * (high - low)
    start = (plan.face[0] + plan.face[1]) / 2  # the front closes the tray
    end = -style.tray_depth * (plan.depth - plan.back)
    half_x = plan.width / 2 - plan.side - style.clearance
    walls = min(style.walls, 0.1 * height)
    half = np.array([half_x, height / 2, (start - end) / 2])
    center = np.array([0.0, low + height / 2, (start + end) / 2])
    yield open_box(center, half, walls, walls)
    if style.rails:
        y, thick = low + rng.uniform(0.6, 0.8) * (high - low), 0.006 * plan.scale
        for side in (-1, 1):
            yield box((side * (half_x - thick), y, center[2]), (thick, thick, half[2]))
        rise = (y - low) / 2
        yield box((0, low + rise, end + thick), (half_x, rise, thick))
    if rng.random() < style.full:
        room = 0.95 * (high - low) - walls
        size = np.array([half[0] - walls, room / 2, half[2] - plan.front - walls])
        size *= rng.uniform((0.25, 0.2, 0.25), (0.95, 0.9, 0.9))
        aside = (half - walls - size) * rng.uniform(-0.8, 0.8, size=3)
        place = (aside[0], low + walls + size[1], center[2] + 0.5 * aside[2])
        heap = rng.random() < 0.5 and style.handle.style not in ("ball", "cup")
        yield ellipsoid(place, size) if heap else box(place, size)


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one cabinet: chests, tall and kitchen units, night stands, desktop boxes and carts."""
    kind = rng.choice(tuple(cabinet.TYPES), p=[row[0] for row in cabinet.TYPES.values()])
    support: StandStyle = rng.choice(cabinet.STANDS[kind])
    plan = cabinet.draw_plan(rng, kind, support)
    style = _style(rng, kind, plan)
    open_top = kind == "kitchen" and rng.random() < 0.5
    if kind == "cart":
        body = list(cabinet.cart(rng, plan))
    else:
        body = list(cabinet.carcass(rng, plan, open_top, style.handle))
        if kind in ("tall", "kitchen", "bedside") and rng.random() < 0.12:
            body += cabinet.beside(rng, plan)
        elif not open_top and rng.random() < (0.1 if kind == "desktop" else 0.45):
            body += cabinet.top_plate(rng, plan)
    body += stand(rng, support, (plan.width, plan.base, plan.depth))
    drawers = [[*_front(plan, style, i), *_tray(rng, plan, style, i)] for i in range(3)]
    travel = style.tray_depth * (plan.depth - plan.back) * rng.uniform(0.6, 0.98)
    pivots = [(0.0, plan.levels[i : i + 2].mean(), plan.face[1]) for i in range(3)]
    limits = np.array([[0.0, 0.9 * travel]] * 3)
    return ObjectModel([body, *drawers], np.tile([0.0, 0.0, 1.0], (3, 1)), np.array(pivots), limits)


def _urdf_axes(ref: MeshObject) -> urdf.CanonicalAxes:
    """Front where the drawers go, up along their stack."""
    front = ref.axis[0] * urdf.opening_sign(ref, 0)
    up = _stack(ref, front)
    if up is None:
        # z, as in robotics, or y, as in graphics, where z lies along the front.
        return urdf.CanonicalAxes(urdf.Z if abs(front[2]) < 0.7 else urdf.Y, front, ("up",))
    return urdf.CanonicalAxes(up, front)


def _stack(ref: MeshObject, front: np.ndarray) -> np.ndarray | None:
    """The direction across the front in which the drawers follow one another.

    None where they spread nearly as far the other way, or would be much taller than wide: such
    drawers stand side by side.
    """
    across = np.eye(3) - np.outer(front, front)
    centers = np.array([mesh.bounds().mean(0) for mesh in ref.parts[1:]]) @ across
    variance, directions = np.linalg.eigh(np.cov(centers.T))
    up = urdf.along_positive(urdf.level(directions[:, -1]))
    height, width = (
        np.mean([np.ptp(mesh.vertices @ direction) for mesh in ref.parts[1:]])
        for direction in (up, np.cross(up, front))
    )
    return up if variance[-1] > 4 * variance[-2] and height < 1.25 * width else None


_FRONT = Front("slide", axes=((0, 0, 1),) * 3, sorted_by=1)
DRAWER = Category(
    name="drawer",
    parts=("body", "drawer1", "drawer2", "drawer3"),
    joints=(Joint("prismatic", parent=0, limits=(0.0, 0.54)),) * 3,
    directions=("y", "z"),
    directions_reason="nearly mirror-symmetric in the y-z plane, so y and z are what shows",
    unit=1.78,
    mean_size=(
        (0.624, 0.773, 0.445),
        (0.559, 0.234, 0.399),
        (0.559, 0.2, 0.399),
        (0.559, 0.178, 0.399),
    ),
    mean_center=(
        (0.0, 0.0, -0.01),
        (-0.002, -0.168, 0.031),
        (-0.002, 0.059, 0.031),
        (-0.002, 0.257, 0.031),
    ),
    shape=shape,
    urdf_rule=urdf.UrdfRule(
        rest=urdf.closed_states,
        axes=_urdf_axes,
        opening=urdf.opens_along(urdf.Z),
        order=1,
        partnet_classes=("StorageFurniture", "Table"),
    ),
    datasets={
        "artimage": ArtImageConversion(4, (46123, 45841, 46440), _FRONT),
        "captra": CaptraConversion("drawers", (46440, 46123), _FRONT),
        "reart": NotConvertible(
            "drawers with one drawer each (2 parts), but our category 'drawer' has three (4 parts)"
        ),
    },
)
