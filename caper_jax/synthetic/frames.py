"""Endless labeled frames from a key: instance, joint states, camera, rays, sensor, points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from caper_jax.articulation.category import Category
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import GeneratorConfig
from caper_jax.data.types import Batch
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.geometry.raster_order import grid_raster_order
from caper_jax.progress import progress
from caper_jax.synthetic import disturbances, masks
from caper_jax.synthetic import sensor as sensors
from caper_jax.synthetic.camera import camera_pose, draw_camera
from caper_jax.synthetic.instances import InstanceBank, build_bank, draw_instances, split_key
from caper_jax.synthetic.masks import is_on
from caper_jax.synthetic.ray_casting import FAR, nearest_part, part_depths, projected_bounds

FRAMES_AT_A_TIME = 25  # what the frames of a seed are depends on it
_MARGIN = 0.04  # of the object's projected box, on each side
_WIDE_MARGIN = 0.1  # holds a rim of 8 % of the grid's side, which has both margins in it


def systematic_sample(key: PRNGKeyArray, hit: Bool[Array, "G G"], count: int) -> Int[Array, " N"]:
    """Raster indices [count] of hits [G, G], evenly spread in scan order; repeating if too few.

    The r-th pick is hit number floor((r + u) n / count): no sort, uniform over the image.
    """
    order = jnp.asarray(grid_raster_order(hit.shape[0]), jnp.int32)
    running = jnp.cumsum(hit.ravel()[order])
    total = running[-1]
    offset = jax.random.uniform(key, (count,))
    rank = jnp.floor((jnp.arange(count) + offset) * total / count).astype(jnp.int32) + 1
    # In float32, r + u may be rounded up to count: that would be one hit too many.
    rank = jnp.minimum(rank, total)
    place = jnp.clip(jnp.searchsorted(running, rank, side="left"), 0, order.shape[0] - 1)
    return order[place]


def draw_state_and_poses(
    key: PRNGKeyArray, instance: InstanceBank, category: Category
) -> tuple[Float[Array, " J"], Float[Array, "K 4 4"], Float[Any, ""]]:
    """Joint states over the instance's range, and a camera around it.

    Returns:
      state [J], part poses [K, 4, 4] rest frame -> camera, and the diagonal at rest, meters.
    """
    state_key, camera_key = jax.random.split(key)
    low, high = instance.limits[:, 0], instance.limits[:, 1]
    state = low + jax.random.uniform(state_key, low.shape) * (high - low)
    diagonal = rest_diagonal(instance.size, instance.box_center)
    view = category.viewpoint
    root = camera_pose(draw_camera(camera_key, view), view, diagonal)
    return state, part_poses(root, instance, state, category), diagonal


def part_poses(
    root: Float[Any, "*batch 4 4"],
    instance: InstanceBank,
    state: Float[Any, "*states J"],
    category: Category,
) -> Float[Array, "*states K 4 4"]:
    """Poses [..., K, 4, 4] of all parts from the root's [..., 4, 4] and the states [..., J]."""
    return forward_kinematics(
        root,
        instance.joint_axis,
        instance.joint_pivot,
        state,
        category.joint_types,
        category.parents,
    )


def articulated_pose(
    instance: InstanceBank, state: Float[Any, "*batch J"], poses: Float[Any, "*batch K 4 4"]
) -> ArticulatedPose:
    """Ground truth of instances in given states and poses of their parts."""
    return ArticulatedPose(
        rotation=poses[..., :3, :3],
        translation=poses[..., :3, 3],
        size=instance.size,
        box_center=instance.box_center,
        joint_axis=instance.joint_axis,
        joint_pivot=instance.joint_pivot,
        joint_state=state,
    )


class FrameKeys(NamedTuple):
    """PRNG keys of a frame; a video keeps some of them from frame to frame."""

    scene: PRNGKeyArray
    grid: PRNGKeyArray
    mask: PRNGKeyArray
    sensor: PRNGKeyArray
    loss: PRNGKeyArray
    pick: PRNGKeyArray
    noise: PRNGKeyArray
    residue: PRNGKeyArray


