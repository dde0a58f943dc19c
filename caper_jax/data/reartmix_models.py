"""The 3-D models of ReArtMix (urdf_metas.json), brought to our rest pose and frame."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.joints import joint_transform
from caper_jax.errors import CaperError


@dataclass(frozen=True)
class Conversion:
    """From a category's frames in the files to ours.

    Attributes:
      category_id: number in the annotations.
      axes: [3, 3] rotation, file frame -> our canonical frame.
      rest_state: state in the files at which the object is in our rest pose.
      sign: +1 where our state grows with the file's, -1 where it falls.
    """

    category_id: int
    axes: np.ndarray
    rest_state: float
    sign: float


# joint_xyz and joint_rpy name the axes in another order than corner_pts and transformation.
_JOINT_ORDER = [1, 2, 0]
CONVERSIONS = {
    # z is up, y along the hinge; state 0 is the lid lying flat open, so the closed box is at pi.
    "box": Conversion(1, np.eye(3)[[1, 2, 0]], np.pi, -1.0),
}


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


def read_model(
    meta: dict[str, Any], category: Category, conversion: Conversion, where: str
) -> Model:
    """Brings one model to its rest pose, and boxes and joints to our frame."""
    parts = category.num_parts
    corners = np.asarray(meta["corner_pts"], np.float64).reshape(-1, 2, 3)[1:]
    file_axis = np.asarray(meta["joint_rpy"], np.float64)[:, _JOINT_ORDER]
    file_axis /= np.linalg.norm(file_axis, axis=-1, keepdims=True)
    file_pivot = np.asarray(meta["joint_xyz"], np.float64)[:, _JOINT_ORDER]
    ends = zip(meta["joint_parents"], meta["joint_children"], strict=True)
    tree = [(parent - 1, child - 1) for parent, child in ends]
    expected = [(joint.parent, j + 1) for j, joint in enumerate(category.joints)]
    types = tuple(meta["joint_types"])
    if len(corners) != parts or tree != expected or types != category.joint_types:
        raise CaperError(
            f"{where}: {len(corners)} parts with {types} joints {tree}, but {category.name} has "
            f"{parts} parts with {category.joint_types} joints {expected}"
        )

    # Pose at rest of part k's file frame; revolute joints turn by minus the state of the files.
    signs = np.array([-1.0 if kind == "revolute" else 1.0 for kind in types])
    rest = [np.eye(4)]
    with jax.enable_x64(True):
        for j, (parent, _) in enumerate(tree):
            state = signs[j] * conversion.rest_state
            motion = joint_transform(types[j], file_axis[j], file_pivot[j], state)
            rest.append(rest[parent] @ np.asarray(motion))

    low, high = [], []
    for pose, (first, second) in zip(rest, corners, strict=True):
        box = np.array(list(product(*zip(first, second, strict=True))))
        box = (box @ pose[:3, :3].T + pose[:3, 3]) @ conversion.axes.T
        low.append(box.min(0))
        high.append(box.max(0))
    origin = (np.min(low, axis=0) + np.max(high, axis=0)) / 2
    centers = (np.array(low) + np.array(high)) / 2 - origin

    # p_file = R_rest^T (A^T (p_ours + origin) - t_rest)
    turns = [pose[:3, :3].T for pose in rest]
    shifts = [conversion.axes.T @ origin - pose[:3, 3] for pose in rest]
    return Model(
        to_file_rotation=np.stack([turn @ conversion.axes.T for turn in turns]),
        to_file_shift=np.stack([turn @ shift for turn, shift in zip(turns, shifts, strict=True)]),
        size=np.array(high) - np.array(low),
        center=centers,
        file_axis=file_axis,
        axis=conversion.sign * signs[:, None] * (file_axis @ conversion.axes.T),
        pivot=file_pivot @ conversion.axes.T - origin,
    )
