"""laptop: a base (root) and a lid on a hinge along x at its back; open by 90 deg at rest."""

from __future__ import annotations

import numpy as np

from caper_jax.articulation.category import Category, Equivalence, Joint, ObjectModel
from caper_jax.geometry.solids import Solid, box, cylinder

# Positive opens: the lid, above the hinge (+y) at rest, leans back (-z), which is about -x.
_HINGE = np.array([[-1.0, 0.0, 0.0]])
_TURN_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # cylinder z -> x


def _tilt_x(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


def _keyboard(rng: np.random.Generator, width: float, depth: float, top: float) -> list[Solid]:
    """Rows of keys standing out of the palm rest, and a touch pad."""
    rows = int(rng.integers(3, 6))
    reach = rng.uniform(0.35, 0.5) * depth
    back = -depth / 2 + 0.1 * depth
    half_width = width * rng.uniform(0.4, 0.46)
    keys = [
        box(
            (0, top + 0.0008, back + (row + 0.5) * reach / rows),
            (half_width, 0.0014, reach / rows * 0.38),
        )
        for row in range(rows)
    ]
    pad_x = rng.uniform(-0.1, 0.05) * width
    keys.append(box((pad_x, top, depth / 2 - 0.17 * depth), (width * 0.14, 0.001, depth * 0.11)))
    return keys


def _base(rng: np.random.Generator, width: float, depth: float, thickness: float) -> list[Solid]:
    """Slab, wedge or rounded slab, with keyboard and perhaps feet or a battery bulge."""
    top = thickness / 2
    half = np.array([width, thickness, depth]) / 2
    style = rng.random()
    recess: Solid | None = None
    keyboard: list[Solid] = []
    if rng.random() < 0.65:
        keyboard = _keyboard(rng, width, depth, top)
    elif rng.random() < 0.6:
        reach = rng.uniform(0.35, 0.5) * depth
        center = (0, top, -depth / 2 + 0.1 * depth + reach / 2)
        recess = box(center, (width * 0.44, min(0.003, 0.3 * thickness), reach / 2))
    if style < 0.5:
        solids = [box((0, 0, 0), half, hole=recess)]
    elif style < 0.75:  # wedge: the underside rises to the front
        rise = np.arctan2(thickness * rng.uniform(0.3, 0.6), depth)
        cut = box((0, -thickness, depth * 0.1), (width, thickness / 2, depth), _tilt_x(-rise))
        solids = [box((0, 0, 0), half, hole=cut)]
    else:  # rounded front and sides
        radius = thickness / 2
        core = half - (radius, 0, radius)
        solids = [box((0, 0, -radius / 2), (core[0], half[1], half[2] - radius / 2), hole=recess)]
        edge = (radius, radius, core[0])
        solids.append(cylinder((0, 0, half[2] - radius), edge, _TURN_X))
        for side in (-1, 1):
            left = (side * core[0], 0, -radius / 2)
            solids.append(cylinder(left, (radius, radius, half[2] - radius / 2)))
    solids += keyboard
    if rng.random() < 0.3:
        bulge = rng.uniform(0.003, 0.01)
        place = (0, -top - bulge / 2, -depth * rng.uniform(0.2, 0.35))
        solids.append(box(place, (width * rng.uniform(0.25, 0.45), bulge / 2, depth * 0.12)))
    return solids


def _lid(rng: np.random.Generator, width: float, height: float, thickness: float, hinge):
    """Plate above the hinge whose front (+z) is the screen, with a bezel or a logo bump."""
    center = np.array([hinge[0], hinge[1] + height / 2, hinge[2] - thickness / 2])
    half = np.array([width, height, thickness]) / 2
    screen: Solid | None = None
    if rng.random() < 0.75:
        bezel = rng.uniform(0.004, 0.02)
        chin = rng.uniform(0.006, 0.03)
        sunk = min(rng.uniform(0.0008, 0.003), 0.4 * thickness)
        screen = box(
            center + (0, (chin - bezel) / 2, thickness / 2),
            (half[0] - bezel, half[1] - (bezel + chin) / 2, sunk),
        )
    solids = [box(center, half, hole=screen)]
    if rng.random() < 0.2:
        solids.append(box(center - (0, 0, thickness / 2), (0.02, 0.02, 0.0008)))
    return solids


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one laptop, from sub-notebooks to thick gaming machines.

    Mean part sizes follow the published ArtImage means (width : depth : lid height =
    1.30 : 0.92 : 0.90).
    """
    width = rng.uniform(0.25, 0.41)
    depth = width * rng.uniform(0.62, 0.78)
    thickness = rng.choice([rng.uniform(0.009, 0.018), rng.uniform(0.016, 0.036)])
    lid_thickness = rng.uniform(0.004, min(0.014, 0.75 * thickness))
    lid_height = depth * rng.uniform(0.92, 1.03)
    base = _base(rng, width, depth, thickness)
    radius = min(thickness * rng.uniform(0.25, 0.45), 0.008)
    drop = rng.random() < 0.25  # hinge behind the base, the lid sinks below its top
    hinge_y = thickness / 2 + (-radius if drop else radius * rng.uniform(0.2, 1.0))
    hinge_z = -depth / 2 + (-radius if drop else radius * rng.uniform(0.5, 3.0))
    hinge = np.array([0.0, hinge_y, hinge_z])
    if rng.random() < 0.5:
        half_length = width * rng.uniform(0.2, 0.45)
        base.append(cylinder(hinge, (radius, radius, half_length), _TURN_X))
    else:
        for side in (-1, 1):
            place = hinge + (side * width * rng.uniform(0.28, 0.42), 0, 0)
            base.append(cylinder(place, (radius, radius, width * 0.05), _TURN_X))
    lid = _lid(rng, width * rng.uniform(0.97, 1.0), lid_height, lid_thickness, hinge)
    limits = np.radians([[-70.0, 60.0]])
    return ObjectModel([base, lid], _HINGE, hinge[None], limits)


LAPTOP = Category(
    name="laptop",
    parts=("base", "lid"),
    joints=(Joint("revolute", parent=0, limits=(np.radians(-70), np.radians(60))),),
    directions=("y", "z"),
    directions_reason="mirror-symmetric in the y-z plane, so y and z are what the shape shows",
    unit=4.0,
    mean_size=((0.331, 0.029, 0.236), (0.326, 0.227, 0.008)),
    mean_center=((0.0, -0.11, 0.001), (0.0, 0.012, -0.112)),
    shape=shape,
    equivalences=(
        Equivalence(
            permutation=(1, 0),
            turn=((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
            reason="without a visible keyboard, base and lid are two like plates",
        ),
    ),
)
