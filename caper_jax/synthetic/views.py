"""Images of generated objects through one camera that is the same for all of them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.synthetic.frames import draw_state_and_poses, part_poses
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.render import Image, render_pose
from caper_jax.synthetic.videos import check_length

# Share of the image that the object may fill, from its middle to each side.
_FILL = 0.92
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def still(
    key, instance: InstanceBank, category: Category, noise: str, intrinsics: np.ndarray, size: int
) -> Image:
    """One image in a random state, seen whole.

    Args:
      key: PRNG key.
      instance: InstanceBank without its leading axis.
      category: its category.
      noise: sensor preset.
      intrinsics: [3, 3] of the camera.
      size: pixels per side.
    """
    keys = jax.random.split(key)
    state, poses, _ = _draw(keys[0], instance, category)
    (image,) = _images(keys[1], instance, state[None], poses[0], category, noise, intrinsics, size)
    return image


def clip(
    key,
    instance: InstanceBank,
    category: Category,
    noise: str,
    intrinsics: np.ndarray,
    size: int,
    frames: int,
    moving: int,
) -> Iterator[Image]:
    """A video of an object before a camera at rest, one joint of which moves.

    The joint goes from the first fifth of its range to the last, in unequal steps; the other
    joints keep a random state.

    Args:
      key, instance, category, noise, intrinsics, size: as for ``still``.
      frames: T.
      moving: index of the joint.

    Raises:
      CaperError: less than two frames.
    """
    check_length(frames)
    keys = jax.random.split(key, 3)
    state, poses, _ = _draw(keys[0], instance, category)
    rng = np.random.default_rng(np.asarray(jax.random.bits(keys[1], (4,))))
    steps = np.cumsum(rng.uniform(0.5, 1.5, frames))
    share = rng.uniform(0.0, 0.2) + rng.uniform(0.6, 0.8) * (steps - steps[0]) / np.ptp(steps)
    states = np.tile(np.asarray(state), (frames, 1))
    low, high = np.asarray(instance.limits)[moving]
    states[:, moving] = low + share * (high - low)
    return _images(keys[2], instance, states, poses[0], category, noise, intrinsics, size)


_draw = jax.jit(draw_state_and_poses, static_argnames="category")
_part_poses = jax.jit(part_poses, static_argnames="category")


def _images(
    key, instance: InstanceBank, states, root, category: Category, noise: str, intrinsics, size: int
) -> Iterator[Image]:
    """Images of all states from one place, far enough for the object to fit."""
    states = jnp.asarray(states)
    poses = np.asarray(_part_poses(root, instance, states, category), np.float64)
    boxes = np.asarray(instance.box_center)[:, None] + np.asarray(instance.size)[:, None] * _CORNERS
    corners = np.einsum("tkij,knj->tkni", poses[..., :3, :3], boxes) + poses[..., None, :3, 3]
    move = _fit(key, corners.reshape(-1, 3), intrinsics, size)
    moved = jnp.asarray(move @ np.asarray(root, np.float64), jnp.float32)
    poses = np.asarray(_part_poses(moved, instance, states, category))
    look = partial(render_pose, category=category, noise=noise, intrinsics=intrinsics)
    for index, state in enumerate(states):
        yield look(
            jax.random.fold_in(key, index), instance, state, poses[index], width=size, height=size
        )


def _fit(key, corners: np.ndarray, intrinsics: np.ndarray, size: int) -> np.ndarray:
    """[4, 4] motion of the camera's frame after which all corners [n, 3] are in the image."""
    rng = np.random.default_rng(np.asarray(jax.random.bits(key, (4,))))
    middle = (corners.min(0) + corners.max(0)) / 2
    # Turn the camera towards the object: the shortest turn of its middle to the optical axis.
    z = middle / np.linalg.norm(middle)
    x = np.array([z[2], 0.0, -z[0]]) / np.hypot(z[0], z[2])
    move = np.eye(4)
    move[:3, :3] = np.stack([x, np.cross(z, x), z])
    turned = corners @ move[:3, :3].T
    # The object reaches to `half` on the plane z = 1 when it is `back` farther away.
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]])
    room = _FILL * np.minimum(intrinsics[:2, 2], size - intrinsics[:2, 2]) / focal
    back = (np.abs(turned[:, :2]) / room).max(-1) - turned[:, 2]
    nearest = 0.05 * np.linalg.norm(np.ptp(turned, axis=0)) - turned[:, 2].min()
    move[2, 3] = max(back.max(), nearest, 0.0)
    # Somewhere in the room that is left.
    depth = turned[:, 2] + move[2, 3]
    slack = (room * depth[:, None] - np.abs(turned[:, :2])).min(0)
    move[:2, 3] = rng.uniform(-1.0, 1.0, 2) * slack
    return move
