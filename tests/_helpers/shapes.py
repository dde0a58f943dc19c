"""Parts of drawn objects: their boxes, corners and points, and how joints move them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from _helpers.solid_points import inside
from caper_jax.articulation.category import ObjectModel
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.geometry.solids import Solid, bounds

_BOXES: dict[int, tuple[ObjectModel, np.ndarray]] = {}  # by identity: models cannot be hashed


def boxes(model: ObjectModel) -> np.ndarray:
    """[K, 2, 3] low and high corners of the parts; worked out once for every model."""
    if id(model) not in _BOXES:
        _BOXES[id(model)] = model, np.array([bounds(part) for part in model.parts])
    return _BOXES[id(model)][1]


def corners(solids: list[Solid]) -> np.ndarray:
    """[N, 3] corners of solids."""
    return np.concatenate([solid.corners() for solid in solids])


def sample(rng: np.random.Generator, solids: list[Solid], each: int) -> np.ndarray:
    """[N, 3] points in solids."""
    points = []
    for solid in solids:
        drawn = solid.center + (rng.uniform(-1, 1, (each, 3)) * solid.half) @ solid.rotation.T
        points.append(drawn[inside(solid, drawn)])
    return np.concatenate(points)


def motion(model: ObjectModel, joint: int, state: float) -> np.ndarray:
    """[4, 4] motion of a revolute joint from rest, by SciPy."""
    turn, pivot = Rotation.from_rotvec(model.axis[joint] * state).as_matrix(), model.pivot[joint]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, pivot - turn @ pivot
    return pose


def moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """[N, 3] points under a motion [4, 4]."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def kinds(part: list[Solid]) -> list[str]:
    """What each solid of a part is, "box" or "box-cylinder" with a hole."""
    return [solid.kind + (f"-{solid.hole.kind}" if solid.hole else "") for solid in part]


def outside_part(pose: ArticulatedPose, points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """[..., N] how far points [..., N, 3] are outside of the box of their part, negative inside."""
    rows = tuple(np.ix_(*map(range, labels.shape[:-1]), [0]))[:-1]
    where = (*rows, labels)
    offset = points - pose.translation[where]
    local = np.einsum("...nji,...nj->...ni", pose.rotation[where], offset)
    return (np.abs(local - pose.box_center[where]) - pose.size[where] / 2).max(-1)
