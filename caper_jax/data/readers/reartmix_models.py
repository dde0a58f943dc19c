"""The 3-D models of ReArtMix (urdf_metas.json), brought to our rest pose and frame.

The files store boxes of parts in one frame at one pose; z is up and the flat face of things that
lie. What that pose is follows for each category from the boxes, axes and pivots (millimeters and
degrees below are those of the 43 public models); only boxes could be checked against annotated
images:

- box: the lid lies flat open, 180 deg from closed; the hinge is along y, the lid towards -x.
- stapler: the hinge is along x at the back (-y) of the base, the arm leans back over it. A box
  about a leaning arm does not tell its angle. Here the closed arm's tip, in the file the corner of
  its box farthest from the hinge, lies a third of the hinge's height below the hinge: the arms
  then are open by 151-161 deg, 110-142 mm long and 23-30 high, and end 1-8 mm behind the base's
  front. Other plausible rules differ by up to 5 deg, and so do rest pose and states.
  Closed, an arm is taken to be a bar along the base; its size is that of the bar whose leaning
  box is the one in the file.
- cutter: the blade is fully out, towards -y. Retracted, its tip is flush with the body's end.
- scissors: the blades cross at 90 deg, along y and x. A handle's loop lies on the outer side of
  its blade's line, which settles the way they close (the second turns by +z towards the first)
  but not which ends are the tips: a half turn about the pivot gives the same boxes. They are taken
  to be those at +y and +x, nearer the pivot or as near in all models but one (by 2 mm): the
  handles of paper scissors reach at least as far as their blades. The boxes are turned by 10 deg
  to our rest pose and enclose the parts more loosely there. The first link is the root.

Models of drawers have a body and one drawer, and do not fit our category of three.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.kinematics import joint_transform
from caper_jax.errors import CaperError, unknown_name


@dataclass(frozen=True)
class Stored:
    """One object as the files store it, in their frame and at their scale.

    Attributes:
      low, high: [K, 3] boxes of the parts.
      axis: [J, 3] unit joint axes, positive opens.
      pivot: [J, 3] points on them.
    """

    low: np.ndarray
    high: np.ndarray
    axis: np.ndarray
    pivot: np.ndarray


@dataclass(frozen=True)
class Conversion:
    """From a category's frames in the files to ours.

    Attributes:
      category_id: number in the annotations.
      file_names: names in urdf_metas.json.
      axes: [3, 3] rotation, file frame -> our canonical frame.
      opening: [3] about or along which the joint opens, in the file's frame, to within 45 deg.
      stored_state: our state (radians, meters) of an object as the file stores it.
      square_at_rest: the parts are square to the axes at rest, not as the file stores them.
    """

    category_id: int
    file_names: tuple[str, ...]
    axes: np.ndarray
    opening: tuple[float, float, float]
    stored_state: Callable[[Stored], float]
    square_at_rest: bool = False


@dataclass(frozen=True)
class Model:
    """One object in our rest pose and frame, at the scale of the files.

    Attributes:
      to_file_rotation: [K, 3, 3], our rest frame -> the parts' file frames.
      to_file_shift: [K, 3], likewise.
      size, center: [K, 3] boxes of the parts.
      file_axis: [J, 3] joint axes, in the file's frame.
      axis: [J, 3] joint axes in ours, positive opens.
      pivot: [J, 3] points on them, in ours.
    """

    to_file_rotation: np.ndarray
    to_file_shift: np.ndarray
    size: np.ndarray
    center: np.ndarray
    file_axis: np.ndarray
    axis: np.ndarray
    pivot: np.ndarray


def _leaning(stored: Stored) -> float:
    """Angle by which a stapler is open, see above."""
    hinge, lowest = stored.pivot[0], stored.low[0, 2]
    ends = np.array([stored.low[1], stored.high[1]]) - hinge
    farthest = np.abs(ends).argmax(0)
    along, above = ends[farthest[1], 1], ends[farthest[2], 2]
    reach = np.hypot(along, above)
    drop = min((hinge[2] - lowest) / 3, reach)
    return float(np.arctan2(above, along) + np.arcsin(drop / reach))


def _extension(stored: Stored) -> float:
    """Way of a cutter's tip beyond the end of the body, along the joint's axis."""
    return float((stored.low[1, 1] - stored.low[0, 1]) / stored.axis[0, 1])


def _scissors_axes() -> np.ndarray:
    """x half way between the tips at rest (80 and 100 deg from the file's x), y down in it."""
    cos, sin = np.cos(np.radians(80)), np.sin(np.radians(80))
    return np.array([[cos, sin, 0.0], [0.0, 0.0, -1.0], [-sin, cos, 0.0]])


# joint_xyz and joint_rpy name the axes in another order than corner_pts and transformation.
_JOINT_ORDER = [1, 2, 0]
CONVERSIONS = {
    "box": Conversion(1, ("box",), np.eye(3)[[1, 2, 0]], (0.0, -1.0, 0.0), lambda _: np.pi),
    "stapler": Conversion(
        2,
        ("stapler",),
        np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
        (1.0, 0.0, 0.0),
        _leaning,
        square_at_rest=True,
    ),
    "cutter": Conversion(
        3,
        ("cutter",),
        np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]),
        (0.0, -1.0, 0.0),
        _extension,
    ),
    "scissors": Conversion(
        5,
        ("scissor", "scissors"),
        _scissors_axes(),
        (0.0, 0.0, -1.0),
        lambda _: np.radians(90 - 20),
    ),
}


