"""URDF files with their meshes: links, visual geometry, joints, and the poses of links.

Any URDF is read, and the folders of PartNet-Mobility: mobility.urdf, and optionally semantics.txt
(lines ``link joint name``), mobility_v2.json (a list of {id, name, ...} per link) and meta.json
(model_cat) beside it, whose names of links are kept as labels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from caper_jax.articulation.kinematics import joint_transform_float64
from caper_jax.data.images import read_json
from caper_jax.data.urdf.xml import UrdfJoint, parse_urdf, read_joints, read_shapes
from caper_jax.errors import CaperError
from caper_jax.geometry.meshes import Mesh, join

PARTNET_URDF = "mobility.urdf"  # the name of the file in PartNet-Mobility


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

    def link_poses(self, states: Mapping[str, float]) -> dict[str, Float[np.ndarray, "4 4"]]:
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
                motion = np.eye(4)
                if joint.kind != "fixed":
                    motion = joint_transform_float64(joint.kind, joint.axis, np.zeros(3), state)
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


def read_urdf(path: str | Path) -> UrdfModel:
    """Reads a URDF and every mesh it shows (visual geometry; collision geometry where a file has
    no visual one).

    Raises:
      CaperError: no such file, no URDF, no tree of links, a mesh that is missing or unreadable, or
        a malformed PartNet-Mobility file.
    """
    path = Path(path)
    robot = parse_urdf(path)
    if robot.tag != "robot":
        raise CaperError(f"{path}: no URDF: its outermost element is <{robot.tag}>, not <robot>")
    names = [link.get("name", "") for link in robot.iterfind("link")]
    if not names:
        raise CaperError(f"{path}: no URDF, it describes no link")
    if len(set(names)) != len(names):
        raise CaperError(f"{path}: two links share one name")
    joints = tuple(_usable(path, joint) for joint in read_joints(robot, path))
    root = _root(path, names, joints)
    source = "visual" if robot.find("link/visual") is not None else "collision"
    links: dict[str, Mesh | None] = {}
    for link in robot.iterfind("link"):
        meshes = [mesh for _, mesh in read_shapes(link, source, path) if len(mesh.faces)]
        links[link.get("name", "")] = join(meshes) if meshes else None
    if all(mesh is None for mesh in links.values()):
        raise CaperError(f"{path}: no link has a geometry")
    partnet = path.name == PARTNET_URDF
    return UrdfModel(
        name=path.parent.name if partnet else path.stem,
        path=path,
        links=links,
        joints=joints,
        root=root,
        labels=_partnet_labels(path.parent) if partnet else {},
        object_class=_partnet_class(path.parent) if partnet else "",
    )


def _usable(path: Path, joint: UrdfJoint) -> UrdfJoint:
    """A joint with its limits checked; fixed where its range is empty."""
    low, high = joint.limits
    if not low <= high:
        raise CaperError(f"{path}, joint {joint.name!r}: its limits {joint.limits} are no range")
    if high - low < 1e-6:
        return replace(joint, kind="fixed", remark="empty range", mimic=None)
    return joint if joint.mimic is None else replace(joint, remark=f"mimics {joint.mimic[0]}")


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


def find_models(path: str | Path) -> list[Path]:
    """The URDF files meant by a path, sorted.

    Args:
      path: a URDF file, a folder with one (PartNet-Mobility's mobility.urdf goes before others),
        or a folder of such folders.

    Raises:
      CaperError: nothing there, no URDF, or several in one folder.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise CaperError(f"{path}: no such file or folder")
    own = _urdf_of(path)
    if own is not None:
        return [own]
    found = [_urdf_of(folder) for folder in sorted(path.iterdir()) if folder.is_dir()]
    models = [urdf for urdf in found if urdf is not None]
    if not models:
        raise CaperError(f"{path}: holds no .urdf file, and no folder in it does")
    return models


def _urdf_of(folder: Path) -> Path | None:
    """The one URDF of a folder, None when it has none."""
    if (folder / PARTNET_URDF).is_file():
        return folder / PARTNET_URDF
    files = sorted(folder.glob("*.urdf"))
    if len(files) > 1:
        names = ", ".join(file.name for file in files[:6])
        raise CaperError(f"{folder}: holds {len(files)} URDF files ({names}); name one of them")
    return files[0] if files else None


def _partnet_labels(folder: Path) -> dict[str, str]:
    """What PartNet-Mobility calls its links, from semantics.txt or else mobility_v2.json."""
    semantics, mobility = folder / "semantics.txt", folder / "mobility_v2.json"
    if semantics.is_file():
        rows = [line.split() for line in semantics.read_text(encoding="utf-8").splitlines()]
        return {row[0]: row[2] for row in rows if len(row) >= 3}
    if not mobility.is_file():
        return {}
    content = read_json(mobility)
    nodes = content if isinstance(content, list) else []
    return {
        f"link_{node['id']}": str(node["name"])
        for node in nodes
        if isinstance(node, dict) and "id" in node and "name" in node
    }


def _partnet_class(folder: Path) -> str:
    """The object's class in meta.json, "" where it says none."""
    path = folder / "meta.json"
    content = read_json(path) if path.is_file() else {}
    return str(content.get("model_cat", "")) if isinstance(content, dict) else ""
