"""Canonical frames of ArtImage and PM-Videos, brought to ours.

Their files keep objects in an upright frame (y up) at a rest pose of their own. The sample data
for laptop, dishwasher and drawer have our frame and our rest pose, so the turn found here is the
identity for them. The official files could not be read. What is known of them is that PartNet
objects stand upright and face one horizontal axis, so the front is found from the parts at rest:
a laptop's lid stands at its back, a dishwasher's open door lies in front, drawers open to the
front, temples reach back from the lenses. That the official rest pose is ours (laptop and
dishwasher open by 90 deg, drawers closed, glasses unfolded) is assumed, not verified.

Scissors are aligned one by one in the official files, to a frame that no public source states.
They are turned so that the joint axis is y and the tips, the side on which the two parts are
slimmer, lie along x; their rest pose is the file's, whose opening is not known to
be our 20 deg. Objects of other categories are taken to be in our frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.errors import CaperError


@dataclass(frozen=True)
class Rest:
    """An object at rest, in one frame.

    Attributes:
      points: K arrays [n, 3] meters, the parts' surfaces.
      axis: [J, 3] unit axes; a positive state turns or slides the child by plus the state.
      pivot: [J, 3] meters.
      opening: [J] +1 where a positive state leads into the joint's range, -1 where it leads out.
    """

    points: list[np.ndarray]
    axis: np.ndarray
    pivot: np.ndarray
    opening: np.ndarray


@dataclass(frozen=True)
class AxisMap:
    """How a file's frame, parts and joints become ours.

    Attributes:
      turn: [3, 3] rotation, the file's frame -> our axes.
      order: part k is link ``order[k]`` of the file.
      signs: [J] our state of joint j (in our order) is ``signs[j]`` times the file's.
    """

    turn: np.ndarray
    order: tuple[int, ...]
    signs: np.ndarray


@dataclass(frozen=True)
class _Upright:
    """What tells the front of an upright category, and what its joints are in our frame.

    Attributes:
      front: "slide" (the direction in which its joints open), or the side of the root on which
        the moving parts lie at rest: "ahead" or "behind".
      axes: [J] unit axes in our frame, positive opens.
      sorted_by: our axis along which the moving parts are numbered, or None to keep their order.
    """

    front: str
    axes: tuple[tuple[int, int, int], ...]
    sorted_by: int | None = None


_UPRIGHT = {
    "laptop": _Upright("behind", ((-1, 0, 0),)),
    "dishwasher": _Upright("ahead", ((1, 0, 0),)),
    "drawer": _Upright("slide", ((0, 0, 1),) * 3, sorted_by=1),
    "eyeglasses": _Upright("behind", ((0, -1, 0), (0, 1, 0)), sorted_by=0),
}
_LEAST_SHARE = 0.3  # of a direction must be horizontal to tell where the front is
_LEAST_COSINE = 0.5  # between a joint's axis and the one it must be


def canonical_axes(rest: Rest, category: Category, where: str) -> AxisMap:
    """The turn, order and signs that bring an object of a public file to our conventions.

    Args:
      rest: the object at the file's rest pose, in the file's frame.
      category: ours.
      where: the file, for errors.

    Raises:
      CaperError: an object that does not face one side, or whose joints lie across those of its
        category.
    """
    identity = AxisMap(np.eye(3), tuple(range(category.num_parts)), np.ones(category.num_joints))
    if category.name == "scissors":
        return _scissors_reading(rest, where)
    rule = _UPRIGHT.get(category.name)
    if rule is None or len(rule.axes) != category.num_joints:
        return identity

    centers = np.array([(part.min(0) + part.max(0)) / 2 for part in rest.points])
    if rule.front == "slide":
        front = (rest.opening[:, None] * rest.axis).mean(0)
    else:
        front = (centers[1:] - centers[0]).mean(0) * (1 if rule.front == "ahead" else -1)
    horizontal = np.hypot(front[0], front[2])
    if horizontal < _LEAST_SHARE * np.linalg.norm(front):
        raise CaperError(
            f"{where}: cannot tell the front of this {category.name}: its parts lie above each "
            "other or slide upwards; y must be up"
        )
    # The turn about y by quarters after which the front is +z.
    quarters = int(np.rint(np.arctan2(-front[0], front[2]) / (np.pi / 2)))
    turn = np.rint(_about_y(quarters * np.pi / 2))

    order = np.arange(category.num_parts)
    if rule.sorted_by is not None:
        order[1:] = 1 + np.argsort(centers[1:] @ turn[rule.sorted_by], kind="stable")
    axis = rest.axis[order[1:] - 1] @ turn.T
    cosines = (axis * np.array(rule.axes)).sum(-1)
    if (np.abs(cosines) < _LEAST_COSINE).any():
        joint = int(np.abs(cosines).argmin())
        raise CaperError(
            f"{where}: the axis of joint {order[joint + 1]} lies across that of a {category.name} "
            f"({np.round(axis[joint], 3).tolist()} in our frame, expected {rule.axes[joint]})"
        )
    return AxisMap(turn, tuple(order.tolist()), np.sign(cosines))


def _scissors_reading(rest: Rest, where: str) -> AxisMap:
    """x to the tips, y along the pivot; positive opens, about +y."""
    axis = rest.axis[0]
    # Any frame with the axis as its second direction.
    helper = np.eye(3)[np.abs(axis).argmin()]
    across = helper - (helper @ axis) * axis
    across /= np.linalg.norm(across)
    plane = np.stack([across, np.cross(across, axis)])
    flat = [(part - rest.pivot[0]) @ plane.T for part in rest.points]
    everything = np.concatenate(flat)
    length = np.abs(everything).max()
    if length == 0:
        raise CaperError(f"{where}: part_point_sample holds no scissors, all points coincide")
    _, vectors = np.linalg.eigh(everything.T @ everything)
    candidates = [vectors[:, 1], -vectors[:, 1]]
    if np.abs(axis).max() > np.cos(np.radians(1)):
        # The file's axes serve, where the axis of the joint is one of them.
        others = np.delete(np.eye(3), np.abs(axis).argmax(), axis=0) @ plane.T
        nearest = others[np.abs(others @ vectors[:, 1]).argmax()]
        candidates = [nearest, -nearest]
    tips = min(candidates, key=lambda ahead: sum(_width(part, ahead) for part in flat))

    aside = np.array([tips[1], -tips[0]])  # axis x tips, in the plane's coordinates
    gap = np.diff([part[(part @ tips).argmax()] @ aside for part in flat])[0]
    opening = np.sign(gap) if np.abs(gap) > 0.02 * length else rest.opening[0]
    x, y = tips @ plane, opening * axis
    return AxisMap(np.stack([x, y, np.cross(x, y)]), (0, 1), np.array([opening]))


def _width(part: np.ndarray, ahead: np.ndarray) -> float:
    """Width of the outer half of one blade [n, 2] on the side ``ahead`` [2] of the pivot."""
    along = part @ ahead
    outer = part[along > 0.5 * along.max()]
    if len(outer) == 0:
        return 0.0
    middle = (outer.min(0) + outer.max(0)) / 2
    return float(np.ptp(outer @ np.array([middle[1], -middle[0]])) / np.linalg.norm(middle))


def _about_y(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
