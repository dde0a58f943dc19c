"""Kinds and measures of cutters, drawn before their parts are built."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LONGEST = 0.115  # meters of extension that any instance allows
SHARE = 0.9  # of the slider's way that is used

# Probability; length, width and height of the handle and width of the blade, meters. "wide" and
# "slim" are those of the nine ReArt-48 cutters: handle 105-163 x 22-34 x 11-20 mm, blade with
# carrier 78-134 x 12-22 mm, 71-97 mm of travel, slider up to 5 mm above the face.
TYPES = {
    "slim": (0.27, (0.105, 0.15), (0.016, 0.026), (0.008, 0.015), (0.008, 0.013)),
    "wide": (0.38, (0.13, 0.178), (0.025, 0.036), (0.011, 0.021), (0.016, 0.023)),
    "utility": (0.2, (0.13, 0.175), (0.026, 0.042), (0.014, 0.026), (0.017, 0.02)),
    "card": (0.08, (0.06, 0.095), (0.018, 0.034), (0.005, 0.01), (0.008, 0.018)),
    "pen": (0.07, (0.12, 0.16), (0.01, 0.015), (0.009, 0.014), (0.006, 0.008)),
}


@dataclass(frozen=True)
class Plan:
    """Measures in meters; the handle spans x in [0, length] and y in [-height / 2, height / 2].

    Attributes:
      length, width, height: of the handle.
      back, front: x of the ends of its body; before and behind come its round end and its nose.
      floor: y of the underside of the blade's channel.
      gap: height of the channel.
      blade: width of the blade.
      aside: z of the middle of blade and slot.
      slot: x of the slot's ends.
      slot_width: its width.
      slider: length of the slider.
      edge: the slider runs on the narrow side (-z) instead of the flat face.
    """

    length: float
    width: float
    height: float
    back: float
    front: float
    floor: float
    gap: float
    blade: float
    aside: float
    slot: tuple[float, float]
    slot_width: float
    slider: float
    edge: bool


def draw_plan(rng: np.random.Generator, name: str) -> Plan:
    _, *ranges = TYPES[name]
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
    way = min(share * length, 0.98 * LONGEST / SHARE)
    ahead = rng.uniform(0.14, 0.3) if name in ("utility", "pen") else rng.uniform(0.05, 0.2)
    end = length * (1 - ahead)
    start = max(end - way - slider, back + 0.03 * length)
    front = length
    if name in ("utility", "pen") or rng.random() < 0.5:
        front = end + (length - end) * rng.uniform(0.2, 0.6)
    gap = min(rng.uniform(0.0012, 0.003), 0.25 * height)
    return Plan(
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
