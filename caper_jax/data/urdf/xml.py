"""The XML of URDF files as it is written: joints, shapes of links, poses and vectors."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from caper_jax.arrays import finite_array
from caper_jax.errors import CaperError
from caper_jax.geometry.meshes import Mesh, primitive_mesh, read_mesh

Kind = Literal["revolute", "prismatic", "fixed"]
_KINDS: dict[str, Kind] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}


@dataclass(frozen=True)
class UrdfJoint:
    """A joint as the file gives it.

    Attributes:
      name: as in the file.
      kind: "revolute" (also for continuous joints), "prismatic", or "fixed" (also for all others).
      parent, child: names of links; "" where the file has none.
      origin: [4, 4] joint frame -> parent link's frame at state 0; meters.
      axis: [3] unit vector, joint frame.
      limits: (low, high) radians or meters; infinite where the file gives none.
      remark: why a joint that moves in the file has no state of its own, or "".
      mimic: (name of the joint it follows, multiplier, offset), or None.
    """

    name: str
    kind: Kind
    parent: str
    child: str
    origin: Float[np.ndarray, "4 4"]
    axis: Float[np.ndarray, " 3"]
    limits: tuple[float, float]
    remark: str = ""
    mimic: tuple[str, float, float] | None = None

    @property
    def moves(self) -> bool:
        """Whether it has a state of its own."""
        return self.kind != "fixed" and self.mimic is None


def parse_urdf(path: Path) -> ElementTree.Element:
    """The outermost element of a file; CaperError for a missing file or broken XML."""
    if not path.is_file():
        raise CaperError(f"{path}: no such file")
    try:
        return ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError, ValueError) as error:
        raise CaperError(f"{path}: broken XML ({error})") from error


def read_joints(robot: ElementTree.Element, path: Path) -> list[UrdfJoint]:
    """The joints of a URDF, in the order of the file.

    Args:
      robot: see ``parse_urdf``.
      path: the file, for errors.

    Raises:
      CaperError: words where numbers belong, or a moving joint without parent, or with no axis;
        names the joint and what is wrong.
    """
    joints = []
    for element in robot.iterfind("joint"):
        name, written = element.get("name", ""), element.get("type", "")
        where = f"{path}, joint {name!r}"
        kind = _KINDS.get(written, "fixed")
        parent, child = (attribute(element, end, "link") for end in ("parent", "child"))
        axis, limits, mimic = np.array([1.0, 0.0, 0.0]), (-np.inf, np.inf), None
        if kind != "fixed":
            if not parent:
                raise CaperError(f"{where}: lacks <parent link=...>")
            axis = vector(attribute(element, "axis", "xyz", "1 0 0"), f"{where}, axis")
            if np.linalg.norm(axis) < 1e-6:
                raise CaperError(f"{where}, axis: {axis.tolist()} is no direction")
            axis = axis / np.linalg.norm(axis)
            followed = element.find("mimic")
            if followed is not None:
                mimic = (
                    followed.get("joint", ""),
                    _number(followed.get("multiplier", "1"), f"{where}, mimic multiplier"),
                    _number(followed.get("offset", "0"), f"{where}, mimic offset"),
                )
        if kind != "fixed" and written != "continuous":
            low, high = attribute(element, "limit", "lower"), attribute(element, "limit", "upper")
            limits = (
                _number(low, f"{where}, lower limit") if low else -np.inf,
                _number(high, f"{where}, upper limit") if high else np.inf,
            )
        remark = "" if kind != "fixed" or written == "fixed" else f"{written} joint"
        origin = origin_of(element, where)
        joints.append(UrdfJoint(name, kind, parent, child, origin, axis, limits, remark, mimic))
    return joints


def read_shapes(
    link: ElementTree.Element, tag: str, path: Path
) -> list[tuple[Float[np.ndarray, "4 4"], Mesh]]:
    """What a link shows: the pose of every shape in the link, and its mesh in the link's frame.

    Args:
      link: a <link>.
      tag: "visual" or "collision".
      path: the file, for errors and for the places of meshes.

    Raises:
      CaperError: a mesh that is missing or cannot be read, another shape than a URDF has, or words
        where numbers belong.
    """
    where = f"{path}, link {link.get('name', '')!r}"
    shapes = []
    for element in link.iterfind(tag):
        form = element.find("geometry/*")
        if form is None:
            continue
        if form.tag == "mesh":
            mesh = read_mesh(_find_mesh(path, form.get("filename", ""), where))
            mesh = mesh.scaled(vector(form.get("scale", "1 1 1"), f"{where}, scale"))
        else:
            keys = {"cylinder": ("radius", "length"), "sphere": ("radius",)}.get(form.tag, ())
            numbers = [_number(form.get(key, ""), f"{where}, {key}") for key in keys]
            if form.tag == "box":
                numbers = vector(form.get("size", ""), f"{where}, size").tolist()
            mesh = primitive_mesh(form.tag, numbers, where)
        pose = origin_of(element, where)
        shapes.append((pose, mesh.moved(pose)))
    return shapes


def _find_mesh(urdf: Path, filename: str, where: str) -> Path:
    """The file behind a mesh's name.

    ``package://NAME/REST`` is looked for in the folders above the URDF and in ROS_PACKAGE_PATH,
    with and without NAME: a copied robot often keeps only the inside of its package.
    """
    text = filename.replace("\\", "/")
    scheme, found, rest = text.partition("://")
    above = urdf.resolve().parents
    if not found:
        candidates = [above[0] / text, *(folder / text for folder in above[1:3])]
    elif scheme == "file":
        candidates = [Path(rest)]
    elif scheme in ("package", "model"):
        inside = rest.partition("/")[2]
        listed = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
        folders = [*above, *(Path(folder) for folder in listed if folder)]
        candidates = [folder / rest for folder in folders]
        candidates += [folder / inside for folder in folders if inside]
    else:
        raise CaperError(f"{where}: mesh {filename!r}: only files and package:// are read")
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    looked = "the folders above it and in ROS_PACKAGE_PATH" if found else str(above[0])
    raise CaperError(f"{where}: mesh {filename!r} is not there (looked in {looked})")


def number_of(name: str) -> int | None:
    """The number at the end of a name such as "3", "link_3" or "joint_3"; None without one."""
    match = re.search(r"(\d+)$", name)
    return None if match is None else int(match[1])


def origin_of(element: ElementTree.Element, where: str) -> Float[np.ndarray, "4 4"]:
    """The pose of an element's <origin>: turns about the fixed x, y and z, then a shift."""
    pose = np.eye(4)
    rpy = vector(attribute(element, "origin", "rpy", "0 0 0"), f"{where}, origin rpy")
    pose[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    pose[:3, 3] = vector(attribute(element, "origin", "xyz", "0 0 0"), f"{where}, origin xyz")
    return pose


def attribute(element: ElementTree.Element, tag: str, name: str, default: str = "") -> str:
    """An attribute of a child element; the default where either is missing."""
    child = element.find(tag)
    return default if child is None else child.get(name, default)


def vector(text: str, where: str) -> Float[np.ndarray, " 3"]:
    """Three finite numbers from text; CaperError for anything else."""
    try:
        return finite_array(text.split(), (3,))
    except ValueError as error:
        raise CaperError(f"{where} {error}, got {text!r}") from error


def _number(text: str, where: str) -> float:
    try:
        return float(finite_array(text, ()))
    except ValueError:
        raise CaperError(f"{where} must be a finite number, got {text!r}") from None
