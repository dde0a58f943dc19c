"""The 3-D models of ArtImage and PM-Videos, brought to our rest pose and frame.

A category's ``urdf`` folder holds rest_state.json and, per object, the joints
(mobility_for_unity_align.urdf) and points on the surface of every part
(part_point_sample/<link>.xyz). Public loaders fix what the files mean:

- ``xyz`` of origins and axes in the URDF is (z, x, y) of the points; ``rpy`` of joints is not used;
- the child of a revolute joint turns by MINUS the state about the axis, that of a prismatic one
  slides by plus the state; rest_state.json gives the states (degrees, meters) that bring the
  points to the rest pose, and the states of the annotations count from there;
- scissors alone are then moved by the difference between the base joints of
  mobility_for_unity_align.urdf and mobility_for_unity.urdf;
- the origin is the center of the box around all points at rest.

Public loaders know only joints on the root. Here rest poses compose along the tree, and the
origin of a joint on another part counts from that part's own joint, as in any URDF.

The files keep objects in an upright frame (y up) at a rest pose of their own. The sample data for
laptop, dishwasher and drawer have our frame and our rest pose. The official files could not be
read. What is known of them is that PartNet objects stand upright and face one horizontal axis, so
the front is told from the parts at rest, as the category's ``ArtImageConversion`` says. That the
official rest pose is ours (laptop and dishwasher open by 90 deg, drawers closed, glasses unfolded)
is assumed, not verified. Objects of a category without a conversion are taken to be in our frame.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from caper_jax.articulation.category import Category
from caper_jax.articulation.conversions import ArtImageConversion, AxisMap, Front, RestObject
from caper_jax.articulation.kinematics import forward_kinematics_float64
from caper_jax.data.images import check_values, read_json
from caper_jax.data.readers.annotations import Model
from caper_jax.data.readers.base import Schema
from caper_jax.data.urdf.xml import (
    UrdfJoint,
    attribute,
    number_of,
    parse_urdf,
    read_joints,
    vector,
)
from caper_jax.errors import CaperError

REST_STATES = "rest_state.json"
POINTS = "part_point_sample"
ALIGNED, RAW = "mobility_for_unity_align.urdf", "mobility_for_unity.urdf"
# x, y, z of origins and axes in these files are the third, first and second coordinate of the
# points.
POINT_ORDER = [1, 2, 0]
_LEAST_SHARE = 0.3  # of a direction must be horizontal to tell where the front is
_LEAST_COSINE = 0.5  # between a joint's axis and the one it must be


class _RestState(Schema):
    """State of a part at rest, degrees or meters."""

    state: float


def read_model(
    folder: Path, object_id: str, category: Category, conversion: ArtImageConversion
) -> Model:
    """Reads one object and brings it to our rest pose and frame.

    Args:
      folder: the category's ``urdf`` folder.
      object_id: name of the object's folder in it.
      category: gives the parts, their tree and the types of joints.
      conversion: of the category.

    Raises:
      CaperError: missing or broken files, or an object that does not fit the category.
    """
    home = folder / object_id
    if not home.is_dir():
        raise CaperError(f"{folder}: no object {object_id} (no folder of that name)")
    joints = _read_joints(home / ALIGNED, category)
    states = _rest_states(folder / REST_STATES, object_id, joints)
    points = [_read_points(home / POINTS / f"{k}.xyz") for k in range(category.num_parts)]

    # Raw points -> the file's rest frame. Axes and pivots of the raw points' frame.
    senses = np.array([-1.0 if joint.kind == "revolute" else 1.0 for joint in joints])
    axes = np.array([joint.axis for joint in joints])[:, POINT_ORDER]
    pivots = [np.zeros(3)]
    for joint, parent in zip(joints, category.parents, strict=True):
        pivots.append(joint.origin[:3, 3][POINT_ORDER] + pivots[parent])
    root = _base_change(home) if conversion.moved_by_base else np.eye(4)
    poses = forward_kinematics_float64(
        root, axes, np.array(pivots[1:]), senses * states, category.joint_types, category.parents
    )

    carriers = poses[list(category.parents)]
    turned = np.einsum("jab,jb->ja", carriers[:, :3, :3], axes)
    rest = RestObject(
        points=[p @ pose[:3, :3].T + pose[:3, 3] for p, pose in zip(points, poses, strict=True)],
        axis=senses[:, None] * turned,
        pivot=np.einsum("jab,jb->ja", carriers[:, :3, :3], pivots[1:]) + carriers[:, :3, 3],
        opening=np.array([_opening(j, state) for j, state in zip(joints, states, strict=True)]),
    )
    return rest_model(rest, poses, canonical_axes(rest, category, conversion.axes, str(home)))


def canonical_axes(rest: RestObject, category: Category, rule, where: str) -> AxisMap:
    """The rotation, order and signs that bring an object of a public file to our conventions.

    Args:
      rest: the object at the file's rest pose, in the file's frame.
      category: ours.
      rule: ``ArtImageConversion.axes``.
      where: the file, for errors.

    Raises:
      CaperError: an object that does not face one side, or whose joints lie across those of its
        category.
    """
    order = np.arange(category.num_parts)
    if rule is None:
        return AxisMap(np.eye(3), tuple(order.tolist()), np.ones(category.num_joints))
    if not isinstance(rule, Front):
        return rule(rest, where)
    centers = np.array([(part.min(0) + part.max(0)) / 2 for part in rest.points])
    if rule.shown_by == "slide":
        front = (rest.opening[:, None] * rest.axis).mean(0)
    else:
        front = (centers[1:] - centers[0]).mean(0) * (1 if rule.shown_by == "ahead" else -1)
    if np.hypot(front[0], front[2]) < _LEAST_SHARE * np.linalg.norm(front):
        raise CaperError(
            f"{where}: cannot tell the front of this {category.name}: its parts lie above each "
            "other or slide upwards; y must be up"
        )
    # By quarters about y, after which the front is +z.
    quarters = np.rint(np.arctan2(-front[0], front[2]) / (np.pi / 2))
    rotation = np.rint(Rotation.from_euler("y", 90 * quarters, degrees=True).as_matrix())

    if rule.sorted_by is not None:
        order[1:] = 1 + np.argsort(centers[1:] @ rotation[rule.sorted_by], kind="stable")
    axis = rest.axis[order[1:] - 1] @ rotation.T
    cosines = (axis * np.array(rule.axes)).sum(-1)
    if (np.abs(cosines) < _LEAST_COSINE).any():
        joint = int(np.abs(cosines).argmin())
        raise CaperError(
            f"{where}: the axis of joint {order[joint + 1]} lies across that of a {category.name} "
            f"({np.round(axis[joint], 3).tolist()} in our frame, expected {rule.axes[joint]})"
        )
    return AxisMap(rotation, tuple(order.tolist()), np.sign(cosines))


def rest_model(rest: RestObject, poses: np.ndarray, axes: AxisMap) -> Model:
    """The model of an object whose axes are known, with the boxes of its points.

    Args:
      rest: the object at rest, in the file's frame.
      poses: [K, 4, 4] the links' own frames -> that frame, at rest.
      axes: how it becomes ours.
    """
    boxes = [rest.points[link] @ axes.rotation.T for link in axes.order]
    low, high = np.array([b.min(0) for b in boxes]), np.array([b.max(0) for b in boxes])
    return Model.of_rest(rest, poses, axes, high - low, (low + high) / 2)


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


def _read_joints(path: Path, category: Category) -> list[UrdfJoint]:
    """J joints in the order of their child links, checked against the category's tree."""
    joints = moving_joints(path, r"(\d+)$")
    # The base is the root's own frame.
    tree = [(number_of(joint.parent) or 0, joint.kind) for joint in joints]
    expected = [(joint.parent, joint.type) for joint in category.joints]
    if tree != expected:
        raise CaperError(
            f"{path}: joints (parent, type) are {tree}, but {category.name} has {expected}"
        )
    return joints


