"""Many generated frames or videos, drawn a few at a time, as arrays for a file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from caper_jax.data.types import Batch
from caper_jax.progress import progress
from caper_jax.synthetic.frames import Generator
from caper_jax.synthetic.instances import split_key
from caper_jax.synthetic.videos import VideoGenerator

FRAMES_AT_A_TIME = 25  # what the frames of a seed are depends on it


def collect(
    draw: Callable[[Any, int], Batch], key: Any, total: int, size: int, title: str = "generating"
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