def conversion_of(category: str, layout: str) -> Conversion:
    """The conversion of one of our categories.

    Raises:
      CaperError: a category that the data set does not have, or whose objects differ from ours.
    """
    if category == "drawer":
        raise CaperError(
            f"{layout} has drawers with one drawer each (2 parts), but our category 'drawer' has "
            f"three (4 parts); categories that fit: {', '.join(sorted(CONVERSIONS))}"
        )
    if category not in CONVERSIONS:
        raise unknown_name(f"{layout} category", category, CONVERSIONS)
    return CONVERSIONS[category]


def read_model(
    meta: dict[str, Any], category: Category, conversion: Conversion, where: str
) -> Model:
    """Brings one model to its rest pose, and boxes and joints to our frame.

    Args:
      meta: its entry in urdf_metas.json.
      category: gives the parts, their tree and the types of joints.
      conversion: of that category.
      where: file and model, for errors.

    Raises:
      CaperError: a model that does not fit the category, or boxes and axes unlike those that the
        conversion was found for.
    """
    stored = _read_stored(meta, category, conversion, where)
    state = -conversion.stored_state(stored)
    rest = _at_rest(category, stored.axis, stored.pivot, state)
    # Measured axes are off by up to 6 deg; what is built square turns about the ideal one.
    ideal = _at_rest(category, np.tile(conversion.opening, (category.num_joints, 1)), None, state)

    size, center = [], []
    for pose, square, low, high in zip(rest, ideal, stored.low, stored.high, strict=True):
        if conversion.square_at_rest:
            # The box that, as the file stores it, has the bounds in the file.
            bounds_of = np.abs(conversion.axes @ square[:3, :3]).T
            size.append(np.linalg.solve(bounds_of, high - low))
        else:
            size.append(np.abs(conversion.axes @ pose[:3, :3]) @ (high - low))
        center.append(conversion.axes @ (pose[:3, :3] @ (low + high) / 2 + pose[:3, 3]))
    if np.min(size) <= 0:
        raise CaperError(f"{where}: no closed {category.name} has the boxes {meta['corner_pts']}")
    sizes, centers = np.array(size), np.array(center)
    origin = ((centers - sizes / 2).min(0) + (centers + sizes / 2).max(0)) / 2

    # p_file = R_rest^T (A^T (p_ours + origin) - t_rest)
    turns = [pose[:3, :3].T for pose in rest]
    shifts = [conversion.axes.T @ origin - pose[:3, 3] for pose in rest]
    return Model(
        to_file_rotation=np.stack([turn @ conversion.axes.T for turn in turns]),
        to_file_shift=np.stack([turn @ shift for turn, shift in zip(turns, shifts, strict=True)]),
        size=sizes,
        center=centers - origin,
        file_axis=stored.axis,
        axis=stored.axis @ conversion.axes.T,
        pivot=stored.pivot @ conversion.axes.T - origin,
    )


def _at_rest(category: Category, axis: np.ndarray, pivot: np.ndarray | None, state: float):
    """K poses [4, 4] of the parts when all joints, as stored, move by ``state``."""
    poses = [np.eye(4)]
    with jax.enable_x64(True):
        for j, joint in enumerate(category.joints):
            point = np.zeros(3) if pivot is None else pivot[j]
            motion = joint_transform(joint.type, axis[j], point, state)
            poses.append(poses[joint.parent] @ np.asarray(motion))
    return poses


def _read_stored(
    meta: dict[str, Any], category: Category, conversion: Conversion, where: str
) -> Stored:
    """Boxes and joints of one model, checked against the category."""
    parts = category.num_parts
    corners = np.asarray(meta["corner_pts"], np.float64).reshape(-1, 2, 3)[1:]
    axis = np.asarray(meta["joint_rpy"], np.float64)[:, _JOINT_ORDER]
    pivot = np.asarray(meta["joint_xyz"], np.float64)[:, _JOINT_ORDER]
    ends = zip(meta["joint_parents"], meta["joint_children"], strict=True)
    tree = [(parent - 1, child - 1) for parent, child in ends]
    expected = [(joint.parent, j + 1) for j, joint in enumerate(category.joints)]
    types = tuple(meta["joint_types"])
    if len(corners) != parts or tree != expected or types != category.joint_types:
        raise CaperError(
            f"{where}: {len(corners)} parts with {types} joints {tree}, but {category.name} has "
            f"{parts} parts with {category.joint_types} joints {expected}"
        )
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    # Which way an axis points is the files' own matter: states come from poses.
    share = axis @ np.array(conversion.opening)
    if not (np.abs(share) > np.sqrt(0.5)).all():
        raise CaperError(f"{where}: joint axis {axis[0]} lies across the one of other models")
    axis = axis * np.sign(share)[:, None]
    return Stored(corners.min(1), corners.max(1), axis, pivot)
