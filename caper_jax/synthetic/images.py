"""Whole depth images of generated objects on a table, as a camera would give them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.synthetic import sensor as sensors
from caper_jax.synthetic.frames import articulated_pose, draw_state_and_poses, part_poses
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.masks import table_depth
from caper_jax.synthetic.ray_casting import FAR, cast, projected_bounds
from caper_jax.synthetic.videos import check_length

# Share of the image that the object may fill, from its middle to each side.
_FILL = 0.92
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


@dataclass(frozen=True)
class Image:
    """One rendered frame.

    Attributes:
      depth: [H, W] float32 meters, 0 where the sensor returns nothing.
      parts: [H, W] int32 part of each pixel, -1 off the object.
      intrinsics: [3, 3] pixels.
      pose: ArticulatedPose (numpy, no batch axis).
    """

    depth: Float[np.ndarray, "H W"]
    parts: Int[np.ndarray, "H W"]
    intrinsics: Float[np.ndarray, "3 3"]
    pose: ArticulatedPose


def render_image(
    key: PRNGKeyArray,
    instance: InstanceBank,
    category: Category,
    noise: str,
    width: int = 640,
    height: int = 480,
) -> Image:
    """One instance on a table, drawn as by ``frames`` and seen whole by a pinhole camera.

    Args:
      key: PRNG key.
      instance: InstanceBank without its leading axis.
      category: its category.
      noise: sensor preset.
      width, height: pixels.

    Raises:
      CaperError: unknown noise preset.
    """
    return _image(*_render(key, instance, _sensor(noise), category, width, height))


def render_pose(
    key: PRNGKeyArray,
    instance: InstanceBank,
    state: Float[Any, " J"],
    poses: Float[Any, "K 4 4"],
    category: Category,
    noise: str,
    intrinsics: Float[np.ndarray, "3 3"],
    width: int = 640,
    height: int = 480,
) -> Image:
    """One instance on a table, in given poses before a given camera.

    Args:
      key: PRNG key of the sensor's noise.
      instance: InstanceBank without its leading axis.
      state: [J] joint states that the poses have.
      poses: [K, 4, 4] part rest frame -> camera.
      category: its category.
      noise: sensor preset.
      intrinsics: [3, 3] pixels, without skew.
      width, height: pixels.

    Raises:
      CaperError: unknown noise preset.
    """
    camera = jnp.asarray(intrinsics, jnp.float32)
    depth, parts = _look(key, instance, poses, _sensor(noise), camera, category, width, height)
    return _image(depth, parts, intrinsics, articulated_pose(instance, state, poses))


def _image(depth, parts, intrinsics, pose: ArticulatedPose) -> Image:
    pose = jax.tree.map(np.asarray, pose)
    return Image(np.asarray(depth), np.asarray(parts), np.asarray(intrinsics, np.float64), pose)


def _sensor(noise: str):
    return jax.tree.map(lambda values: values[0], sensors.sensor_mix((noise,)))


@partial(jax.jit, static_argnames=("category", "width", "height"))
def _render(key, instance: InstanceBank, sensor, category: Category, width: int, height: int):
    keys = jax.random.split(key, 4)
    state, poses, _ = draw_state_and_poses(keys[0], instance, category)
    # A focal length between those of wide and narrow depth cameras, shortened until the object
    # is in the image with a margin.
    low, high = projected_bounds(instance.groups, poses)
    reach = jnp.maximum(jnp.abs(low), jnp.abs(high)) / jnp.array([width, height])
    focal = jax.random.uniform(keys[1], minval=0.85, maxval=1.25) * width
    focal = jnp.minimum(focal, 0.46 / reach.max())
    size = jnp.array([width, height])
    shift = jax.random.uniform(keys[2], (2,), minval=-0.01, maxval=0.01)
    center = size / 2 + shift * size
    intrinsics = jnp.array([[focal, 0.0, center[0]], [0.0, focal, center[1]], [0.0, 0.0, 1.0]])
    depth, parts = _look(keys[3], instance, poses, sensor, intrinsics, category, width, height)
    return depth, parts, intrinsics, articulated_pose(instance, state, poses)


@partial(jax.jit, static_argnames=("category", "width", "height"))
def _look(
    key,
    instance: InstanceBank,
    poses,
    sensor,
    intrinsics,
    category: Category,
    width: int,
    height: int,
):
    """Measured depth [H, W] and parts [H, W] of an object in given part poses, and its table."""
    x = (jnp.arange(width) - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (jnp.arange(height) - intrinsics[1, 2]) / intrinsics[1, 1]
    x, y = jnp.meshgrid(x, y, indexing="xy")
    depth, parts = cast(instance.groups, poses, (x.ravel(), y.ravel()))
    depth, parts = depth.reshape(x.shape), parts.reshape(x.shape)
    table = table_depth(instance, poses, category.viewpoint, (x, y))
    on_table = table < depth
    depth, parts = jnp.where(on_table, table, depth), jnp.where(on_table, -1, parts)

    hit = depth < FAR
    surface = sensors.surface_map(depth, hit, (x, y))
    noise_key, loss_key = jax.random.split(key)
    seen = sensors.valid_pixels(loss_key, sensor, surface, hit)
    measured = sensors.measure(noise_key, sensor, surface, (x, y))[..., 2]
    return jnp.where(seen, measured, 0.0), jnp.where(seen, parts, -1)


def render_still(
    key: PRNGKeyArray,
    instance: InstanceBank,
    category: Category,
    noise: str,
    intrinsics: Float[np.ndarray, "3 3"],
    size: int,
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


def render_clip(
    key: PRNGKeyArray,
    instance: InstanceBank,
    category: Category,
    noise: str,
    intrinsics: Float[np.ndarray, "3 3"],
    size: int,
    frames: int,
    moving: int,
) -> Iterator[Image]:
    """A video of an object before a camera at rest, one joint of which moves.

    The joint goes from the first fifth of its range to the last, in unequal steps; the other
    joints keep a random state.

    Args:
      key, instance, category, noise, intrinsics, size: as for ``render_still``.
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
    for index, state in enumerate(states):
        frame_key = jax.random.fold_in(key, index)
        yield render_pose(
            frame_key, instance, state, poses[index], category, noise, intrinsics, size, size
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
    rotated = corners @ move[:3, :3].T
    # The object reaches to `half` on the plane z = 1 when it is `back` farther away.
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]])
    room = _FILL * np.minimum(intrinsics[:2, 2], size - intrinsics[:2, 2]) / focal
    back = (np.abs(rotated[:, :2]) / room).max(-1) - rotated[:, 2]
    nearest = 0.05 * np.linalg.norm(np.ptp(rotated, axis=0)) - rotated[:, 2].min()
    move[2, 3] = max(back.max(), nearest, 0.0)
    # Somewhere in the room that is left.
    depth = rotated[:, 2] + move[2, 3]
    slack = (room * depth[:, None] - np.abs(rotated[:, :2])).min(0)
    move[:2, 3] = rng.uniform(-1.0, 1.0, 2) * slack
    return move


