"""The 3-D models of CAPTRA's SAPIEN data, brought to our rest pose and frame.

An object is a PartNet-Mobility URDF: links ``base``, ``link_0``, ``link_1``, ... whose meshes are
OBJ files, placed in their link by the origin of their <visual>. One link hangs on the base by a
fixed joint and is the root, the first or the last of them; the others hang on the root.

The files know no rest pose: states count from the pose that the object was modeled in. The rest
pose is found from the parts and the ranges of the joints as for any imported URDF
(data/urdf/rules.py), canonical axes as for ArtImage's objects (artimage_frames.py). That takes the
meshes to be upright, y up, as PartNet's are. Of a laptop's links the lower one is the base; of a
pair of scissors the root is the blade with the longer handle, and x halves the angle between the
tips.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.data.readers.artimage_frames import AxisMap, Rest, canonical_axes
from caper_jax.data.readers.artimage_models import RestModel, rest_model
from caper_jax.data.readers.public_urdf import (
    attribute,
    limits_of,
    number_of,
    origin_of,
    parse,
    vector,
)
from caper_jax.errors import CaperError
from caper_jax.geometry.meshes import Mesh, join

URDF = "mobility.urdf"


@dataclass(frozen=True)
class _Joint:
    """A joint as the file has it.

    Attributes:
      parent: number of the link it is mounted on; None for the base.
      kind: "revolute", "prismatic" or "fixed".
      origin: [4, 4] child link's frame -> parent link's frame at state 0.
      axis: [3] unit vector in the child's frame.
      limits: (low, high) radians or meters, infinite where the file has none.
    """

    parent: int | None
    kind: str
    origin: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float]


def read_model(folder: Path, category: Category) -> RestModel:
    """Reads one object and brings it to our rest pose and frame.

    Args:
      folder: the object's folder, which holds mobility.urdf and its meshes.
      category: gives the parts and the types of joints.

    Returns:
      The model; its file frames are those of the URDF's links.

    Raises:
      CaperError: missing or broken files, or an object that does not fit the category.
    """
    path = folder / URDF
    robot = parse(path)
    count = category.num_parts
    joints = _read_joints(robot, path, count)
    root = _root(joints, path, category)
    links = [root, *(link for link in range(count) if link != root)]
    visuals = [_read_visuals(robot, path, link) for link in links]

    # Everything in the frame of the root's mesh, which is upright, as the file holds it.
    upright = np.linalg.inv(visuals[0][0])
    poses = [upright, *(upright @ joints[link].origin for link in links[1:])]
    moving = [joints[link] for link in links[1:]]
    reference = MeshObject(
        parts=tuple(mesh.moved(pose) for (_, mesh), pose in zip(visuals, poses, strict=True)),
        kinds=tuple(joint.kind for joint in moving),
        parents=category.parents,
        axis=np.array([p[:3, :3] @ j.axis for j, p in zip(moving, poses[1:], strict=True)]),
        pivot=np.array([pose[:3, 3] for pose in poses[1:]]),
        limits=np.array([joint.limits for joint in moving]),
    )
    if _other_root(reference, category):
        reference, links, poses = reference.exchanged(), links[::-1], poses[::-1]

    states = category.urdf_rule.rest(reference)
    at_rest = reference.at(states)
    low, high = at_rest.limits.T
    rest = Rest(
        points=[mesh.vertices for mesh in at_rest.parts],
        axis=at_rest.axis,
        pivot=at_rest.pivot,
        opening=np.where(high >= -low, 1.0, -1.0),
    )
    if category.name == "scissors":
        reading = _scissors_reading(at_rest, category)
    else:
        reading = canonical_axes(rest, category, str(path))
    model = rest_model(rest, reference.poses(states) @ np.array(poses), reading)
    return replace(model, links=tuple(links[part] for part in reading.order))


def _other_root(reference: MeshObject, category: Category) -> bool:
    """Whether the second of two parts is our root."""
    if category.name == "laptop":
        heights = [mesh.bounds()[:, 1].mean() for mesh in reference.parts]
        return heights[1] < heights[0]
    root = category.urdf_rule.root
    return root is not None and root(reference) == 1


def _scissors_reading(at_rest: MeshObject, category: Category) -> AxisMap:
    """x between the tips, y so that the scissors open about it."""
    up, front, _ = category.urdf_rule.axes(at_rest)
    front = front - (front @ up) * up
    y, z = up / np.linalg.norm(up), front / np.linalg.norm(front)
    turn = np.stack([np.cross(y, z), y, z])
    return AxisMap(turn, (0, 1), np.sign(at_rest.axis @ y))


def _read_joints(robot: ElementTree.Element, path: Path, count: int) -> dict[int, _Joint]:
    """Number of the child link -> its joint."""
    joints: dict[int, _Joint] = {}
    for element in robot.iter("joint"):
        where = f"{path}, joint {element.get('name', '')!r}"
        child = number_of(attribute(element, "child", "link", where))
        if child is None or child >= count or child in joints:
            raise CaperError(
                f"{where}: its child must be another one of link_0 to link_{count - 1}, got "
                f"{attribute(element, 'child', 'link', where)!r}"
            )
        kind = {"continuous": "revolute"}.get(element.get("type", ""), element.get("type", ""))
        axis = np.array([1.0, 0.0, 0.0])
        if kind in ("revolute", "prismatic"):
            axis = vector(attribute(element, "axis", "xyz", where), f"{where}, axis")
            if not axis.any():
                raise CaperError(f"{where}: axis must not be zero")
            axis = axis / np.linalg.norm(axis)
        limits = None if element.get("type") == "continuous" else limits_of(element, where)
        joints[child] = _Joint(
            parent=number_of(attribute(element, "parent", "link", where)),
            kind=kind,
            origin=_pose(element, where),
            axis=axis,
            limits=limits or (-np.inf, np.inf),
        )
    return joints


def _root(joints: dict[int, _Joint], path: Path, category: Category) -> int:
    """The link that all others hang on; checks the tree against the category's."""
    count = category.num_parts
    roots = [link for link in range(count) if link not in joints or joints[link].kind == "fixed"]
    kinds = {link: (joint.kind, joint.parent) for link, joint in joints.items()}
    if len(roots) == 1:
        root = roots[0]
        wanted = dict.fromkeys(set(range(count)) - {root}, (category.joint_types[0], root))
        if {k: v for k, v in kinds.items() if k != root} == wanted and (
            root not in joints or joints[root].parent is None
        ):
            return root
    raise CaperError(
        f"{path}: joints (link: type, parent) are {kinds}, but {category.name} has "
        f"{category.num_joints} {category.joint_types[0]} joint(s) on one root"
    )


