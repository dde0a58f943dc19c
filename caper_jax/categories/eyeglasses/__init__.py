"""eyeglasses: a frame (root) and two temples; unfolded at rest, z out of the lenses, y up.

Temples extend to -z; a positive state folds a temple inwards, by 90 deg at most.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.articulation.conversions import ArtImageConversion, CaptraConversion, Front
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.articulation.urdf_rule import CanonicalAxes, UrdfRule, along_positive, snap_state
from caper_jax.categories.eyeglasses import front as fronts
from caper_jax.categories.forms import UP, about, beam, mirrored
from caper_jax.geometry.solids import Solid, ellipsoid

_FOLDED = np.radians(90.0)


@dataclass(frozen=True)
class _Line:
    """What both temples share; lengths in meters, angles in radians."""

    slope: float  # downwards, of the straight piece
    splay: float  # outwards
    straight: float  # length of the straight piece, from the hinge to the ear
    taper: tuple[float, float]  # width and height at the ear, relative to those at the hinge
    hook: float  # length of the rest, behind the ear
    bend: float  # how far down the rest turns in all
    count: int  # pieces of the rest
    inwards: float  # how fast it curves towards the head
    tip: tuple[float, float]  # half width and half height of the end


def _draw_line(rng: np.random.Generator, scale: float, sturdy: bool) -> _Line:
    """Straight temples, skull temples (bent down behind the ear) or curved ones (hooks)."""
    style = int(rng.choice(3, p=[0.2, 0.62, 0.18]))
    length = scale * rng.uniform(0.118, 0.148)
    hook = length * rng.uniform(0.24, 0.36)
    tip = rng.uniform(0.0008, 0.0014), rng.uniform(0.0012, 0.0022)
    if style < 2 and rng.random() < 0.75:  # a plastic tip, or a broad end
        tip = rng.uniform(0.0012, 0.0024), rng.uniform(0.002, 0.0042)
    return _Line(
        slope=np.radians(rng.uniform(-1, 9)),
        splay=np.radians(rng.uniform(-5, 4)),
        straight=length - hook,
        taper=(rng.uniform(0.6, 1.0), rng.uniform(0.3 if sturdy else 0.5, 1.0)),
        hook=hook,
        bend=np.radians(rng.uniform(*((0, 8), (15, 45), (55, 95))[style])),
        count=style + 1,
        inwards=rng.uniform(0.0, 0.12),
        tip=tip,
    )


def _temple(rng: np.random.Generator, hinge: np.ndarray, half, line: _Line) -> Iterator[Solid]:
    """The right temple, from the hinge back to the tip behind the ear.

    Args:
      rng: bends it a little, as no pair of temples is bent quite alike.
      hinge: [3] the middle of its front end.
      half: half width and half height there.
      line: what both temples share.
    """
    thin, high = half
    splay = line.splay + rng.normal(0, np.radians(0.7))
    way = np.array([np.sin(splay), -np.sin(line.slope), -1.0])
    ear = hinge + line.straight * way
    taper = np.maximum(line.taper, (0.0006 / thin, 0.0008 / high)).clip(None, 1.0)
    yield beam(hinge, ear, half, UP, taper)
    tip = np.array(line.tip)
    place, angle = ear, line.slope
    for index in range(line.count):
        angle += line.bend / line.count
        step = np.array([-line.inwards * (index + 1), -np.sin(angle), -np.cos(angle)])
        end = place + line.hook / line.count * step
        swell = 0.5 * (tip + taper * half) if index == 0 else tip
        yield beam(place - 0.4 * tip[1] * step, end, swell, UP)
        place = end
    yield ellipsoid(place, (tip[0], tip[1], 1.2 * tip[1]), about("x", -angle))


def _both(solids: Iterable[Solid]) -> list[Solid]:
    solids = list(solids)
    return solids + [mirrored(solid, "x") for solid in solids]


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one pair: metal or plastic, full, half or no rim, browlines, sunglasses or a shield.

    Clear lenses are there in half of the instances (depth cameras look through glass), dark ones
    always.
    """
    styles = ["full", "half", "brow", "rimless", "shield"]
    style = str(rng.choice(styles, p=[0.7, 0.12, 0.06, 0.05, 0.07]))
    dark = style == "shield" or rng.random() < 0.35
    metal = style in ("half", "rimless") or rng.random() < 0.4
    front, name = fronts.draw_front(rng, metal, large=dark)
    if style == "shield":
        sag = rng.uniform(0.012, 0.03)
        front = replace(front, curve=sag / (front.width / 2) ** 2)
    b = front.half[1]
    if front.metal:
        high, thin = 0.0009 + 0.0026 * rng.random() ** 2, rng.uniform(0.0006, 0.0014)
    else:
        high, thin = rng.uniform(0.0018, 0.0065), rng.uniform(0.0012, 0.0024)
    if dark and rng.random() < 0.4:
        high *= 1.5
    height = rng.uniform(0.0, 0.3) * b if name == "round" else rng.uniform(0.1, 0.75) * b
    if style == "shield":
        height = rng.uniform(-0.1, 0.5) * b
    height = min(height, front.outline[:, 1].max() - 0.5 * high)
    x = front.width / 2 - thin
    hinge = front.place(x, height, -rng.uniform(0.003, 0.01) * front.scale)

    frame: list[Solid] = []
    if style == "shield":
        frame += fronts.shield(rng, front)
    else:
        if style != "rimless":
            frame += _both(fronts.rim(rng, front, style))
        if dark or style == "rimless" or rng.random() < 0.5:
            frame += _both(fronts.lens(rng, front))
        frame += fronts.bridge(rng, front, style != "rimless")
    if rng.random() < 0.8:
        frame += _both(fronts.nose_pad(rng, front, 0.0 if style == "half" else -0.35))
    frame += _both(fronts.end_piece(rng, front, hinge, (thin, high)))

    line = _draw_line(rng, front.scale, sturdy=not front.metal)
    left = [mirrored(solid, "x") for solid in _temple(rng, hinge, (thin, high), line)]
    right = list(_temple(rng, hinge, (thin, high), line))
    # The hinge's axis may lean with the temple; folding takes -z to +x at -x, to -x at +x.
    lean = about("x", line.slope if rng.random() < 0.3 else 0.0) @ UP
    pivot = hinge - (thin, 0.0, 0.0)
    limits = [(0.0, rng.uniform(np.radians(84), _FOLDED))] * 2
    axis, pivot = np.stack([-lean, lean]), np.stack([pivot * (-1, 1, 1), pivot])
    return ObjectModel([frame, left, right], axis, pivot, np.array(limits))


