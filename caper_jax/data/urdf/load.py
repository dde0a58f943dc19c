"""URDF files with their meshes: links, visual geometry, joints, and the poses of links.

Any URDF is read, and the folders of PartNet-Mobility (mobility.urdf with mobility_v2.json,
semantics.txt and meta.json beside it), whose names of links are kept as labels.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from caper_jax.data.urdf.folders import PARTNET_URDF, partnet_class, partnet_labels
from caper_jax.data.urdf.meshes import Mesh, join, read_mesh, shape_mesh
from caper_jax.errors import CaperError

Kind = Literal["revolute", "prismatic", "fixed"]
KINDS: dict[str, Kind] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}


@dataclass(frozen=True)
class UrdfJoint:
    """A joint as the file gives it.

    Attributes:
      name: as in the file.
      kind: "revolute" (also for continuous joints), "prismatic", or "fixed" (also for floating
        and planar joints, and empty ranges).
      parent, child: names of links.
      origin: [4, 4] joint frame -> parent link's frame at state 0.
      axis: [3] unit vector, joint frame.
      limits: (low, high) radians or meters; infinite where the file gives none.
      remark: why a joint that moves in the file has no state of its own, or "".
      mimic: (name of the joint it follows, multiplier, offset), or None.
    """

    name: str
    kind: Kind
    parent: str
    child: str
    origin: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float]
    remark: str = ""
    mimic: tuple[str, float, float] | None = None

    @property
    def moves(self) -> bool:
        """Whether it has a state of its own."""
        return self.kind != "fixed" and self.mimic is None


@dataclass(frozen=True)
class UrdfModel:
    """One articulated object as the file gives it; meters.

    Attributes:
      name: of the object: its folder or file.
      path: the URDF file.
      links: name -> geometry in the link's frame, None where the link has none.
      joints: in the order of the file.
      root: the link that is no joint's child.
      labels: name of a link -> what PartNet-Mobility calls it, e.g. "screen".
      object_class: PartNet-Mobility's class of the object, e.g. "Laptop", or "".
    """

    name: str
    path: Path
    links: dict[str, Mesh | None]
    joints: tuple[UrdfJoint, ...]
    root: str
    labels: dict[str, str] = field(default_factory=dict)
    object_class: str = ""

    def link_poses(self, states: Mapping[str, float]) -> dict[str, np.ndarray]:
        """Poses [4, 4] of all links in the root link's frame; joints left out stand at 0."""
        outgoing: dict[str, list[UrdfJoint]] = {}
        for joint in self.joints:
            outgoing.setdefault(joint.parent, []).append(joint)
        poses = {self.root: np.eye(4)}
        open_links = [self.root]
        while open_links:
            link = open_links.pop()
            for joint in outgoing.get(link, ()):
                state = states.get(joint.name, 0.0)
                if joint.mimic is not None:
                    state = _followed(joint.mimic, states)
                motion = joint_motion(joint.kind, joint.axis, np.zeros(3), state)
                poses[joint.child] = poses[link] @ joint.origin @ motion
                open_links.append(joint.child)
        return poses

    def following(self, states: Mapping[str, float]) -> UrdfModel:
        """With every mimicking joint held where it stands at these states of the others."""
        joints = tuple(
            joint
            if joint.mimic is None
            else replace(joint, mimic=(joint.mimic[0], 0.0, _followed(joint.mimic, states)))
            for joint in self.joints
        )
        return replace(self, joints=joints)


def _followed(mimic: tuple[str, float, float], states: Mapping[str, float]) -> float:
    """State of a mimicking joint at those of the others; joints left out stand at 0."""
    name, multiplier, offset = mimic
    return multiplier * states.get(name, 0.0) + offset


def joint_motion(kind: str, axis: np.ndarray, pivot: np.ndarray, state: float) -> np.ndarray:
    """Float64 twin of ``articulation.kinematics.joint_transform``: a turn or slide [4, 4]."""
    motion = np.eye(4)
    if kind == "prismatic":
        motion[:3, 3] = state * axis
    elif kind == "revolute":
        x, y, z = axis
        hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        motion[:3, :3] += np.sin(state) * hat + 2 * np.sin(state / 2) ** 2 * hat @ hat
        motion[:3, 3] = pivot - motion[:3, :3] @ pivot
    return motion


def read_urdf(path: str | Path) -> UrdfModel:
    """Reads a URDF and every mesh it shows (visual geometry; collision geometry where a file has
    no visual one).

    Raises:
      CaperError: no such file, no URDF, no tree of links, a mesh that is missing or unreadable,
        a malformed PartNet-Mobility file, or the packages for meshes are not installed.
    """
    path = Path(path)
    robot = _parse(path)
    names = [link.name for link in robot.links]
    if not names:
        raise CaperError(f"{path}: no URDF, it describes no link")
    if len(set(names)) != len(names):
        raise CaperError(f"{path}: two links share one name")
    joints = tuple(_joint(path, joint) for joint in robot.joints)
    root = _root(path, names, joints)
    source = "visuals" if any(link.visuals for link in robot.links) else "collisions"
    links = {link.name: _link_mesh(path, link, getattr(link, source)) for link in robot.links}
    if all(mesh is None for mesh in links.values()):
        raise CaperError(f"{path}: no link has a geometry")
    partnet = path.name == PARTNET_URDF
    return UrdfModel(
        name=path.parent.name if partnet else path.stem,
        path=path,
        links=links,
        joints=joints,
        root=root,
        labels=partnet_labels(path.parent) if partnet else {},
        object_class=partnet_class(path.parent) if partnet else "",
    )


