"""A tenth category, from outside the package: a microwave oven with a door hinged at its side.

x to the right of who stands in front of it, y up, z out of the front. At rest the door is shut. It
hangs on a vertical line at its edge with the smaller x; a positive state swings it out, towards +z.
"""

from __future__ import annotations

import numpy as np

from caper_jax.articulation.category import Category, Joint, ObjectModel
from caper_jax.geometry.solids import box, cylinder


def shape(rng: np.random.Generator) -> ObjectModel:
    """Draws one oven; sizes in meters are those of table-top ones."""
    width, height, depth = rng.uniform((0.42, 0.24, 0.3), (0.56, 0.34, 0.46))
    wall = rng.uniform(0.015, 0.03)
    panel = width * rng.uniform(0.18, 0.3)  # with the buttons, beside the door
    thickness = rng.uniform(0.02, 0.04)
    half = np.array([width, height, depth]) / 2

    # The body: a block with the cooking space cut out of its front (a solid minus a convex hole).
    left, right = -half[0] + wall, half[0] - panel
    space = box(
        ((left + right) / 2, 0.0, wall),
        ((right - left) / 2, half[1] - wall, half[2]),
    )
    body = [box((0.0, 0.0, 0.0), half, hole=space)]
    lying = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # cylinder z -> y
    radius = 0.45 * min(right - left, depth - 2 * wall)
    tray = ((left + right) / 2, -half[1] + wall + 0.006, 0.0)
    body.append(cylinder(tray, (radius, radius, 0.006), lying))
    knob = rng.uniform(0.012, 0.022)
    for level in rng.uniform(0.1, 0.7) * half[1] * np.array([-1.0, 1.0]):
        place = (half[0] - panel / 2, level, half[2] + 0.008)
        body.append(cylinder(place, (knob, knob, 0.008)))

    # The door: a plate with a sunk window and a handle at its free edge.
    reach = width - panel
    middle = np.array([-half[0] + reach / 2, 0.0, half[2] + thickness / 2])
    window = box(
        middle + (0.0, 0.0, thickness / 2),
        (reach / 2 - 2 * wall, half[1] - 2 * wall, 0.3 * thickness),
    )
    door = [box(middle, (reach / 2, half[1], thickness / 2), hole=window)]
    handle = middle + (reach / 2 - wall, 0.0, thickness / 2 + 0.015)
    door.append(box(handle, (0.008, 0.7 * half[1], 0.015)))

    # The hinge line: vertical, at the door's edge. About -y the free edge (+x) moves to +z.
    axis = np.array([[0.0, -1.0, 0.0]])
    pivot = np.array([[-half[0], 0.0, half[2]]])
    limits = np.array([[0.0, np.radians(rng.uniform(95, 160))]])
    return ObjectModel([body, door], axis, pivot, limits)


MICROWAVE = Category(
    name="microwave",
    parts=("body", "door"),
    joints=(Joint("revolute", parent=0, limits=(0.0, np.radians(160))),),
    directions=("y", "z"),
    directions_reason="up and front are clear from the panel and the open side, however open",
    unit=2.8,  # 2 over the mean diagonal, 0.72 m
    mean_size=((0.49, 0.29, 0.396), (0.372, 0.29, 0.06)),
    mean_center=((0.0, 0.0, -0.022), (-0.059, 0.0, 0.19)),
    shape=shape,
)
