"""Joints in the URDF files of the public layouts, as written there (own conventions)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from caper_jax.data.readers.annotations import finite_array
from caper_jax.errors import CaperError

ALIGNED, RAW = "mobility_for_unity_align.urdf", "mobility_for_unity.urdf"
# x, y, z of origins and axes in these files are the third, first and second coordinate of the
# points.
POINT_ORDER = [1, 2, 0]


@dataclass(frozen=True)
class UrdfJoint:
    """A joint.

    Attributes:
      name: as written.
      kind: "revolute" (also of continuous joints), "prismatic", or else what the file says.
      parent, child: names of links; "" where the file has none.
      xyz, rpy: [3] of the origin: meters; roll, pitch, yaw in radians.
      axis: [3] unit vector, child's frame.
      limits: (low, high) radians or meters, infinite where the file has none.
    """

    name: str
    kind: str
    parent: str
    child: str
    xyz: np.ndarray
    rpy: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float]


def read_joints(robot: ElementTree.Element, path: Path) -> list[UrdfJoint]:
    """The joints of a URDF, in the order of the file.

    Args:
      robot: see ``parse_urdf``.
      path: the file, for errors.

    Raises:
      CaperError: words where numbers belong, or a moving joint without parent or axis; names the
        joint and what is wrong.
    """
    joints = []
    for element in robot.iter("joint"):
        name, kind = element.get("name", ""), element.get("type", "")
        where, fixed = f"{path}, joint {name!r}", kind in ("fixed", "0")
        parent = _attribute(element, "parent", "link")
        if not fixed and not parent:
            raise CaperError(f"{where}: lacks <parent link=...>")
        axis = vector(
            _attribute(element, "axis", "xyz", "1 0 0" if fixed else ""), f"{where}, axis"
        )
        if not axis.any():
            raise CaperError(f"{where}, axis: must not be zero")
        low, high = (_attribute(element, "limit", end) for end in ("lower", "upper"))
        limits = np.array([-np.inf, np.inf])
        if low and high and kind != "continuous":
            limits = vector(f"{low} {high} 0", f"{where}, limit")[:2]
        joints.append(
            UrdfJoint(
                name=name,
                kind="revolute" if kind == "continuous" else "fixed" if fixed else kind,
                parent=parent,
                child=_attribute(element, "child", "link"),
                xyz=vector(_attribute(element, "origin", "xyz", "0 0 0"), f"{where}, origin xyz"),
                rpy=vector(_attribute(element, "origin", "rpy", "0 0 0"), f"{where}, origin rpy"),
                axis=axis / np.linalg.norm(axis),
                limits=(float(limits[0]), float(limits[1])),
            )
        )
    return joints


def moving_joints(path: Path, pattern: str) -> list[UrdfJoint]:
    """The joints of a URDF that move, joint j the one of link j + 1.

    Args:
      path: the file.
      pattern: finds the number of the link that a joint moves, its first group, in its name.

    Raises:
      CaperError: see ``read_joints``; or names that do not number the links from 1.
    """
    numbered = {}
    for joint in read_joints(parse_urdf(path), path):
        number = re.search(pattern, joint.name)
        if joint.kind == "fixed":
            continue
        if number is None or int(number[1]) in numbered:
            raise CaperError(
                f"{path}, joint {joint.name!r}: the name must tell which link it moves, and no "
                "other joint's the same"
            )
        numbered[int(number[1])] = joint
    if sorted(numbered) != list(range(1, len(numbered) + 1)):
        raise CaperError(f"{path}: joints move links {sorted(numbered)}, expected 1, 2, ...")
    return [numbered[number] for number in sorted(numbered)]


def number_of(name: str) -> int | None:
    """The number at the end of a name such as "3", "link_3" or "joint_3"; None without one."""
    match = re.search(r"(\d+)$", name)
    return None if match is None else int(match[1])


def pose_of_origin(element: ElementTree.Element, where: str) -> np.ndarray:
    """[4, 4] of an element's <origin>; what it leaves out is zero."""
    xyz, rpy = (
        vector(_attribute(element, "origin", key, "0 0 0"), f"{where}, origin {key}")
        for key in ("xyz", "rpy")
    )
    return pose_of(xyz, rpy)


def pose_of(xyz: np.ndarray, rpy: np.ndarray) -> np.ndarray:
    """[4, 4]: turns about the fixed axes x, y and z, one after the other, then a shift."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return pose


def vector(text: str, where: str) -> np.ndarray:
    """[3] finite numbers from text; CaperError for anything else."""
    try:
        return finite_array(text.split(), (3,))
    except ValueError as error:
        raise CaperError(f"{where}: {error}, got {text!r}") from error


def parse_urdf(path: Path) -> ElementTree.Element:
    """The outermost element of a file; CaperError for a missing file or broken XML."""
    if not path.is_file():
        raise CaperError(f"{path}: no such file")
    try:
        return ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise CaperError(f"{path}: broken XML ({error})") from error


def _attribute(element: ElementTree.Element, tag: str, name: str, default: str = "") -> str:
    child = element.find(tag)
    return default if child is None else child.get(name, default)
