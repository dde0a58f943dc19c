"""Changes of frame between camera, viewing ray and the root's canonical space (paper Sec 5.2)."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np


def _cube_rotations() -> np.ndarray:
    """[24, 3, 3] signed permutation matrices of determinant one, the identity first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return np.stack(found).astype(np.float32)


# The rotations that map the coordinate axes onto each other.
CUBE_ROTATIONS = _cube_rotations()


def rotate(rotation, points):
    """[B, 3, 3], [B, N, 3] -> [B, N, 3], elementwise so that no backend rounds the factors."""
    return (rotation[:, None, :, :] * points[:, :, None, :]).sum(-1)


def multiply(first, second):
    """[..., 3, 3] @ [..., 3, 3] in full precision."""
    return jnp.matmul(first, second, precision="highest")


def transpose(rotation):
    """Inverse of rotations [..., 3, 3]."""
    return jnp.swapaxes(rotation, -1, -2)


def view_rotation(points, roll: float = 0.0):
    """The shortest rotation that turns the ray to the cloud's mean into the optical axis.

    An object looks the same wherever in the image it stands; after this rotation it also has the
    same coordinates, up to roll and distance. (Not in the paper; it costs nothing.)

    Args:
      points: [B, N, 3], camera frame.
      roll: static, degrees by which things are turned clockwise in the image; that is undone
        first (``Viewpoint.camera_roll``).

    Returns:
      [B, 3, 3], camera -> viewing frame.
    """
    if roll:
        cos, sin = np.cos(np.radians(roll)), np.sin(np.radians(roll))
        level = jnp.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]], points.dtype)
        return multiply(view_rotation(rotate(level[None], points)), level)
    mean = points.mean(axis=1)
    squared = (mean * mean).sum(-1, keepdims=True)
    # A cloud around the camera itself has no viewing direction: keep the camera's.
    ahead = jnp.array([0.0, 0.0, 1.0], mean.dtype)
    seen = (squared > 1e-12) & (mean[:, 2:] > 0)
    length = jnp.sqrt(jnp.where(seen, squared, 1.0))
    x, y, z = jnp.moveaxis(jnp.where(seen, mean / length, ahead), -1, 0)
    share = 1.0 / (1.0 + z)
    rows = [
        [1.0 - x * x * share, -x * y * share, -x],
        [-x * y * share, 1.0 - y * y * share, -y],
        [x, y, z],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def canonicalize(points, rotation, translation):
    """Camera -> root's canonical space: R^T (p - t), Sec 5.2.

    Args:
      points: [B, N, 3].
      rotation: [B, 3, 3] root pose.
      translation: [B, 3].
    """
    return rotate(transpose(rotation), points - translation[:, None, :])


def part_points(points, chosen):
    """The chosen points, each repeated as often as fills the cloud; all of them if none is chosen.

    Args:
      points: [B, N, 3].
      chosen: [B, N] bool.

    Returns:
      [B, N, 3].
    """
    chosen = chosen | ~chosen.any(axis=1, keepdims=True)
    number = points.shape[1]
    count = chosen.sum(axis=1, keepdims=True)
    order = jnp.argsort(~chosen, axis=1, stable=True)
    # Spread evenly, so that the copies keep the density of the part's surface.
    place = jnp.arange(number)[None] * count // number
    index = jnp.take_along_axis(order, place, axis=1)
    return jnp.take_along_axis(points, index[..., None], axis=1)