def render_frame(
    key: PRNGKeyArray,
    instance: InstanceBank,
    category: Category,
    config: GeneratorConfig,
    mix: sensors.Sensor,
) -> Batch:
    """One labeled frame of one instance (InstanceBank without its leading axis).

    Returns:
      Batch without its leading axis; ``instance`` is None.
    """
    keys = FrameKeys(*jax.random.split(key, 8))
    state, poses, _ = draw_state_and_poses(keys.scene, instance, category)
    return observe(keys, instance, state, poses, category, config, mix)


def observe(
    keys: FrameKeys,
    instance: InstanceBank,
    state: Float[Any, " J"],
    poses: Float[Any, "K 4 4"],
    category: Category,
    config: GeneratorConfig,
    mix: sensors.Sensor,
) -> Batch:
    """What a depth camera and a mask show of one instance in a given pose.

    Args:
      keys: PRNG keys (``scene`` is not used).
      instance: InstanceBank without its leading axis.
      state: [J] joint states.
      poses: [K, 4, 4] part rest frame -> camera.
      category: the instance's category.
      config: what disturbs the frame.
      mix: sensors to draw from, ``sensor.sensor_mix(config.noise)``.

    Returns:
      Batch without its leading axis; ``instance`` is None.
    """
    rays = _ray_grid(keys.grid, instance, poses, config)
    flat = (rays[0].ravel(), rays[1].ravel())
    alone = part_depths(instance.groups, poses, flat)
    depth, part = (image.reshape(rays[0].shape) for image in nearest_part(alone))
    diagonal = rest_diagonal(instance.size, instance.box_center)
    behind = None
    if is_on(config.rim) or is_on(config.hand) or is_on(config.cable) or is_on(config.flying):
        behind = disturbances.background(
            jax.random.fold_in(keys.mask, 16),
            instance,
            poses,
            category.viewpoint,
            diagonal,
            rays,
            is_on(config.rim),
        )
    depth, part, hit = _apply_mask(
        keys.mask, depth, part, behind, instance, poses, rays, category, config
    )
    visible = jnp.stack([(hit & (part == k)).sum() for k in range(category.num_parts)])
    visibility = None
    if config.measure_visibility:
        visibility = visible / jnp.maximum((alone < FAR).sum(axis=1), 1)

    sensor = sensors.draw_sensor(keys.sensor, mix)
    surface = sensors.surface_map(depth, hit, rays)
    seen = sensors.valid_pixels(keys.loss, sensor, surface, hit)
    if is_on(config.dropout) or is_on(config.holes):
        lost_key = jax.random.fold_in(keys.loss, 1)
        lost = masks.missing_depth(lost_key, hit, config.dropout, config.holes)
        seen = masks.keep_most(seen & ~lost, seen)
    seen = jnp.where(seen.any(), seen, hit)

    # Only the chosen pixels are measured: random numbers are what costs on a CPU.
    index = systematic_sample(keys.pick, seen, config.num_points)
    chosen = jax.tree.map(lambda image: image.ravel()[index], surface)
    points = sensors.measure(keys.noise, sensor, chosen, (flat[0][index], flat[1][index]))
    labels = part.ravel()[index]
    if is_on(config.flying):
        reach = disturbances.jump_reach(depth, behind, diagonal).ravel()[index]
        fly_key = jax.random.fold_in(keys.noise, 16)
        points, labels = disturbances.fly(fly_key, points, labels, reach, config.flying)
    if is_on(config.residue):
        points, labels = _add_residue(keys.residue, points, labels, diagonal, config.residue)
    points, labels = _add_stray(keys, points, labels, instance, poses, diagonal, config)
    if is_on(config.depth_scale):
        error = jax.random.normal(jax.random.fold_in(keys.sensor, 1))
        points *= 1.0 + config.depth_scale * jnp.clip(error, -3.0, 3.0)
    pose = articulated_pose(instance, state, poses)
    return Batch(points, labels, pose, visible, None, visibility)