def _unfolded(ref: MeshObject) -> np.ndarray:
    """Every temple at a right angle to the front, within its range."""
    states = []
    for joint in range(ref.num_joints):
        turn = ref.turn(joint, ref.direction(0, joint), ref.direction(joint + 1, joint))
        low, high = ref.limits[joint] + np.radians([-20, 20])
        choices = [sign * np.pi / 2 - turn for sign in (-3, -1, 1, 3)]
        inside = [state for state in choices if low <= state <= high] or choices
        state = min(inside, key=abs)
        states.append(snap_state(state, ref.limits[joint], 20.0))
    return np.array(states)


def _urdf_axes(ref: MeshObject) -> CanonicalAxes:
    back = np.sum([ref.direction(joint + 1, joint) for joint in range(ref.num_joints)], axis=0)
    return CanonicalAxes(along_positive(ref.axis[0]), -back)


def _temple_axes(ref: MeshObject) -> np.ndarray:
    """A temple folds to the middle: about -y at -x, about +y at +x."""
    sides = np.array([mesh.bounds()[:, 0].mean() for mesh in ref.parts[1:]])
    return np.sign(sides)[:, None] * UP


# In the files the temples reach back from the lenses.
_FRONT = Front("behind", axes=((0, -1, 0), (0, 1, 0)), sorted_by=0)
EYEGLASSES = Category(
    name="eyeglasses",
    closed="high",
    parts=("frame", "temple at -x", "temple at +x"),
    joints=(
        Joint("revolute", parent=0, limits=(0.0, _FOLDED)),
        Joint("revolute", parent=0, limits=(0.0, _FOLDED)),
    ),
    directions=("y", "z"),
    stands=False,
    directions_reason="mirror-symmetric in the y-z plane, so y and z are what the shape shows",
    unit=10.0,
    mean_size=((0.134, 0.044, 0.017), (0.009, 0.029, 0.126), (0.009, 0.029, 0.126)),
    mean_center=((0.0, 0.002, 0.062), (-0.063, -0.002, -0.008), (0.063, -0.002, -0.008)),
    shape=shape,
    urdf_rule=UrdfRule(
        rest=_unfolded,
        axes=_urdf_axes,
        opening=_temple_axes,
        order=0,
        snap=20.0,
        partnet_classes=("Eyeglasses",),
    ),
    datasets={
        "artimage": ArtImageConversion(2, (101300, 101859, 102586, 102590, 102596, 102612), _FRONT),
        "captra": CaptraConversion(
            "glasses",
            (101839, 101848, 101860, 101326, 101868, 102591, 102596, 103028),
            _FRONT,
        ),
    },
)
