"""laptop: a base (root) and a lid on a hinge along x at its back; open by 90 deg at rest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from caper_jax.articulation import urdf_rule as urdf
from caper_jax.articulation.category import Category, Joint, ObjectModel, Symmetry
from caper_jax.articulation.conversions import ArtImageConversion, CaptraConversion, Front
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.categories.forms import TURN_X, TURN_Y, UPSIDE_DOWN, about
from caper_jax.geometry.solids import Solid, box, cylinder, frustum

# Positive opens: the lid, above the hinge (+y) at rest, leans back (-z), which is about -x.
_HINGE = np.array([[-1.0, 0.0, 0.0]])


def _keyboard(rng: np.random.Generator, width: float, depth: float, top: float) -> Iterator[Solid]:
    """Rows of keys standing out of the palm rest, and a touch pad."""
    rows = int(rng.integers(3, 6))
    reach = rng.uniform(0.35, 0.5) * depth
    back = -depth / 2 + 0.1 * depth
    half_width = width * rng.uniform(0.4, 0.46)
    for row in range(rows):
        place = (0, top + 0.0008, back + (row + 0.5) * reach / rows)
        yield box(place, (half_width, 0.0014, reach / rows * 0.38))
    pad_x = rng.uniform(-0.1, 0.05) * width
    yield box((pad_x, top, depth / 2 - 0.17 * depth), (width * 0.14, 0.001, depth * 0.11))


def _base(
    rng: np.random.Generator, width: float, depth: float, thickness: float
) -> Iterator[Solid]:
    """The keyboard half: one of six bodies, with keyboard and perhaps feet or a battery bulge."""
    top = thickness / 2
    half = np.array([width, thickness, depth]) / 2
    body = rng.choice(
        ["slab", "corners", "undercut", "teardrop", "wedge", "rounded"],
        p=[0.22, 0.23, 0.15, 0.12, 0.1, 0.18],
    )
    recess: Solid | None = None
    keyboard: list[Solid] = []
    if rng.random() < 0.65 or body in ("undercut", "teardrop"):
        keyboard = list(_keyboard(rng, width, depth, top))
    elif rng.random() < 0.6:
        reach = rng.uniform(0.35, 0.5) * depth
        center = (0, top, -depth / 2 + 0.1 * depth + reach / 2)
        recess = box(center, (width * 0.44, min(0.003, 0.3 * thickness), reach / 2))
    if body == "slab":
        yield box((0, 0, 0), half, hole=recess)
    elif body == "corners":  # rounded at the front, seen from above
        radius = rng.uniform(0.006, 0.022)
        yield box((0, 0, -radius / 2), half - (0, 0, radius / 2), hole=recess)
        yield box((0, 0, half[2] - radius / 2), (half[0] - radius, half[1], radius / 2))
        for side in (-1, 1):
            corner = (side * (half[0] - radius), 0, half[2] - radius)
            yield cylinder(corner, (radius, radius, half[1]), TURN_Y)
    elif body == "undercut":  # smaller at the bottom
        taper = 1 - rng.uniform(0.5, 1.6) * thickness / np.array([width, depth])
        yield frustum((0, 0, 0), (half[0], half[2], half[1]), taper, UPSIDE_DOWN)
    elif body == "teardrop":  # thin at the front, its top level: turned by half the angle
        thin = rng.uniform(0.3, 0.7)
        slope = np.arctan2(thickness * (1 - thin) / 2, depth)
        raised = (0, thickness * (1 - thin) / 4, 0)
        yield frustum(raised, half, (1.0, thin), about("x", -slope))
    elif body == "wedge":  # cut off from below towards the front
        rise = np.arctan2(thickness * rng.uniform(0.3, 0.6), depth)
        cut = box((0, -thickness, depth * 0.1), (width, thickness / 2, depth), about("x", -rise))
        yield box((0, 0, 0), half, hole=cut)
    else:  # rounded front and sides
        radius = thickness / 2
        core = half - (radius, 0, radius)
        yield box((0, 0, -radius / 2), (core[0], half[1], half[2] - radius / 2), hole=recess)
        edge = (radius, radius, core[0])
        yield cylinder((0, 0, half[2] - radius), edge, TURN_X)
        for side in (-1, 1):
            flank = (side * core[0], 0, -radius / 2)
            yield cylinder(flank, (radius, radius, half[2] - radius / 2))
    yield from keyboard
    if rng.random() < 0.3:
        bulge = rng.uniform(0.003, 0.01)
        place = (0, -top - bulge / 2, -depth * rng.uniform(0.2, 0.35))
        yield box(place, (width * rng.uniform(0.25, 0.45), bulge / 2, depth * 0.12))


def _lid(
    rng: np.random.Generator, width: float, height: float, thickness: float, hinge
) -> Iterator[Solid]:
    """Plate above the hinge whose front (+z) is the screen, with a bezel or a logo bump."""
    center = np.array([hinge[0], hinge[1] + height / 2, hinge[2] - thickness / 2])
    half = np.array([width, height, thickness]) / 2
    screen: Solid | None = None
    if rng.random() < 0.75:
        bezel = rng.uniform(0.002, 0.02)
        chin = rng.uniform(0.006, 0.03)
        sunk = min(rng.uniform(0.0008, 0.003), 0.4 * thickness)
        screen = box(
            center + (0, (chin - bezel) / 2, thickness / 2),
            (half[0] - bezel, half[1] - (bezel + chin) / 2, sunk),
        )
    style = rng.random()
    if style < 0.4:  # rounded corners at the top
        radius = rng.uniform(0.005, 0.02)
        strip = center + (0, half[1] - radius / 2, 0)
        yield box(center - (0, radius / 2, 0), half - (0, radius / 2, 0), hole=screen)
        yield box(strip, (half[0] - radius, radius / 2, half[2]), hole=screen)
        for side in (-1, 1):
            corner = center + (side * (half[0] - radius), half[1] - radius, 0)
            yield cylinder(corner, (radius, radius, half[2]))
    elif style < 0.7 and screen is None:  # thinner at the edges: the back is a flat pyramid
        taper = 1 - rng.uniform(0.5, 3.0) * thickness / np.array([width, height])
        yield frustum(center, half, taper, about("y", np.pi))
    else:
        yield box(center, half, hole=screen)
    if rng.random() < 0.2:
        yield box(center - (0, 0, thickness / 2), (0.02, 0.02, 0.0008))


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
    base = list(_base(rng, width, depth, thickness))
    radius = min(thickness * rng.uniform(0.25, 0.45), 0.008)
    drop = rng.random() < 0.25  # hinge behind the base, the lid sinks below its top
    hinge_y = thickness / 2 + (-radius if drop else radius * rng.uniform(0.2, 1.0))
    hinge_z = -depth / 2 + (-radius if drop else radius * rng.uniform(0.5, 3.0))
    hinge = np.array([0.0, hinge_y, hinge_z])
    if rng.random() < 0.5:
        half_length = width * rng.uniform(0.2, 0.45)
        base.append(cylinder(hinge, (radius, radius, half_length), TURN_X))
    else:
        for side in (-1, 1):
            place = hinge + (side * width * rng.uniform(0.28, 0.42), 0, 0)
            base.append(cylinder(place, (radius, radius, width * 0.05), TURN_X))
    lid = _lid(rng, width * rng.uniform(0.97, 1.0), lid_height, lid_thickness, hinge)
    limits = np.radians([[-70.0, 60.0]])
    return ObjectModel([base, list(lid)], _HINGE, hinge[None], limits)


def _perpendicular(ref: MeshObject) -> np.ndarray:
    """The lid's plate at 90 deg to the base's, on the side to which it opens."""
    opening = ref.turn(0, urdf.level(ref.direction(0, 0)), ref.direction(1, 0))
    if np.radians(10) < abs(opening) < np.radians(170):
        sense = np.sign(opening)
    elif abs(opening) <= np.radians(10):
        sense = urdf.opening_sign(ref, 0)
    else:  # modeled flat open: most of the range closes it
        sense = -urdf.opening_sign(ref, 0)
        opening = sense * abs(opening)
    state = sense * np.pi / 2 - opening
    return np.array([urdf.snap_state(state, ref.limits[0], 6.0, quarter=True)])


def _urdf_axes(ref: MeshObject) -> urdf.CanonicalAxes:
    return urdf.CanonicalAxes(ref.direction(1, 0), urdf.level(ref.direction(0, 0)))


# In the files the lid stands at the back of the base.
_FRONT = Front("behind", axes=((-1, 0, 0),))
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
    symmetries=(
        Symmetry(
            permutation=(1, 0),
            rotation=((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
            reason="without a visible keyboard, base and lid are two like plates",
        ),
    ),
    urdf_rule=urdf.UrdfRule(
        rest=_perpendicular,
        axes=_urdf_axes,
        opening=urdf.opens_along(-urdf.X),
        child_words=("screen", "lid", "display", "monitor"),
        partnet_classes=("Laptop",),
    ),
    datasets={
        "artimage": ArtImageConversion(1, (10040, 10885, 11242, 11030, 11156), _FRONT),
        "captra": CaptraConversion(
            "laptop", (10101, 10270, 10356, 11156, 11405, 11581), _FRONT, lower_root=True
        ),
    },
)
