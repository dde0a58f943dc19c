"""Skeletons of robot arms: where the joints of seven links sit at zero joint angles.

Proportions and joint ranges are those of real arms as their makers publish them in data sheets,
manuals and robot descriptions (Denavit-Hartenberg tables, URDF): UR3e, UR5e and UR10e; Franka
Panda; KUKA LBR iiwa; Kinova Gen3; Doosan M1013 and M0609; ABB IRB 120 and IRB 140, KUKA KR 6 R900,
FANUC LR Mate 200iD; UFACTORY xArm 6; Rethink Sawyer. Zero is the published zero pose, turned to
y up and z forward: offset cobots and the Sawyer lie stretched out forward, industrial arms have
the upper arm up and the forearm forward, the xArm folds its forearm down in front, and the others
stand upright (the Panda with its hand hanging down).

An arm of seven joints is reduced to six by fixing the roll of its upper arm or of its flange.
Ranges are narrowed where nearly every pose of the rest of the range would drive the arm into the
floor or into itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Chain:
    """A serial chain of seven links in its rest pose, on the floor (y = 0) at the origin."""

    # Of each link [n, 3] points, meters: path k begins on joint k (path 0 on the floor) and ends
    # where joint k + 1 is.
    paths: tuple[np.ndarray, ...]
    # Of the six joints, the letter of the positive canonical axis each turns about at rest.
    axes: str
    limits: np.ndarray  # [6, 2] degrees from the rest pose
    tip: np.ndarray  # [3] unit direction that the flange faces
    radius: float  # half the thickness of the lowest link, meters


def _chain(links: Sequence[Sequence[Point]], axes: str, limits, tip: Point, radius: float) -> Chain:
    """Each link goes on where the one before it ended, through the points given."""
    starts = [(0, 0, 0), *(link[-1] for link in links)]
    paths = tuple(np.array([start, *link]) for start, link in zip(starts, links, strict=False))
    return Chain(paths, axes, np.array(limits, float), np.array(tip), radius)


def _varied(rng: np.random.Generator, *lengths: float) -> np.ndarray:
    """Each length changed by up to 15 %."""
    return rng.uniform(0.85, 1.15, len(lengths)) * lengths


def offset_cobot(rng: np.random.Generator) -> Chain:
    """Tubes side by side: every link is mounted on the flank of the one before it."""
    rows = (  # DH d1, a2, a3, d5, d6; shoulder and wrist offsets (d4); radius
        (0.152, 0.244, 0.213, 0.085, 0.092, 0.12, 0.131, 0.052),
        (0.163, 0.425, 0.392, 0.1, 0.1, 0.138, 0.133, 0.063),
        (0.181, 0.613, 0.572, 0.12, 0.117, 0.176, 0.174, 0.085),
    )
    h, a, b, down, out, s, w, radius = _varied(rng, *rows[rng.integers(3)])
    inner = rng.uniform(0.0, 0.25) * s  # the forearm lies that far from the middle plane
    reach = a + b
    links = [
        [(0, 0.5 * h, 0)],
        [(0, h, 0), (0.45 * s, h, 0)],
        [(s, h, 0), (s, h, a), (0.5 * (s + inner), h, a)],
        [(inner, h, a), (inner, h, reach), (0.5 * w, h, reach)],
        [(w, h, reach), (w, h - 0.5 * down, reach)],
        [(w, h - down, reach), (w + 0.55 * out, h - down, reach)],
        [(w + out, h - down, reach)],
    ]
    limits = [(-170, 170), (-140, 5), (-70, 110), (-150, 90), (-120, 120), (-175, 175)]
    return _chain(links, "yxxxyx", limits, (1, 0, 0), radius)


def panda(rng: np.random.Generator) -> Chain:
    """Upright, the elbow set forward, the hand hanging in front of the forearm."""
    h, a, b, elbow, hang, flange = _varied(rng, 0.333, 0.316, 0.384, 0.0825, 0.088, 0.107)
    knee, wrist = h + a, h + a + b
    low = wrist - flange
    first = [[(0, 0.42 * h, 0)], [(0, h, 0)]]
    elbow_links = [
        [(0, knee - 0.3 * a, 0), (0, knee, elbow)],
        [(0, knee + 0.3 * b, 0)],
        [(0, wrist, 0)],
    ]
    if rng.random() < 0.6:  # the flange does not turn
        hand = [(0, wrist, hang), (0, low, hang)]
        links = [*first, [(0, h + 0.55 * a, 0)], *elbow_links, hand]
        limits = [(-166, 166), (-60, 75), (-130, 130), (-1, 140), (-150, 150), (-200, 1)]
        return _chain(links, "yxyxyx", limits, (0, -1, 0), 0.068)
    hand = [(0, wrist, hang), (0, wrist - 0.55 * flange, hang)]
    links = [*first, *elbow_links, hand, [(0, low, hang)]]
    limits = [(-166, 166), (-60, 75), (-1, 130), (-150, 150), (-200, 1), (-166, 166)]
    return _chain(links, "yxxyxy", limits, (0, -1, 0), 0.068)


def upright(rng: np.random.Generator) -> Chain:
    """A straight column of links; roll and pitch take turns."""
    rows = (  # floor to shoulder, to elbow, to wrist, to flange; radius
        (0.34, 0.4, 0.4, 0.126, 0.075),
        (0.285, 0.421, 0.314, 0.167, 0.05),
    )
    h, a, b, c, radius = _varied(rng, *rows[rng.integers(2)])
    knee, wrist, top = h + a, h + a + b, h + a + b + c
    if rng.random() < 0.5:  # the upper arm does not roll
        stops = [h, knee, knee + 0.5 * b, wrist, wrist + 0.55 * c, top]
        axes = "yxxyxy"
        limits = [(-170, 170), (-75, 75), (-120, 120), (-170, 170), (-115, 115), (-175, 175)]
    else:  # the flange does not
        stops = [h, h + 0.5 * a, knee, knee + 0.5 * b, wrist, top]
        axes = "yxyxyx"
        limits = [(-170, 170), (-75, 75), (-170, 170), (-120, 120), (-170, 170), (-115, 115)]
    links = [[(0, y, 0)] for y in (0.45 * h, *stops)]
    return _chain(links, axes, limits, (0, 1, 0), radius)


def upright_offset(rng: np.random.Generator) -> Chain:
    """Upright, with the upper arm on the flank of the shoulder."""
    rows = ((0.153, 0.62, 0.559, 0.121, 0.2, 0.078), (0.135, 0.411, 0.368, 0.121, 0.16, 0.062))
    h, a, b, c, s, radius = _varied(rng, *rows[rng.integers(2)])
    inner = rng.uniform(0.0, 0.3) * s
    knee, wrist = h + a, h + a + b
    links = [
        [(0, 0.4 * h, 0)],
        [(0, h, 0), (0.45 * s, h, 0)],
        [(s, h, 0), (s, knee, 0), (0.55 * s, knee, 0)],
        [(inner, knee, 0), (inner, knee + 0.35 * b, 0)],
        [(inner, wrist, 0)],
        [(inner, wrist + 0.55 * c, 0)],
        [(inner, wrist + c, 0)],
    ]
    limits = [(-170, 170), (-75, 75), (-135, 135), (-170, 170), (-130, 130), (-175, 175)]
    return _chain(links, "yxxyxy", limits, (0, 1, 0), radius)


def industrial(rng: np.random.Generator) -> Chain:
    """Upper arm up, forearm forward, a wrist whose three axes meet."""
    rows = (  # d1, a1, a2, a3, d4, d6; radius
        (0.29, 0.0, 0.27, 0.07, 0.302, 0.072, 0.085),
        (0.352, 0.07, 0.36, 0.0, 0.38, 0.065, 0.1),
        (0.4, 0.025, 0.455, 0.035, 0.42, 0.08, 0.095),
        (0.33, 0.05, 0.33, 0.035, 0.335, 0.08, 0.085),
    )
    h, forth, a, rise, b, c, radius = _varied(rng, *rows[rng.integers(4)])
    top = h + a + rise
    bend, wrist = forth + rng.uniform(0.25, 0.45) * b, forth + b
    links = [
        [(0, 0.45 * h, 0)],
        [(0, h, forth)],
        [(0, h + a, forth)],
        [(0, top, bend)],
        [(0, top, wrist)],
        [(0, top, wrist + 0.6 * c)],
        [(0, top, wrist + c)],
    ]
    limits = [(-165, 165), (-80, 85), (-100, 60), (-160, 160), (-115, 115), (-175, 175)]
    return _chain(links, "yxxzxz", limits, (0, 0, 1), radius)


def folded(rng: np.random.Generator) -> Chain:
    """Upper arm up, forearm hanging in front of it, flange facing the floor."""
    h, a, lean, forth, b, out, c = _varied(rng, 0.267, 0.284, 0.0535, 0.0775, 0.3425, 0.076, 0.097)
    knee, middle, tip = h + a, lean + forth, lean + forth + out
    wrist = knee - min(b, knee - 2.6 * c)
    links = [
        [(0, 0.5 * h, 0)],
        [(0, h, 0)],
        [(0, knee, lean)],
        [(0, knee, middle), (0, knee - 0.4 * b, middle)],
        [(0, wrist, middle)],
        [(0, wrist, tip), (0, wrist - 0.5 * c, tip)],
        [(0, wrist - c, tip)],
    ]
    limits = [(-170, 170), (-100, 60), (-190, 8), (-170, 170), (-110, 90), (-175, 175)]
    return _chain(links, "yxxyxy", limits, (0, -1, 0), 0.046)


def outstretched(rng: np.random.Generator) -> Chain:
    """Stretched out forward; links alternate between the two sides of the shoulder."""
    h, forth, side, back, a, b, w, c = _varied(
        rng, 0.317, 0.081, 0.1925, 0.1685, 0.4, 0.4, 0.1363, 0.134
    )
    inner = side - back
    outer = inner + w
    knee, wrist = forth + a, forth + a + b
    links = [
        [(0, 0.6 * h, 0)],
        [(0, h, 0), (0, h, forth), (0.45 * side, h, forth)],
        [(side, h, forth), (side, h, knee), (0.5 * side, h, knee)],
        [(inner, h, knee), (inner, h, knee + 0.4 * b)],
        [(inner, h, wrist), (inner + 0.5 * w, h, wrist)],
        [(outer, h, wrist), (outer, h, wrist + 0.5 * c)],
        [(outer, h, wrist + c)],
    ]
    limits = [(-170, 170), (-130, 8), (-75, 110), (-170, 170), (-120, 120), (-175, 175)]
    return _chain(links, "yxxzxz", limits, (0, 0, 1), 0.07)