def _add_stray(keys: FrameKeys, points, labels, instance, poses, diagonal, config):
    """Points and labels with speckle and specks, or fewer of them."""
    if is_on(config.speckle):
        key = jax.random.fold_in(keys.residue, 16)
        points, labels = disturbances.add_speckle(key, points, labels, diagonal, config.speckle)
    if is_on(config.specks):
        key = jax.random.fold_in(keys.residue, 17)
        center = disturbances.object_center(instance, poses)
        points, labels = disturbances.add_specks(
            key, points, labels, center, diagonal, config.specks
        )
    if is_on(config.few_points):
        key = jax.random.fold_in(keys.pick, 16)
        index = disturbances.thin_out(key, labels, len(poses), config.few_points)
        points, labels = points[index], labels[index]
    return points, labels


def _ray_grid(key, instance: InstanceBank, poses, config: GeneratorConfig):
    """Rays (x [G, G], y [G, G]) over the object's projection, with a random sub-pixel offset."""
    low, high = projected_bounds(instance.groups, poses)
    if is_on(config.table) or is_on(config.clutter) or is_on(config.rim):
        # Room for what a mask that is too wide takes in.
        margin = _WIDE_MARGIN if is_on(config.rim) else _MARGIN
        low, high = low - margin * (high - low), high + margin * (high - low)
    steps = jnp.arange(config.grid) + 0.0
    offset = jax.random.uniform(key, (2,))
    x = low[0] + (steps + offset[0]) / config.grid * (high[0] - low[0])
    y = low[1] + (steps + offset[1]) / config.grid * (high[1] - low[1])
    return jnp.meshgrid(x, y, indexing="xy")


def _apply_mask(
    key,
    depth,
    part,
    behind,
    instance: InstanceBank,
    poses,
    rays,
    category: Category,
    config: GeneratorConfig,
):
    """Depth, part and pixels [G, G] that the mask takes for the object."""
    hit = part >= 0
    if is_on(config.occlusion):
        hit = masks.occlude(key, hit, config.occlusion, config.occluders)
    scene = disturbances.Scene(depth, part, hit, behind)
    diagonal = rest_diagonal(instance.size, instance.box_center)
    if is_on(config.hand):
        center = disturbances.object_center(instance, poses)
        scene = disturbances.add_hand(
            jax.random.fold_in(key, 17), scene, center, diagonal, rays, config.hand
        )
    if is_on(config.cable):
        cable_key = jax.random.fold_in(key, 18)
        scene = disturbances.add_cable(cable_key, scene, diagonal, rays, config.cable)
    if is_on(config.rim):
        rim_key = jax.random.fold_in(key, 19)
        scene = disturbances.widen(rim_key, scene, config.rim, config.rim_range)
    depth, part, hit, _ = scene
    if is_on(config.table) or is_on(config.clutter):
        table = masks.table_depth(instance, poses, category.viewpoint, rays)
    if is_on(config.table):
        depth, hit = masks.spill_on_table(
            jax.random.fold_in(key, 3), depth, part, hit, table, config.table, config.spill
        )
    if is_on(config.erosion):
        erosion_key = jax.random.fold_in(key, 2)
        eroded = masks.erode(erosion_key, hit, config.erosion, config.erosion_range)
        # A mask that takes in the table is not too tight.
        hit = jnp.where((hit & (part < 0)).any(), hit, eroded)
    if is_on(config.clutter):
        depth, part, hit = masks.add_clutter(
            jax.random.fold_in(key, 4),
            depth,
            part,
            hit,
            table,
            diagonal,
            rays,
            config.clutter,
            config.spill,
        )
    return depth, part, hit


