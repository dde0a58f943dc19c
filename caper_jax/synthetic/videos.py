"""Endless labeled videos: one instance whose joints, and perhaps the camera, move.

The protocol of PM-Videos (paper Sec. 6.1.1), two harder ones, and one in which nothing moves; every
frame is drawn by ``frames``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from caper_jax.articulation.category import Category
from caper_jax.config import GeneratorConfig
from caper_jax.data.types import Batch
from caper_jax.errors import CaperError, unknown_name
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.synthetic import sensor as sensors
from caper_jax.synthetic.camera import camera_arc, camera_pose, draw_camera
from caper_jax.synthetic.frames import FrameKeys, collect, observe, part_poses
from caper_jax.synthetic.instances import InstanceBank, build_bank, draw_instances, split_key

FRAMES = 30


class VideoMode(NamedTuple):
    """How a video moves; traced, so that one compiled program serves all modes.

    Attributes:
      camera_speed: of the camera's arc, see ``camera.camera_arc``; 0 for a static camera.
      reverses: whether the joints turn round in the middle of the clip and go back.
      still: whether the joints stay where they are.
    """

    camera_speed: float | Float[Array, ""]
    reverses: bool | Bool[Array, ""]
    still: bool | Bool[Array, ""] = False


MODES = {
    "paper": VideoMode(camera_speed=0.0, reverses=False),
    "cam": VideoMode(camera_speed=1.0, reverses=False),
    "hard": VideoMode(camera_speed=2.0, reverses=True),
    "still": VideoMode(camera_speed=0.0, reverses=False, still=True),
}


def video(
    key: PRNGKeyArray,
    instance: InstanceBank,
    category: Category,
    config: GeneratorConfig,
    mode: str = "paper",
    frames: int = FRAMES,
) -> Batch:
    """One video of one instance.

    All joints move at once, each from U(0, 0.35) to U(0.65, 1) of its range by unequal steps that
    all go up; mode "hard" comes back from there. The sensor, what hides the object and how wrong
    the mask is are drawn once; noise, ray grid and sampling are fresh in every frame.

    Args:
      key: PRNG key.
      instance: InstanceBank without its leading axis.
      category: its category.
      config: what the frames look like.
      mode: of ``MODES``: "paper" static camera, "cam" a camera on a smooth arc, "hard" twice its
        speed and joints that reverse, "still" nothing moves (each joint anywhere on the way that
        it would go in "paper").
      frames: T.

    Returns:
      Batch with leading axis T; ``instance`` is None.

    Raises:
      CaperError: unknown mode, or less than two frames.
    """
    return _video(key, instance, _motion(mode, frames), category, config, frames)


def check_length(frames: int) -> None:
    """Refuses a video in which nothing could move.

    Raises:
      CaperError: less than two frames.
    """
    if frames < 2:
        raise CaperError(f"a video needs at least 2 frames, got {frames}")


def _motion(mode: str, frames: int) -> VideoMode:
    """A mode as arrays."""
    if mode not in MODES:
        raise unknown_name("video mode", mode, MODES)
    check_length(frames)
    speed, reverses, still = MODES[mode]
    return VideoMode(jnp.float32(speed), jnp.asarray(reverses), jnp.asarray(still))


@partial(jax.jit, static_argnames=("category", "config", "frames"))
def _video(
    key,
    instance: InstanceBank,
    motion: VideoMode,
    category: Category,
    config: GeneratorConfig,
    frames: int,
) -> Batch:
    state_key, camera_key, arc_key, shared_key, frame_key = jax.random.split(key, 5)
    view, diagonal = category.viewpoint, rest_diagonal(instance.size, instance.box_center)
    states = _states(state_key, instance.limits, motion, frames)
    cameras = camera_arc(arc_key, draw_camera(camera_key, view), view, frames, motion.camera_speed)
    shared = FrameKeys(*jax.random.split(shared_key, len(FrameKeys._fields)))
    mix = sensors.sensor_mix(config.noise)

    def frame(inputs):
        key, state, camera = inputs
        poses = part_poses(camera_pose(camera, view, diagonal), instance, state, category)
        fresh = FrameKeys(*jax.random.split(key, len(FrameKeys._fields)))
        keys = fresh._replace(mask=shared.mask, sensor=shared.sensor)
        return observe(keys, instance, state, poses, category, config, mix)

    # One frame after the other: memory does not grow with the images of all frames.
    return jax.lax.map(frame, (jax.random.split(frame_key, frames), states, cameras))


@partial(jax.jit, static_argnames=("category", "config", "frames", "videos"))
def _batch(
    key,
    bank: InstanceBank,
    motion: VideoMode,
    category: Category,
    config: GeneratorConfig,
    frames: int,
    videos: int,
) -> Batch:
    pick, rest = jax.random.split(key)
    index = jax.random.randint(pick, (videos,), 0, bank.num_instances)
    instances = jax.tree.map(lambda values: values[index], bank)

    def one(key, instance):
        return _video(key, instance, motion, category, config, frames)

    batch = jax.vmap(one)(jax.random.split(rest, videos), instances)
    return replace(batch, instance=jnp.broadcast_to(index[:, None], (videos, frames)))


def _states(key, limits, motion: VideoMode, frames: int):
    """Joint states [T, J] of a clip from the limits [J, 2]."""
    joints = limits.shape[0]
    uniform = jax.random.uniform(key, (frames + 3, joints))
    first, last, turn, steps = uniform[0], uniform[1], uniform[2], 0.5 + uniform[3:]
    passed = jnp.cumsum(steps, axis=0)
    share = (passed - passed[:1]) / (passed[-1:] - passed[:1])  # from 0 to 1
    share = jnp.where(motion.still, turn, share)
    # There and back: up to the turn, drawn for each joint around the middle, then down again.
    turn = 0.4 + 0.2 * turn
    there_and_back = jnp.minimum(share / turn, (1.0 - share) / (1.0 - turn))
    share = jnp.where(motion.reverses, there_and_back, share)
    share = 0.35 * first + share * (0.65 + 0.35 * last - 0.35 * first)
    return limits[:, 0] + share * (limits[:, 1] - limits[:, 0])


class VideoGenerator:
    """Draws labeled videos of one category; the bank lives on the default device.

    Example:
      generator = VideoGenerator(categories.get("laptop"), mode="cam")
      videos = generator.batch(jax.random.key(0), 8)   # points [8, 30, 1024, 3]
    """

    def __init__(
        self,
        category: Category,
        config: GeneratorConfig | None = None,
        mode: str = "paper",
        frames: int = FRAMES,
        split: str = "train",
        seed: int = 0,
    ) -> None:
        """Builds the bank.

        Args:
          category: what the videos show.
          config: what the frames look like.
          mode: of ``MODES``.
          frames: T, per video.
          split: train, val or test; splits share no instance.
          seed: of the bank.

        Raises:
          CaperError: unknown mode or split, less than two frames, a category without shapes.
        """
        self._motion = _motion(mode, frames)
        self.category = category
        self.config = config or GeneratorConfig()
        self.mode = mode
        self.frames = frames
        self.split = split
        models = draw_instances(category, self.config.instances, split, seed)
        self.bank = jax.tree.map(jnp.asarray, build_bank(models))

    def batch(self, key: PRNGKeyArray, videos: int) -> Batch:
        """Videos of instances of the bank; the same key gives the same videos.

        Args:
          key: PRNG key.
          videos: V.

        Returns:
          Batch with leading axes [V, T] everywhere.
        """
        settings = (self.category, self.config, self.frames)
        return _batch(key, self.bank, self._motion, *settings, videos)


def collect_videos(
    generator: VideoGenerator, seed: int, videos: int, size: int, title: str = "generating"
) -> dict[str, Any]:
    """Videos one after the other, as the arguments of ``hdf5.write`` that they decide.

    Args:
      generator: draws them, of its split.
      seed: of the split's key, see ``split_key``.
      size, title: see ``collect``.
      videos: V.
    """
    batch = collect(generator.batch, split_key(generator.split, seed), videos, size, title)
    batch = jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:]), batch)
    video, frame = np.divmod(np.arange(len(batch.points)), generator.frames)
    names = [f"{v:05d}/{f:06d}" for v, f in zip(video, frame, strict=True)]
    return {**vars(batch), "names": names, "video": video, "frame": frame}