def _parse(path: Path) -> Any:
    """The file as yourdfpy's Robot, without meshes."""
    try:
        from yourdfpy import URDF
        from yourdfpy.urdf import URDFError
    except ImportError:
        raise CaperError(
            "reading URDF files needs more packages: pip install 'caper-jax[mesh]'"
        ) from None
    from xml.etree import ElementTree

    if not path.is_file():
        raise CaperError(f"{path}: no such file")
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError, ValueError) as error:
        raise CaperError(f"{path}: not an XML file ({error})") from error
    if root.tag != "robot":
        raise CaperError(f"{path}: no URDF: its outermost element is <{root.tag}>, not <robot>")
    for child in list(root):
        # What simulators and controllers add is often incomplete, and nothing to us.
        if child.tag not in ("link", "joint"):
            root.remove(child)
    root.attrib.setdefault("name", path.stem)
    content = BytesIO(ElementTree.tostring(root))
    try:
        return URDF.load(content, build_scene_graph=False, load_meshes=False).robot
    except (URDFError, ValueError, TypeError, KeyError, AttributeError) as error:
        # Missing attributes come as a KeyError with nothing but their name.
        raise CaperError(f"{path}: malformed URDF ({error!r})") from error


def _joint(path: Path, joint: Any) -> UrdfJoint:
    where = f"{path}, joint {joint.name!r}"
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, np.float64)
    kind: Kind = KINDS.get(joint.type, "fixed")
    remark = "" if kind != "fixed" or joint.type == "fixed" else f"{joint.type} joint"
    axis = np.asarray([1, 0, 0] if joint.axis is None else joint.axis, np.float64)
    length = float(np.linalg.norm(axis))
    limits = (-np.inf, np.inf)
    if kind != "fixed":
        if not np.isfinite(length) or length < 1e-6:
            raise CaperError(f"{where}: its axis {axis.tolist()} is no direction")
        axis = axis / length
    if kind != "fixed" and joint.type != "continuous" and joint.limit is not None:
        low, high = joint.limit.lower, joint.limit.upper
        limits = (-np.inf if low is None else low, np.inf if high is None else high)
        if not limits[0] <= limits[1]:
            raise CaperError(f"{where}: its limits {limits} are no range")
        if limits[1] - limits[0] < 1e-6:
            kind, remark = "fixed", "empty range"
    mimic = None
    if kind != "fixed" and joint.mimic is not None:
        remark = f"mimics {joint.mimic.joint}"
        multiplier, offset = joint.mimic.multiplier, joint.mimic.offset
        mimic = (
            joint.mimic.joint,
            1.0 if multiplier is None else float(multiplier),
            0.0 if offset is None else float(offset),
        )
    if not (np.isfinite(origin).all() and origin.shape == (4, 4)):
        raise CaperError(f"{where}: its origin has numbers that are not finite")
    return UrdfJoint(
        joint.name, kind, joint.parent, joint.child, origin, axis, limits, remark, mimic
    )


def _root(path: Path, names: list[str], joints: tuple[UrdfJoint, ...]) -> str:
    """The one link without a parent; every other must hang on exactly one joint below it."""
    parent: dict[str, str] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in names:
                raise CaperError(f"{path}, joint {joint.name!r}: no link is called {link!r}")
        if joint.child in parent:
            raise CaperError(f"{path}: link {joint.child!r} is the child of two joints")
        parent[joint.child] = joint.parent
    roots = [name for name in names if name not in parent]
    if len(roots) != 1:
        raise CaperError(f"{path}: its links make no single tree ({len(roots)} links are roots)")
    for name in names:
        seen = {name}
        while name in parent:
            name = parent[name]
            if name in seen:
                raise CaperError(f"{path}: its joints make a loop through link {name!r}")
            seen.add(name)
    return roots[0]


def _link_mesh(path: Path, link: Any, shapes: list[Any]) -> Mesh | None:
    """All geometry of a link as one mesh in the link's frame."""
    meshes = []
    for shape in shapes:
        where = f"{path}, link {link.name!r}"
        geometry = shape.geometry
        if geometry is None:
            continue
        if geometry.mesh is not None:
            file = _resolve(path, geometry.mesh.filename, where)
            scale = geometry.mesh.scale
            mesh = read_mesh(file).scaled(1.0 if scale is None else np.asarray(scale, np.float64))
        else:
            mesh = shape_mesh(geometry, where)
        meshes.append(mesh if shape.origin is None else mesh.moved(np.asarray(shape.origin)))
    meshes = [mesh for mesh in meshes if len(mesh.faces)]
    return join(meshes) if meshes else None


def _resolve(urdf: Path, filename: str | None, where: str) -> Path:
    """The file behind a mesh's name.

    ``package://NAME/REST`` is looked for in the folders above the URDF and in ROS_PACKAGE_PATH,
    with and without NAME: a copied robot often keeps only the inside of its package.
    """
    text = (filename or "").replace("\\", "/")
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
