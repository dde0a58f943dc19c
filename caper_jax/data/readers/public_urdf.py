"""Joints in the URDF files of the public layouts, as written there (no meshes, own conventions)."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from caper_jax.errors import CaperError

ALIGNED, RAW = "mobility_for_unity_align.urdf", "mobility_for_unity.urdf"
# x, y, z of origins and axes are the third, first and second coordinate of the points.
POINT_ORDER = [1, 2, 0]


@dataclass(frozen=True)
class UrdfJoint:
    """A joint that moves.

    Attributes:
      child: number of the link that it moves.
      parent: name of the link it is mounted on.
      kind: "revolute" or "prismatic" (or whatever else the file says).
      origin: [3] as written.
      axis: [3] as written, not zero.
      limits: (low, high) radians or meters; None where the file has none.
    """

    child: int
    parent: str
    kind: str
    origin: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float] | None


def moving_joints(path: Path, child_of: Callable[[str], int | None]) -> list[UrdfJoint]:
    """The joints of a file that move, in the order of their children.

    Args:
      path: the file.
      child_of: the link that a joint of this name moves; None for a name that tells none.

    Raises:
      CaperError: missing or broken file, or a joint that lacks a name, axis or parent.
    """
    joints: dict[int, UrdfJoint] = {}
    for element in parse(path).iter("joint"):
        name, kind = element.get("name", ""), element.get("type", "")
        where = f"{path}, joint {name!r}"
        if kind in ("fixed", "0"):
            continue
        child = child_of(name)
        if child is None:
            raise CaperError(f"{where}: the name must tell which link it moves")
        if child in joints:
            raise CaperError(f"{where}: a second joint moves link {child}")
        axis = vector(attribute(element, "axis", "xyz", where), f"{where}, axis")
        if not axis.any():
            raise CaperError(f"{where}: axis must not be zero")
        joints[child] = UrdfJoint(
            child=child,
            parent=attribute(element, "parent", "link", where),
            kind="revolute" if kind == "continuous" else kind,
            origin=origin_of(element, "xyz", where),
            axis=axis,
            limits=limits_of(element, where),
        )
    return [joints[child] for child in sorted(joints)]


def base_joint(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Origin and roll, pitch, yaw (two [3], as written) of the joint that is numbered 0.

    Raises:
      CaperError: missing or broken file, or no such joint.
    """
    for element in parse(path).iter("joint"):
        name = element.get("name", "")
        if name.split("_")[1:2] == ["0"]:
            where = f"{path}, joint {name!r}"
            return origin_of(element, "xyz", where), origin_of(element, "rpy", where)
    raise CaperError(f"{path}: lacks the base joint (name <text>_0)")


def number_of(name: str) -> int | None:
    """The number at the end of a name such as "3", "link_3" or "joint_3"; None without one."""
    match = re.search(r"(\d+)$", name)
    return None if match is None else int(match[1])


def parse(path: Path) -> ElementTree.Element:
    """The outermost element of a file.

    Raises:
      CaperError: missing file or broken XML.
    """
    if not path.is_file():
        raise CaperError(f"{path}: no such file")
    try:
        return ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise CaperError(f"{path}: broken XML ({error})") from error


def attribute(element: ElementTree.Element, tag: str, name: str, where: str) -> str:
    """An attribute of a child element; CaperError without it."""
    child = element.find(tag)
    if child is None or child.get(name) is None:
        raise CaperError(f"{where}: lacks <{tag} {name}=...>")
    return str(child.get(name))


def origin_of(element: ElementTree.Element, name: str, where: str) -> np.ndarray:
    """[3] of an <origin>, which is zero where it is left out."""
    origin = element.find("origin")
    text = "0 0 0" if origin is None else origin.get(name, "0 0 0")
    return vector(text, f"{where}, origin {name}")


def vector(text: str, where: str) -> np.ndarray:
    """[3] finite numbers from text; CaperError for anything else."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise CaperError(f"{where}: expected three numbers, got {text!r}") from error
    if values.shape != (3,) or not np.isfinite(values).all():
        raise CaperError(f"{where}: expected three numbers, got {text!r}")
    return values


def limits_of(element: ElementTree.Element, where: str) -> tuple[float, float] | None:
    """(low, high) of a joint's <limit>; None where the file has none."""
    limit = element.find("limit")
    if limit is None or limit.get("lower") is None or limit.get("upper") is None:
        return None
    low, high, _ = vector(f"{limit.get('lower')} {limit.get('upper')} 0", f"{where}, limit")
    return float(low), float(high)
