"""Cameras of generated frames: where they stand, and the arcs they move along in videos."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from caper_jax.articulation.category import Viewpoint
from caper_jax.articulation.pose import ArticulatedPose

# Largest change over a clip: azimuth, elevation and roll [rad], and distance (relative).
_ARC = np.array([np.radians(34.0), np.radians(9.0), np.radians(9.0), 0.15])
_LEAST = 0.25  # the smallest change, as a share of the largest


@flax.struct.dataclass
class Camera:
    """Where a camera stands relative to the object as in use; leading axes may be added.

    Attributes:
      azimuth, elevation, roll: radians, see ``Viewpoint``.
      log_distance: natural logarithm of the distance in object diagonals.
      target: [3] the point aimed at, canonical frame, in object diagonals.
      image_offset: [2] where the target stands in the image, on the plane z = 1.
      side: 1, or -1 where the object lies upside down: ``Viewpoint.up`` points into the table.
    """

    azimuth: Float[Any, "*batch"]
    elevation: Float[Any, "*batch"]
    roll: Float[Any, "*batch"]
    log_distance: Float[Any, "*batch"]
    target: Float[Any, "*batch 3"]
    image_offset: Float[Any, "*batch 2"]
    side: Float[Any, "*batch"]


def draw_camera(key: PRNGKeyArray, view: Viewpoint) -> Camera:
    """A camera in the ranges that the conventions ask for."""
    # One draw for all: every call of jax.random costs compile time.
    uniform = jax.random.uniform(key, (10,))
    rolls = view.camera_roll - view.roll, view.camera_roll + view.roll
    low = jnp.radians(jnp.array([view.azimuth[0], view.elevation[0], rolls[0]]))
    high = jnp.radians(jnp.array([view.azimuth[1], view.elevation[1], rolls[1]]))
    azimuth, elevation, roll = low + uniform[:3] * (high - low)
    # Uniform in log distance: relative, as perspective is.
    nearest, farthest = np.log(view.distance)
    # The object stands anywhere in the image. 0.55 and 0.35 are the half widths of a 58 x 39 deg
    # field of view at z = 1; wide cameras reach 1.2 times that.
    image_offset = (2.0 * uniform[7:9] - 1.0) * jnp.array([0.55, 0.35]) * 1.2 * uniform[9]
    side = jnp.ones(())
    if view.either_side:
        side = jax.random.rademacher(jax.random.fold_in(key, 1), (), side.dtype)
    return Camera(
        azimuth=azimuth,
        elevation=elevation,
        roll=roll,
        log_distance=nearest + uniform[3] * (farthest - nearest),
        target=(uniform[4:7] - 0.5) * 0.1,
        image_offset=image_offset,
        side=side,
    )


def camera_arc(
    key: PRNGKeyArray,
    camera: Camera,
    view: Viewpoint,
    frames: int,
    speed: float | Float[Array, ""],
) -> Camera:
    """A smooth arc that starts at ``camera``: every value changes by equal steps.

    Over the clip and at speed 1 the azimuth changes by up to 34 deg, elevation and roll by 9 deg
    and the distance by 15 %, each by at least a quarter of that; the arc turns the other way
    where it would leave the ranges of ``view``.

    Args:
      key: PRNG key.
      camera: the first camera, no leading axis.
      view: the ranges.
      frames: T.
      speed: 0 for a camera that stands still, 2 for twice the change; may be traced.

    Returns:
      Camera with leading axis T.
    """
    size, sign = jax.random.uniform(key, (2, 4))
    size = (_LEAST + (1.0 - _LEAST) * size) * jnp.where(sign < 0.5, -1.0, 1.0)
    change = speed * size * _ARC
    start = jnp.stack([camera.azimuth, camera.elevation, camera.roll, camera.log_distance])
    change = change.at[3].set(jnp.log1p(change[3]))
    azimuth = np.radians(view.azimuth)
    if azimuth[1] - azimuth[0] >= 2 * np.pi:
        azimuth = np.array([-np.inf, np.inf])
    elevation = np.radians(view.elevation)
    roll = np.radians([view.camera_roll - view.roll, view.camera_roll + view.roll])
    low, high = jnp.array([azimuth, elevation, roll, np.log(view.distance)]).T
    end = start + change
    end = jnp.where((end < low) | (end > high), start - change, end)
    # A range too narrow for the change either way: up to its border.
    end = jnp.clip(end, jnp.minimum(low, start), jnp.maximum(high, start))
    share = jnp.arange(frames) / (frames - 1)
    path = start[:, None] + (end - start)[:, None] * share
    return Camera(
        azimuth=path[0],
        elevation=path[1],
        roll=path[2],
        log_distance=path[3],
        target=jnp.broadcast_to(camera.target, (frames, 3)),
        image_offset=jnp.broadcast_to(camera.image_offset, (frames, 2)),
        side=jnp.broadcast_to(camera.side, (frames,)),
    )


def camera_pose(
    camera: Camera, view: Viewpoint, diagonal: float | Float[Any, ""]
) -> Float[Array, "4 4"]:
    """Pose [4, 4] root canonical -> camera (OpenCV axes) of a camera without leading axes.

    Args:
      camera: where it stands.
      view: says which canonical axis points up.
      diagonal: of the object at rest, meters.
    """
    distance = diagonal * jnp.exp(camera.log_distance)
    level, height = jnp.cos(camera.elevation), camera.side * jnp.sin(camera.elevation)
    around = jnp.array([jnp.sin(camera.azimuth) * level, height, jnp.cos(camera.azimuth) * level])
    # Canonical axes (x, y, z) cycle so that `up` comes second.
    shift = {"y": 0, "z": 1, "x": -1}[view.up]
    eye = jnp.roll(around, shift) * distance
    up = jnp.zeros(3).at["xyz".index(view.up)].set(camera.side)
    pose = _look_at(eye, camera.target * diagonal, up, camera.roll)
    # Turn the camera away from the object, keeping its place; less so at close range, where the
    # whole object must stay in front of it.
    image_offset = camera.image_offset * jnp.minimum(1.0, distance / (3.0 * diagonal))
    return jnp.matmul(_turn_aside(image_offset), pose, precision="highest")


def _look_at(eye, target, up, roll):
    """Camera pose world -> camera [4, 4] (OpenCV axes), rolled about the viewing direction."""
    z = target - eye
    z /= jnp.linalg.norm(z)
    x = jnp.cross(z, up)
    x /= jnp.linalg.norm(x)
    y = jnp.cross(z, x)
    cos, sin = jnp.cos(roll), jnp.sin(roll)
    rotation = jnp.stack([cos * x - sin * y, sin * x + cos * y, z])
    translation = -(rotation * eye).sum(-1)
    return jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(translation)


def _turn_aside(offset):
    """The shortest rotation [4, 4] that takes the optical axis to (offset, 1)."""
    direction = jnp.array([offset[0], offset[1], 1.0])
    direction /= jnp.linalg.norm(direction)
    x, y, z = direction
    scale = 1.0 / (1.0 + z)
    rotation = jnp.array(
        [
            [1.0 - x * x * scale, -x * y * scale, x],
            [-x * y * scale, 1.0 - y * y * scale, y],
            [-x, -y, z],
        ]
    )
    return jnp.eye(4).at[:3, :3].set(rotation)


def gravity(pose: ArticulatedPose, view: Viewpoint) -> Float[np.ndarray, "*batch 3"]:
    """The way things fall in generated frames: across the table, which is below the camera.

    Args:
      pose: ground truth [..., K, ...].
      view: which axis of the root points up.

    Returns:
      Unit vectors in the camera frame.
    """
    up = np.asarray(pose.rotation)[..., 0, :, "xyz".index(view.up)]
    if view.either_side:
        beyond = (up * np.asarray(pose.translation)[..., 0, :]).sum(-1, keepdims=True) > 0
        up = np.where(beyond, -up, up)
    return -up