def _opening(joint: UrdfJoint, state: float) -> float:
    """+1 where more of the joint's range lies above its state at rest, else -1."""
    low, high = joint.limits
    return 1.0 if high - state >= state - low else -1.0


def _rest_states(path: Path, object_id: str, joints: list[UrdfJoint]) -> np.ndarray:
    """[J] radians or meters; an object that the file does not list is stored at rest."""
    content = check_values(dict[str, dict[str, Any]], read_json(path), str(path))
    if object_id not in content and all(joint.kind == "revolute" for joint in joints):
        return np.zeros(len(joints))
    states = []
    for child in map(str, range(1, len(joints) + 1)):
        entry = content.get(object_id, {}).get(child, {})
        states.append(check_values(_RestState, entry, f"{path}: {object_id}, part {child}").state)
    revolute = [joint.kind == "revolute" for joint in joints]
    return np.where(revolute, np.radians(states), states)


def _base_change(home: Path) -> np.ndarray:
    """[4, 4]: aligned minus raw base joint, as public loaders compute it."""
    base, raw = (_base_origin(home / name) for name in (ALIGNED, RAW))
    change = np.eye(4)
    # (r, p, y) count as turns by -r, y and -p about z, x and y, one after the other (intrinsic).
    xyz, angles = (base - raw)[:, [0, 2, 1]] * (-1, 1, -1)
    change[:3, :3] = Rotation.from_euler("ZXY", angles).as_matrix()
    change[:3, 3] = xyz
    return change


def _base_origin(path: Path) -> np.ndarray:
    """[2, 3] xyz and rpy of the joint that is numbered 0."""
    for joint in parse_urdf(path).iterfind("joint"):
        name = joint.get("name", "")
        if name.split("_")[1:2] == ["0"]:
            where = f"{path}, joint {name!r}, origin"
            texts = [attribute(joint, "origin", key, "0 0 0") for key in ("xyz", "rpy")]
            return np.stack([vector(text, where) for text in texts])
    raise CaperError(f"{path}: lacks the base joint (name <text>_0)")


def _read_points(path: Path) -> np.ndarray:
    """[n, 3] meters from lines of three or more numbers, of which the first three count."""
    if not path.is_file():
        raise CaperError(f"{path}: no such file (points of a part)")
    try:
        lines = [line for line in path.read_text().splitlines() if line.partition("#")[0].strip()]
        points = np.loadtxt(lines, np.float64, usecols=(0, 1, 2), ndmin=2) if lines else None
    except ValueError as error:
        raise CaperError(f"{path}: lines must hold three numbers x y z ({error})") from error
    if points is None or not np.isfinite(points).all():
        raise CaperError(f"{path}: holds no points, or points that are not finite")
    return points