def write_frame(folder: str | Path, image: Image, category: Category, name: str) -> None:
    """Writes one frame as the commands read it.

    depth.png (16 bit, millimeters), mask.png (255 on the object), intrinsics.json and truth.json
    (the fields of ArticulatedPose; meters, and degrees for the states of revolute joints).
    """
    from PIL import Image as Picture

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    millimeters = np.clip(np.round(image.depth * 1000), 0, 65535).astype(np.uint16)
    Picture.fromarray(millimeters).save(folder / "depth.png")
    mask = np.where(image.parts >= 0, 255, 0).astype(np.uint8)
    Picture.fromarray(mask).save(folder / "mask.png")
    height, width = image.depth.shape
    camera = {
        "width": width,
        "height": height,
        # Open3D's layout: column-major.
        "intrinsic_matrix": [round(float(v), 6) for v in image.intrinsics.T.ravel()],
    }
    truth: dict[str, Any] = {"category": category.name, "frame": name}
    for field, values in vars(image.pose).items():
        truth[field] = np.round(np.asarray(values, np.float64), 9).tolist()
    truth["joint_state"] = [
        round(float(np.degrees(state) if kind == "revolute" else state), 7)
        for state, kind in zip(image.pose.joint_state, category.joint_types, strict=True)
    ]
    for file, content in (("intrinsics.json", camera), ("truth.json", truth)):
        (folder / file).write_text(json.dumps(content, indent=1) + "\n")