def _read_visuals(robot: ElementTree.Element, path: Path, number: int) -> tuple[np.ndarray, Mesh]:
    """Pose [4, 4] of a link's first mesh in the link, and all its meshes in the link's frame."""
    poses, meshes = [], []
    for link in robot.iter("link"):
        if number_of(link.get("name", "")) != number:
            continue
        where = f"{path}, link {link.get('name')!r}"
        for visual in link.iter("visual"):
            geometry = visual.find("geometry/mesh")
            if geometry is None or not geometry.get("filename"):
                raise CaperError(f"{where}: a <visual> lacks <mesh filename=...>")
            scale = vector(geometry.get("scale", "1 1 1"), f"{where}, mesh scale")
            poses.append(_pose(visual, where))
            mesh = read_obj(path.parent / str(geometry.get("filename")))
            meshes.append(mesh.scaled(scale).moved(poses[-1]))
    if not meshes:
        raise CaperError(f"{path}: no link_{number} with a mesh")
    return poses[0], join(meshes)


def _pose(element: ElementTree.Element, where: str) -> np.ndarray:
    """[4, 4] of an <origin>."""
    pose = np.eye(4)
    pose[:3, 3] = origin_of(element, "xyz", where)
    (cr, cp, cy), (sr, sp, sy) = (f(origin_of(element, "rpy", where)) for f in (np.cos, np.sin))
    # Turns about the fixed axes x, y and z, one after the other.
    pose[:3, :3] = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    return pose


def read_obj(path: Path) -> Mesh:
    """Vertices and faces (fans of triangles) of an OBJ file; everything else in it is skipped.

    Raises:
      CaperError: missing or broken file, another format, or one without faces.
    """
    if path.suffix.lower() != ".obj":
        raise CaperError(f"{path}: meshes must be .obj files")
    if not path.is_file():
        raise CaperError(f"{path}: no such file (mesh of a part)")
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                x, y, z = map(float, words[1:4])
                vertices.append([x, y, z])
            elif words[:1] == ["f"]:
                corners = [int(word.partition("/")[0]) for word in words[1:]]
                # From 1, or backwards from the last vertex so far.
                rows = [c - 1 if c > 0 else len(vertices) + c for c in corners]
                faces += [[rows[0], *pair] for pair in pairwise(rows[1:])]
        except ValueError as error:
            raise CaperError(f"{path}, line {number}: broken OBJ ({error})") from error
    used = np.unique(np.array(faces, np.int64).ravel())
    if len(used) == 0 or used[0] < 0 or used[-1] >= len(vertices):
        raise CaperError(f"{path}: no faces, or faces of vertices that it lacks")
    corners_of = np.searchsorted(used, np.array(faces, np.int64))
    positions = np.array(vertices)[used]
    if not np.isfinite(positions).all():
        raise CaperError(f"{path}: the mesh has coordinates that are not finite")
    return Mesh(positions, corners_of)
