"""Changes of frame between camera, viewing ray and the root's canonical space (paper Sec 5.2)."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from caper_jax.lie.linalg import transpose

_STEEP = np.sin(np.radians(3.0)) ** 2  # gravity this near to the optical axis levels nothing


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


def rotate(
    rotation: Float[Array, "#B 3 3"], points: Float[Array, "#B N 3"]
) -> Float[Array, "b N 3"]:
    """Rotated points, elementwise so that no backend rounds the factors."""
    return (rotation[:, None, :, :] * points[:, :, None, :]).sum(-1)


def multiply(
    first: Float[Array, "*#batch 3 3"], second: Float[Array, "*#batch 3 3"]
) -> Float[Array, "... 3 3"]:
    """Product of rotations in full precision."""
    return jnp.matmul(first, second, precision="highest")


def view_rotation(points: Float[Array, "B N 3"], roll: float = 0.0) -> Float[Array, "B 3 3"]:
    """The shortest rotation that turns the ray to the cloud's mean into the optical axis.

    An object looks the same wherever in the image it stands; after this rotation it also has the
    same coordinates, up to roll and distance. (Not in the paper; it costs nothing.)

    Args:
      points: camera frame.
      roll: static, degrees by which things appear rotated clockwise in the image; that is undone
        first (``Viewpoint.camera_roll``).

    Returns:
      Camera -> viewing frame.
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


def level_rotation(gravity: Float[Array, "B 3"]) -> Float[Array, "B 3 3"]:
    """The rotation about the optical axis after which gravity points down the image, along +y.

    Args:
      gravity: in the frame to level, of any length; zeros where it is unknown. There, and within 3
        deg of the optical axis, where no direction of the image is down, nothing is rotated.
    """
    x, y = gravity[:, 0], gravity[:, 1]
    across = jnp.square(x) + jnp.square(y)
    known = across > _STEEP * jnp.square(gravity).sum(-1)
    length = jnp.sqrt(jnp.where(known, across, 1.0))
    cos, sin = jnp.where(known, y / length, 1.0), jnp.where(known, x / length, 0.0)
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    rows = [[cos, -sin, zero], [sin, cos, zero], [zero, zero, one]]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def canonicalize(
    points: Float[Array, "B N 3"], rotation: Float[Array, "B 3 3"], translation: Float[Array, "B 3"]
) -> Float[Array, "B N 3"]:
    """Camera -> root's canonical space: R^T (p - t), with the root's pose (Sec 5.2)."""
    return rotate(transpose(rotation), points - translation[:, None, :])


def part_points(points: Float[Array, "B N 3"], chosen: Bool[Array, "B N"]) -> Float[Array, "B N 3"]:
    """The chosen points, repeated evenly to fill the cloud; all points if none is chosen."""
    chosen = chosen | ~chosen.any(axis=1, keepdims=True)
    number = points.shape[1]
    count = chosen.sum(axis=1, keepdims=True)
    order = jnp.argsort(~chosen, axis=1, stable=True)
    # Spread evenly, so that the copies keep the density of the part's surface.
    place = jnp.arange(number)[None] * count // number
    index = jnp.take_along_axis(order, place, axis=1)
    return jnp.take_along_axis(points, index[..., None], axis=1)
