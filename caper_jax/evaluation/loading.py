"""Labeled frames as batches of one shape, read and sampled ahead by threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float32

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.clouds import sample_points, shows_object
from caper_jax.data.types import Dataset, Frame, pose_problems, pose_shapes
from caper_jax.errors import CaperError

Tree = TypeVar("Tree")

_WORKERS = 2
_AHEAD = 3  # batches


@dataclass(frozen=True)
class FrameBatch:
    """B frames, of which the last are copies where the data have no more.

    Attributes:
      frames: B frames.
      count: how many of them are no copies.
      points: what a predictor sees, meters, camera frame.
      truth: arrays [B, K, ...], checked.
      shown: whether the frame shows enough to estimate anything.
      gravity: unit vectors, zeros where the data do not know it.
    """

    frames: Sequence[Frame]
    count: int
    points: Float32[np.ndarray, "B N 3"]
    truth: ArticulatedPose
    shown: Bool[np.ndarray, " B"]
    gravity: Float32[np.ndarray, "B 3"]


def frame_batches(
    dataset: Dataset, frames: int, batch_size: int, num_points: int
) -> Iterator[FrameBatch]:
    """The first frames of a dataset in order, while threads prepare the next batches.

    Args:
      dataset: labeled; several threads read from it.
      frames: how many.
      batch_size: B.
      num_points: N.

    Raises:
      CaperError: a frame without (or with broken) ground truth, or one that cannot be read; names
        it.
    """
    starts = deque(range(0, frames, batch_size))
    waiting: deque[Future[FrameBatch]] = deque()
    pool = ThreadPoolExecutor(_WORKERS, thread_name_prefix="evaluation")
    try:
        while starts or waiting:
            while starts and len(waiting) <= _AHEAD:
                start = starts.popleft()
                count = min(batch_size, frames - start)
                waiting.append(pool.submit(_read, dataset, start, count, batch_size, num_points))
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def cloud_of(frame: Frame, num_points: int) -> Float32[np.ndarray, "points 3"]:
    """[N, 3] points that a predictor sees; some cloud where the frame shows too little to use."""
    return _cloud(frame, num_points)[0]


def _cloud(frame: Frame, num_points: int) -> tuple[np.ndarray, bool]:
    """Points of a frame, and whether it shows enough for them to be the object's."""
    if not shows_object(np.asarray(frame.points, np.float32)):
        some = np.linspace((-0.1, -0.1, 0.9), (0.1, 0.1, 1.1), num_points, dtype=np.float32)
        return some, False
    return sample_points(frame.points, num_points, where=frame.name).points, True


def _read(dataset: Dataset, start: int, count: int, batch_size: int, num_points: int) -> FrameBatch:
    frames = [dataset[index] for index in range(start, start + count)]
    truths = [_truth(frame, dataset.category) for frame in frames]
    clouds, shown = zip(*(_cloud(frame, num_points) for frame in frames), strict=True)
    padding = batch_size - count
    truth = stack([*truths, *[truths[-1]] * padding])
    # A file that was checked as a whole need not be checked again; a batch is checked faster than
    # its frames, which are looked at to name the one that is wrong.
    if not getattr(dataset, "checked", False) and pose_problems(truth, dataset.category):
        for frame, one in zip(frames, truths, strict=True):
            if problems := pose_problems(one, dataset.category):
                raise CaperError(f"ground truth of frame {frame.name!r}: {'; '.join(problems)}")
    known = [np.zeros(3) if frame.gravity is None else frame.gravity for frame in frames]
    return FrameBatch(
        frames=[*frames, *[frames[-1]] * padding],
        count=count,
        points=np.stack([*clouds, *[clouds[-1]] * padding]),
        truth=truth,
        shown=np.array([*shown, *[shown[-1]] * padding]),
        gravity=np.asarray([*known, *[known[-1]] * padding], np.float32),
    )


def _truth(frame: Frame, category: Category) -> ArticulatedPose:
    """The pose of a frame, of the right shapes, so that it can be stacked."""
    if frame.truth is None:
        raise CaperError(f"frame {frame.name!r} has no ground truth to evaluate against")
    for key, shape in pose_shapes(category.num_parts).items():
        if np.shape(getattr(frame.truth, key)) != shape:
            problems = pose_problems(frame.truth, category)
            raise CaperError(f"ground truth of frame {frame.name!r}: {'; '.join(problems)}")
    return jax.tree.map(np.asarray, frame.truth)


def stack(trees: Sequence[Tree]) -> Tree:
    """Poses or results of frames as one, with a leading axis of frames; numpy arrays."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)
