"""Kinds and measures of staplers, drawn before their parts are built."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Probability, length and width of the base in meters, scale of the thicknesses. "half" are those
# of the seven ReArt-48 staplers: base 120-162 x 34-42 mm and 28-35 high with the hinge's cheeks,
# hinge 2-10 mm inside the back and 23-29 mm above the underside, arm 27-32 mm wide.
TYPES = {
    "half": (0.42, (0.105, 0.17), (0.028, 0.045), (0.8, 1.2)),
    "desk": (0.2, (0.15, 0.215), (0.032, 0.048), (0.9, 1.3)),
    "mini": (0.12, (0.045, 0.08), (0.017, 0.03), (0.55, 0.85)),
    "long": (0.08, (0.28, 0.42), (0.036, 0.06), (1.0, 1.4)),
    "heavy": (0.1, (0.22, 0.32), (0.05, 0.085), (1.4, 2.2)),
    "plier": (0.08, (0.08, 0.12), (0.016, 0.026), (0.9, 1.3)),
}


@dataclass(frozen=True)
class Plan:
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


def draw_plan(rng: np.random.Generator, name: str) -> Plan:
    _, lengths, widths, scales = TYPES[name]
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
    return Plan(
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
