"""eyeglasses: a frame (root) and two temples; unfolded at rest, z out of the lenses, y up.

Temples extend to -z; a positive state folds a temple inwards, by 90 deg at most.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.categories.eyeglasses import front as fronts
from caper_jax.categories.forms import about, beam, mirrored
from caper_jax.geometry.solids import Solid, ellipsoid

_Y = np.array([0.0, 1.0, 0.0])
_FOLDED = np.radians(90.0)


@dataclass(frozen=True)
class _Line:
    """What both temples share; lengths in meters, angles in radians.

    Attributes:
      slope: downwards, of the straight piece.
      splay: outwards.
      straight: length of the straight piece, from the hinge to the ear.
      taper: its section's width and height at the ear, relative to those at the hinge.
      hook: length of the rest, behind the ear.
      bend: how far down the rest turns in all.
      count: pieces of the rest.
      inwards: how fast it curves towards the head.
      tip: half width and half height of the end.
    """

    slope: float
    splay: float
    straight: float
    taper: tuple[float, float]
    hook: float
    bend: float
    count: int
    inwards: float
    tip: tuple[float, float]


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


def _temple(rng: np.random.Generator, hinge: np.ndarray, half, line: _Line) -> list[Solid]:
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
    pieces = [beam(hinge, ear, half, _Y, taper)]
    tip = np.array(line.tip)
    place, angle = ear, line.slope
    for index in range(line.count):
        angle += line.bend / line.count
        step = np.array([-line.inwards * (index + 1), -np.sin(angle), -np.cos(angle)])
        end = place + line.hook / line.count * step
        swell = 0.5 * (tip + taper * half) if index == 0 else tip
        pieces.append(beam(place - 0.4 * tip[1] * step, end, swell, _Y))
        place = end
    pieces.append(ellipsoid(place, (tip[0], tip[1], 1.2 * tip[1]), about("x", -angle)))
    return pieces


def _both(solids: list[Solid]) -> list[Solid]:
    return solids + [mirrored(solid, "x") for solid in solids]


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one pair: metal or plastic, full, half or no rim, browlines, sunglasses or a shield.

    Clear lenses are there in half of the instances (depth cameras look through glass), dark ones
    always.
    """
    style = str(
        rng.choice(["full", "half", "brow", "rimless", "shield"], p=[0.7, 0.12, 0.06, 0.05, 0.07])
    )
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
    left, right = (_temple(rng, hinge, (thin, high), line) for _ in range(2))
    left = [mirrored(solid, "x") for solid in left]
    # The hinge's axis may lean with the temple; folding takes -z to +x at -x, to -x at +x.
    lean = about("x", line.slope if rng.random() < 0.3 else 0.0) @ _Y
    pivot = hinge - (thin, 0.0, 0.0)
    limits = [(0.0, rng.uniform(np.radians(84), _FOLDED))] * 2
    return ObjectModel(
        [frame, left, right],
        np.stack([-lean, lean]),
        np.stack([pivot * (-1, 1, 1), pivot]),
        np.array(limits),
    )


EYEGLASSES = Category(
    name="eyeglasses",
    closed="high",
    parts=("frame", "temple at -x", "temple at +x"),
    joints=(
        Joint("revolute", parent=0, limits=(0.0, _FOLDED)),
        Joint("revolute", parent=0, limits=(0.0, _FOLDED)),
    ),
    directions=("y", "z"),
    directions_reason="mirror-symmetric in the y-z plane, so y and z are what the shape shows",
    unit=10.0,
    mean_size=((0.134, 0.044, 0.017), (0.009, 0.029, 0.126), (0.009, 0.029, 0.126)),
    mean_center=((0.0, 0.002, 0.062), (-0.063, -0.002, -0.008), (0.063, -0.002, -0.008)),
    shape=shape,
)
