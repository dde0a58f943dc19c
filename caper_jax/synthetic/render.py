"""Whole depth images of generated objects on a table, as a camera would give them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.synthetic import sensor as sensors
from caper_jax.synthetic.frames import draw_state_and_poses
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.ray_casting import FAR, cast, projected_bounds
from caper_jax.synthetic.surroundings import table_depth


@dataclass(frozen=True)
class Image:
    """One rendered frame.

    Attributes:
      depth: [H, W] float32 meters, 0 where the sensor returns nothing.
      parts: [H, W] int32 part of each pixel, -1 off the object.
      intrinsics: [3, 3] pixels.
      pose: ArticulatedPose (numpy, no batch axis).
    """

    depth: np.ndarray
    parts: np.ndarray
    intrinsics: np.ndarray
    pose: ArticulatedPose


def render_image(
    key, instance: InstanceBank, category: Category, noise: str, width: int = 640, height: int = 480
) -> Image:
    """One instance on a table, drawn as in ``scene`` and seen whole by a pinhole camera.

    Args:
      key: PRNG key.
      instance: InstanceBank without its leading axis.
      category: its category.
      noise: sensor preset.
      width, height: pixels.

    Raises:
      CaperError: unknown noise preset.
    """
    sensor = _sensor(noise)
    depth, parts, intrinsics, pose = _render(key, instance, sensor, category, width, height)
    pose = jax.tree.map(np.asarray, pose)
    return Image(np.asarray(depth), np.asarray(parts), np.asarray(intrinsics, np.float64), pose)


def render_pose(
    key,
    instance: InstanceBank,
    state,
    poses,
    category: Category,
    noise: str,
    intrinsics: np.ndarray,
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
    depth, parts = _look(
        key, instance, poses, _sensor(noise), camera, category, width=width, height=height
    )
    pose = jax.tree.map(np.asarray, _pose(instance, state, poses))
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
    center = jnp.array([width, height]) / 2 + jax.random.uniform(
        keys[2], (2,), minval=-0.01, maxval=0.01
    ) * jnp.array([width, height])
    intrinsics = jnp.array([[focal, 0.0, center[0]], [0.0, focal, center[1]], [0.0, 0.0, 1.0]])
    depth, parts = _look(
        keys[3], instance, poses, sensor, intrinsics, category, width=width, height=height
    )
    return depth, parts, intrinsics, _pose(instance, state, poses)


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
    surface = sensors.surface(depth, hit, (x, y))
    noise_key, loss_key = jax.random.split(key)
    seen = sensors.lose(loss_key, sensor, surface, hit)
    measured = sensors.measure(noise_key, sensor, surface, (x, y))[..., 2]
    return jnp.where(seen, measured, 0.0), jnp.where(seen, parts, -1)


def _pose(instance: InstanceBank, state, poses) -> ArticulatedPose:
    return ArticulatedPose(
        rotation=poses[:, :3, :3],
        translation=poses[:, :3, 3],
        size=instance.size,
        box_center=instance.box_center,
        joint_axis=instance.joint_axis,
        joint_pivot=instance.joint_pivot,
        joint_state=state,
    )


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
