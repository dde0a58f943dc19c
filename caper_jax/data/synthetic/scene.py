"""Endless labelled frames from a key: instance, joint states, camera, rays, sensor, points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category, Viewpoint
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.synthetic import sensor as sensors
from caper_jax.data.synthetic.bank import Bank, build_bank, draw_models
from caper_jax.data.synthetic.caster import cast, projected_bounds
from caper_jax.errors import CaperError


@dataclass(frozen=True)
class GeneratorConfig:
    """What the generated frames look like.

    Attributes:
      instances: shapes in the bank.
      grid: rays per side over the object's projected box.
      num_points: points per frame.
      noise: sensor presets, one drawn per frame (none, gauss3mm, kinect, realsense).
      occlusion: fraction of frames with a part of the object cut off by something in front.
      residue: largest fraction of points that belong to something behind the object, as left in
        by a mask that is too wide; each frame draws its own fraction up to it.
    """

    instances: int = 2000
    grid: int = 96
    num_points: int = 1024
    noise: tuple[str, ...] = ("kinect",)
    occlusion: float = 0.0
    residue: float = 0.0

    def __post_init__(self) -> None:
        for name, low in (("instances", 1), ("grid", 8), ("num_points", 16)):
            if getattr(self, name) < low:
                raise CaperError(f"data.{name} must be at least {low}, got {getattr(self, name)}")
        for name in ("occlusion", "residue"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise CaperError(f"data.{name} is a fraction from 0 to 1")
        if not self.noise:
            raise CaperError("data.noise needs at least one preset; use ['none'] for clean depth")


@flax.struct.dataclass
class Batch:
    """Labelled frames.

    Attributes:
      points: [B, N, 3] metres, camera frame, in raster order.
      labels: [B, N] int32 part of each point, -1 for residue.
      pose: ArticulatedPose with leading axis B.
      visible: [B, K] int32 pixels of each part in the ray grid, before sampling.
      instance: [B] int32 index into the bank.
    """

    points: Any
    labels: Any
    pose: ArticulatedPose
    visible: Any
    instance: Any


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


def _draw_camera(key, view: Viewpoint, diagonal):
    """World (root canonical) -> camera [4, 4], as conventions ask: see Viewpoint."""
    # One draw for all: every call of jax.random costs compile time.
    uniform = jax.random.uniform(key, (10,))
    low = jnp.radians(jnp.array([view.azimuth[0], view.elevation[0], -view.roll]))
    high = jnp.radians(jnp.array([view.azimuth[1], view.elevation[1], view.roll]))
    azimuth, elevation, roll = low + uniform[:3] * (high - low)
    # Uniform in log distance: relative, as perspective is.
    nearest, farthest = np.log(view.distance)
    distance = diagonal * jnp.exp(nearest + uniform[3] * (farthest - nearest))
    level, height = jnp.cos(elevation), jnp.sin(elevation)
    around = jnp.array([jnp.sin(azimuth) * level, height, jnp.cos(azimuth) * level])
    # Canonical axes (x, y, z) cycle so that `up` comes second.
    shift = {"y": 0, "z": 1, "x": -1}[view.up]
    eye = jnp.roll(around, shift) * distance
    up = jnp.zeros(3).at["xyz".index(view.up)].set(1.0)
    target = (uniform[4:7] - 0.5) * 0.1 * diagonal
    camera = _look_at(eye, target, up, roll)
    # The object stands anywhere in the image: turn the camera away from it, keeping its place.
    # 0.55 and 0.35 are the half widths of a 58 x 39 deg field of view at z = 1; wide cameras
    # reach 1.2 times that.
    aside = (2.0 * uniform[7:9] - 1.0) * jnp.array([0.55, 0.35]) * 1.2 * uniform[9]
    # Keep the whole object in front of the camera at close range.
    aside *= jnp.minimum(1.0, distance / (3.0 * diagonal))
    return jnp.matmul(_aside(aside), camera, precision="highest")


def _aside(offset):
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


def _systematic(key, hit, count: int):
    """Indices [count] of hits, evenly spread in raster order, repeating when there are too few.

    The r-th pick is hit number floor((r + u) n / count): no sort, uniform over the image.
    """
    running = jnp.cumsum(hit)
    total = running[-1]
    offset = jax.random.uniform(key, (count,))
    rank = jnp.floor((jnp.arange(count) + offset) * total / count).astype(jnp.int32) + 1
    return jnp.clip(jnp.searchsorted(running, rank, side="left"), 0, hit.shape[0] - 1)


def _occluder(key, probability: float, grid: int):
    """[grid, grid] bool, False where something in front hides the object."""
    uniform = jax.random.uniform(key, (3,))
    angle, edge = 2 * jnp.pi * uniform[0], 0.1 + 0.8 * uniform[1]
    axis = jnp.linspace(-1.0, 1.0, grid)
    side = jnp.cos(angle) * axis[None, :] + jnp.sin(angle) * axis[:, None]
    return (side < edge) | (uniform[2] >= probability)


def draw_state_and_poses(key, instance: Bank, category: Category):
    """Joint states over the instance's range, and a camera around it.

    Returns:
      state [J], part poses [K, 4, 4] rest frame -> camera, and the diagonal at rest, metres.
    """
    state_key, camera_key = jax.random.split(key)
    low, high = instance.limits[:, 0], instance.limits[:, 1]
    state = low + jax.random.uniform(state_key, low.shape) * (high - low)
    box_low = (instance.box_center - instance.size / 2).min(0)
    box_high = (instance.box_center + instance.size / 2).max(0)
    diagonal = jnp.linalg.norm(box_high - box_low)
    poses = forward_kinematics(
        _draw_camera(camera_key, category.viewpoint, diagonal),
        instance.joint_axis,
        instance.joint_pivot,
        state,
        category.joint_types,
        category.parents,
    )
    return state, poses, diagonal


def render_frame(key, instance: Bank, category: Category, config: GeneratorConfig, mix):
    """One labelled frame of one instance (Bank without its leading axis); see ``Batch``."""
    keys = jax.random.split(key, 8)
    state, poses, diagonal = draw_state_and_poses(keys[0], instance, category)

    low2, high2 = projected_bounds(instance.groups, poses)
    steps = jnp.arange(config.grid) + 0.0
    offset = jax.random.uniform(keys[1], (2,))
    x = low2[0] + (steps + offset[0]) / config.grid * (high2[0] - low2[0])
    y = low2[1] + (steps + offset[1]) / config.grid * (high2[1] - low2[1])
    x, y = jnp.meshgrid(x, y, indexing="xy")
    depth, part = cast(instance.groups, poses, (x.ravel(), y.ravel()))
    depth, part = depth.reshape(x.shape), part.reshape(x.shape)
    hit = part >= 0
    if config.occlusion > 0:
        kept = hit & _occluder(keys[2], config.occlusion, config.grid)
        hit = jnp.where(kept.sum() > 0.3 * hit.sum(), kept, hit)
    sensor = sensors.draw(keys[3], mix)
    surface = sensors.surface(depth, hit, (x, y))
    seen = sensors.lose(keys[4], sensor, surface, hit)
    seen = jnp.where(seen.any(), seen, hit)

    # Only the chosen pixels are measured: random numbers are what costs on a CPU.
    index = _systematic(keys[5], seen.ravel(), config.num_points)
    chosen = jax.tree.map(lambda image: image.ravel()[index], surface)
    points = sensors.measure(keys[6], sensor, chosen, (x.ravel()[index], y.ravel()[index]))
    labels = part.ravel()[index]
    if config.residue > 0:
        points, labels = _add_residue(keys[7], points, labels, diagonal, config.residue)
    visible = jnp.stack([(hit & (part == k)).sum() for k in range(category.num_parts)])
    pose = ArticulatedPose(
        rotation=poses[:, :3, :3],
        translation=poses[:, :3, 3],
        size=instance.size,
        box_center=instance.box_center,
        joint_axis=instance.joint_axis,
        joint_pivot=instance.joint_pivot,
        joint_state=state,
    )
    return points, labels, pose, visible


def _add_residue(key, points, labels, diagonal, largest: float):
    """Pushes a few points along their rays, as pixels that see past the object."""
    count = labels.shape[0]
    uniform = jax.random.uniform(key, (2 * count + 1,), minval=1e-7)
    chosen = uniform[:count] < uniform[-1] * largest
    push = -jnp.log(uniform[count:-1]) * 0.2 * diagonal
    factor = 1.0 + jnp.where(chosen, push / jnp.linalg.norm(points, axis=-1), 0.0)
    return points * factor[:, None], jnp.where(chosen, -1, labels)


class Generator:
    """Draws labelled batches of one category; the bank lives on the default device.

    Example:
      generator = Generator(categories.get("box"), GeneratorConfig(noise=("kinect",)))
      batch = generator.batch(jax.random.key(0), 24)   # points [24, 1024, 3]
    """

    def __init__(
        self,
        category: Category,
        config: GeneratorConfig | None = None,
        split: str = "train",
        seed: int = 0,
    ) -> None:
        self.category = category
        self.config = config or GeneratorConfig()
        self.split = split
        self.seed = seed
        models = draw_models(category, self.config.instances, split, seed)
        self.bank = jax.tree.map(jnp.asarray, build_bank(models))
        self._mix = sensors.sensor_mix(self.config.noise)
        self._batch = jax.jit(partial(self.draw, bank=self.bank), static_argnames="batch_size")

    def draw(self, key, batch_size: int, bank: Bank | None = None) -> Batch:
        """Traceable form of ``batch``: call it inside a larger jitted function."""
        bank = self.bank if bank is None else bank
        pick, rest = jax.random.split(key)
        index = jax.random.randint(pick, (batch_size,), 0, bank.num_instances)
        instances = jax.tree.map(lambda values: values[index], bank)
        frame = partial(render_frame, category=self.category, config=self.config, mix=self._mix)
        points, labels, pose, visible = jax.vmap(frame)(
            jax.random.split(rest, batch_size), instances
        )
        return Batch(points, labels, pose, visible, index)

    def batch(self, key, batch_size: int) -> Batch:
        """A batch of frames; the same key gives the same batch.

        Args:
          key: PRNG key.
          batch_size: B.
        """
        return self._batch(key, batch_size)
