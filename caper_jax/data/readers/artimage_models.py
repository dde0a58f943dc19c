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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.images import read_json
from caper_jax.data.readers.artimage_frames import AxisMap, Rest, canonical_axes
from caper_jax.data.readers.public_urdf import (
    ALIGNED,
    POINT_ORDER,
    RAW,
    UrdfJoint,
    base_joint,
    moving_joints,
    number_of,
)
from caper_jax.data.readers.reartmix_models import Model
from caper_jax.errors import CaperError

REST_STATES = "rest_state.json"
POINTS = "part_point_sample"


@dataclass(frozen=True)
class RestModel(Model):
    """A model together with the file's numbering.

    Attributes:
      links: part k is link ``links[k]`` of the file.
      signs: [J] our state of joint j is ``signs[j]`` times the file's.
    """

    links: tuple[int, ...]
    signs: np.ndarray


def read_model(folder: Path, urdf_id: int | str, category: Category) -> RestModel:
    """Reads one object and brings it to our rest pose and frame.

    Args:
      folder: the category's ``urdf`` folder.
      urdf_id: name of the object's folder in it.
      category: gives the parts, their tree and the types of joints.

    Raises:
      CaperError: missing or broken files, or an object that does not fit the category.
    """
    home = folder / str(urdf_id)
    if not home.is_dir():
        raise CaperError(f"{folder}: no object {urdf_id} (no folder of that name)")
    joints = _read_joints(home / ALIGNED, category)
    states = _rest_states(folder / REST_STATES, urdf_id, joints)
    points = [_read_points(home / POINTS / f"{k}.xyz") for k in range(category.num_parts)]

    # Poses of the parts at rest, and joints there: raw points -> the file's rest frame.
    poses = [_base_change(home) if category.name == "scissors" else np.eye(4)]
    pivots = [np.zeros(3)]
    axis, pivot, opening = [], [], []
    for joint, state in zip(joints, states, strict=True):
        number = _parent(joint)
        parent, own_axis = poses[number], joint.axis[POINT_ORDER]
        own_axis = own_axis / np.linalg.norm(own_axis)
        pivots.append(joint.origin[POINT_ORDER] + (pivots[number] if number else 0.0))
        sense = -1.0 if joint.kind == "revolute" else 1.0
        poses.append(parent @ _motion(joint.kind, own_axis, pivots[-1], sense * state))
        axis.append(sense * parent[:3, :3] @ own_axis)
        pivot.append(parent[:3, :3] @ pivots[-1] + parent[:3, 3])
        low, high = joint.limits or (state, state + 1.0)
        opening.append(1.0 if high - state >= state - low else -1.0)
    moved = [p @ pose[:3, :3].T + pose[:3, 3] for p, pose in zip(points, poses, strict=True)]

    rest = Rest(moved, np.array(axis), np.array(pivot), np.array(opening))
    reading = canonical_axes(rest, category, str(home))
    return rest_model(rest, poses, reading)


def rest_model(rest: Rest, poses: Sequence[np.ndarray], reading: AxisMap) -> RestModel:
    """The model of an object whose reading is known.

    Args:
      rest: the object at rest, in the file's frame.
      poses: K [4, 4], the links' own frames -> that frame, at rest.
      reading: how it becomes ours.
    """
    turn, order = reading.turn, list(reading.order)
    joints = np.array(order[1:], int) - 1
    boxes = [rest.points[link] @ turn.T for link in order]
    low, high = np.array([b.min(0) for b in boxes]), np.array([b.max(0) for b in boxes])
    origin = (low.min(0) + high.max(0)) / 2
    # p_raw = R_rest^T (A^T (p_ours + origin) - t_rest)
    back = [poses[link][:3, :3].T for link in order]
    shift = [turn.T @ origin - poses[link][:3, 3] for link in order]
    axis = rest.axis[joints] @ turn.T
    return RestModel(
        to_file_rotation=np.stack([b @ turn.T for b in back]),
        to_file_shift=np.stack([b @ s for b, s in zip(back, shift, strict=True)]),
        size=high - low,
        center=(low + high) / 2 - origin,
        file_axis=rest.axis[joints],
        axis=reading.signs[:, None] * axis,
        pivot=rest.pivot[joints] @ turn.T - origin,
        links=reading.order,
        signs=reading.signs,
    )


def _read_joints(path: Path, category: Category) -> list[UrdfJoint]:
    """J joints in the order of their child links, checked against the category's tree."""
    joints = moving_joints(path, number_of)
    found = {joint.child: (_parent(joint), joint.kind) for joint in joints}
    expected = {j + 1: (joint.parent, joint.type) for j, joint in enumerate(category.joints)}
    if found != expected:
        raise CaperError(
            f"{path}: joints (child: parent, type) are {found}, but {category.name} has {expected}"
        )
    return joints


def _parent(joint: UrdfJoint) -> int:
    """Number of the link a joint is mounted on; the base is the root's own frame."""
    return number_of(joint.parent) or 0


def _rest_states(path: Path, urdf_id: int | str, joints: list[UrdfJoint]) -> list[float]:
    """[J] radians or meters; an object that the file does not list is stored at rest."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise CaperError(f"{path}: expected an object of objects {{urdf_id: {{part: state}}}}")
    entry = content.get(str(urdf_id))
    states = []
    for child, joint in enumerate(joints, start=1):
        if entry is None and joint.kind == "revolute":
            states.append(0.0)
            continue
        where = f"{path}: {urdf_id}, part {child}"
        try:
            state = float((entry or {})[str(child)]["state"])
        except (KeyError, TypeError, ValueError) as error:
            raise CaperError(f"{where}: needs a number 'state'") from error
        if not np.isfinite(state):
            raise CaperError(f"{where}: state must be finite, got {state}")
        states.append(float(np.radians(state)) if joint.kind == "revolute" else state)
    return states


def _base_change(home: Path) -> np.ndarray:
    """[4, 4] extra transform of scissors: aligned minus raw base joint, as loaders compute it."""
    (xyz, rpy), (raw_xyz, raw_rpy) = (base_joint(home / name) for name in (ALIGNED, RAW))
    change = np.eye(4)
    # (r, p, y) count as turns by -r, y and -p about z, x and y, one after the other (intrinsic).
    z, x, y = (rpy - raw_rpy)[[0, 2, 1]] * (-1, 1, -1)
    change[:3, :3] = _turn(np.eye(3)[2], z) @ _turn(np.eye(3)[0], x) @ _turn(np.eye(3)[1], y)
    change[:3, 3] = (xyz - raw_xyz)[[0, 2, 1]] * (-1, 1, -1)
    return change


def _motion(kind: str, axis: np.ndarray, pivot: np.ndarray, state: float) -> np.ndarray:
    """[4, 4] turn about, or slide along, a unit axis."""
    motion = np.eye(4)
    if kind == "revolute":
        motion[:3, :3] = _turn(axis, state)
        motion[:3, 3] = pivot - motion[:3, :3] @ pivot
    else:
        motion[:3, 3] = state * axis
    return motion


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """[3, 3] rotation about a unit axis (Rodrigues)."""
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


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