def _add_residue(key, points, labels, diagonal, largest: float):
    """Pushes a few points along their rays, as pixels that see past the object."""
    count = labels.shape[0]
    uniform = jax.random.uniform(key, (2 * count + 1,), minval=1e-7)
    chosen = uniform[:count] < uniform[-1] * largest
    push = -jnp.log(uniform[count:-1]) * 0.2 * diagonal
    factor = 1.0 + jnp.where(chosen, push / jnp.linalg.norm(points, axis=-1), 0.0)
    return points * factor[:, None], jnp.where(chosen, -1, labels)


def draw_frames(
    key: PRNGKeyArray,
    batch_size: int,
    category: Category,
    config: GeneratorConfig,
    mix: sensors.Sensor,
    bank: InstanceBank,
) -> Batch:
    """A batch of frames of instances of a bank: what ``Generator`` draws, as a pure function.

    Args:
      key: PRNG key.
      batch_size: B.
      category: static.
      config: what disturbs the frames; rates may be traced, and count as above 0 then.
      mix: sensors to draw from, ``sensor.sensor_mix(config.noise)``.
      bank: the instances.
    """
    pick, rest = jax.random.split(key)
    index = jax.random.randint(pick, (batch_size,), 0, bank.num_instances)
    instances = jax.tree.map(lambda values: values[index], bank)
    frame = partial(render_frame, category=category, config=config, mix=mix)
    frames = jax.vmap(frame)(jax.random.split(rest, batch_size), instances)
    return replace(frames, instance=index)


class Generator:
    """Draws labeled batches of one category; the bank lives on the default device.

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
        models = draw_instances(category, self.config.instances, split, seed)
        self.bank = jax.tree.map(jnp.asarray, build_bank(models))
        self._mix = sensors.sensor_mix(self.config.noise)
        # The bank is an argument: as a constant it would go through the compiler.
        self._batch = jax.jit(self.draw, static_argnames="batch_size")

    def draw(self, key: PRNGKeyArray, batch_size: int, bank: InstanceBank | None = None) -> Batch:
        """Traceable form of ``batch``: call it inside a larger jitted function."""
        bank = self.bank if bank is None else bank
        return draw_frames(key, batch_size, self.category, self.config, self._mix, bank)

    def batch(self, key: PRNGKeyArray, batch_size: int) -> Batch:
        """A batch of frames; the same key gives the same batch.

        Args:
          key: PRNG key.
          batch_size: B.
        """
        return self._batch(key, batch_size=batch_size, bank=self.bank)


def collect(
    draw: Callable[[PRNGKeyArray, int], Batch],
    key: PRNGKeyArray,
    total: int,
    size: int,
    title: str = "generating",
) -> Batch:
    """``total`` frames or videos as numpy arrays.

    Args:
      draw: (key, count) -> Batch, e.g. ``Generator.batch``.
      key: PRNG key, into which the number of each draw's first frame is folded.
      total: how many.
      size: drawn at a time; the same key and size give the same frames.
      title: of the progress display.
    """
    parts = []
    with progress(title, total=total) as bar:
        for start in range(0, total, size):
            count = min(size, total - start)
            batch = draw(jax.random.fold_in(key, start), size)
            parts.append(jax.tree.map(lambda array, n=count: np.asarray(array)[:n], batch))
            bar.update(count)
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def collect_frames(
    generator: Generator, seed: int, frames: int, title: str = "generating"
) -> dict[str, Any]:
    """Single frames as the arguments of ``hdf5.write`` that they decide.

    Args:
      generator: draws them, of its split.
      seed: of the split's key, see ``split_key``.
      title: see ``collect``.
      frames: how many.
    """
    key = split_key(generator.split, seed)
    batch = collect(generator.batch, key, frames, FRAMES_AT_A_TIME, title)
    prefix = f"{generator.category.name}_{generator.split}"
    names = [
        f"{prefix}{instance:04d}_{index:06d}"
        for index, instance in enumerate(np.asarray(batch.instance))
    ]
    return {**vars(batch), "names": names}
