"""Shuffled batches of a labeled dataset, as a function of the step: exact resumes, no state."""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import numpy as np

from caper_jax.data.clouds import MIN_POINTS, systematic_indices
from caper_jax.data.types import Batch, Dataset, Frame, pose_problems
from caper_jax.errors import CaperError
from caper_jax.geometry.raster_order import raster_order


class Loader:
    """Batches by step: ``loader(step)`` is the same at any time, on any number of processes.

    An epoch is a permutation that follows from the seed and the epoch's number; batches run on over
    the end of one into the next, so every frame is seen equally often. Each process of a
    distributed run reads its own rows of the global batch only. Frames that show fewer than 16
    points are passed over for the next one in the permutation.

    Example:
      with Loader(dataset, batch_size=16) as loader:
          fit(..., batches=loader)
    """

    def __init__(
        self,
        dataset: Dataset,
        batch_size: int,
        num_points: int = 1024,
        seed: int = 0,
        *,
        process: tuple[int, int] | None = None,
        workers: int = 2,
        prefetch: int = 4,
        cache_gib: float = 2.0,
    ) -> None:
        """Sets the threads up; nothing is read yet.

        Args:
          dataset: labeled frames; several threads read from it.
          batch_size: B, rows of the global batch.
          num_points: N.
          seed: of the order and of the choice of points.
          process: (index, count) of this process; by default JAX's.
          workers: threads that read ahead.
          prefetch: batches to keep ready beyond the requested one; 0 reads on request.
          cache_gib: frames that were read stay in memory up to so many GiB.

        Raises:
          CaperError: no frames, or a batch that the processes cannot share evenly.
        """
        index, count = process or (jax.process_index(), jax.process_count())
        if not len(dataset):
            raise CaperError(f"the {dataset.format} data hold no frame of {dataset.category.name}")
        if batch_size % count:
            raise CaperError(f"batch_size {batch_size} cannot be split over {count} processes")
        self.dataset = dataset
        self.batch_size = batch_size
        self._rows = range(index * batch_size // count, (index + 1) * batch_size // count)
        self._num_points = num_points
        self._seed = seed
        self._prefetch = prefetch
        self._orders: dict[int, np.ndarray] = {}
        self._cache: dict[int, Batch | None] = {}
        self._free_bytes = int(cache_gib * 2**30)
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="loader")
        self._ahead: dict[int, Future[Batch]] = {}

    def __enter__(self) -> Loader:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the threads; batches that nobody requested are dropped."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __call__(self, step: int) -> Batch:
        """This process's rows of the batch of a step, [B / processes, ...].

        Raises:
          CaperError: a frame is broken or has no ground truth; names it.
        """
        wanted = self._ahead.pop(step, None) or self._pool.submit(self._batch, step)
        # A jump, as after a resume, leaves batches behind that nobody will request.
        self._ahead = {s: batch for s, batch in self._ahead.items() if s > step}
        for later in range(step + 1, step + 1 + self._prefetch):
            if later not in self._ahead:
                self._ahead[later] = self._pool.submit(self._batch, later)
        return wanted.result()

    def frame_indices(self, step: int) -> list[int]:
        """Frames of this process's rows, before any is passed over."""
        return [self._place(step * self.batch_size + row)[0] for row in self._rows]

    def _place(self, position: int) -> tuple[int, int, int]:
        """(frame, epoch, rank in the epoch's order) at a position of the endless sequence."""
        epoch, rank = divmod(position, len(self.dataset))
        with self._lock:
            if epoch not in self._orders:
                rng = np.random.default_rng([self._seed, epoch])
                # Two epochs overlap in a batch; older ones are done with.
                self._orders = {e: o for e, o in self._orders.items() if abs(e - epoch) < 2}
                self._orders[epoch] = rng.permutation(len(self.dataset))
            return int(self._orders[epoch][rank]), epoch, rank

    def _batch(self, step: int) -> Batch:
        rows = [self._row(step * self.batch_size + row) for row in self._rows]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)

    def _row(self, position: int) -> Batch:
        count = len(self.dataset)
        for skipped in range(count):
            index, epoch, rank = self._place(position + skipped)
            frame = self._frame(index)
            if frame is not None:
                break
        else:
            raise CaperError(
                f"no frame of the {self.dataset.format} data shows {MIN_POINTS} points of "
                f"{self.dataset.category.name}"
            )
        rng = np.random.default_rng([self._seed, epoch, rank])
        picked = systematic_indices(len(frame.points), self._num_points, int(rng.integers(2**31)))
        return Batch(frame.points[picked], frame.labels[picked], frame.pose)

    def _frame(self, index: int) -> Batch | None:
        """All points of a frame, or None if it shows too little; read once where memory allows."""
        try:
            return self._cache[index]
        except KeyError:
            pass
        frame = _ready(self.dataset[index], self.dataset)
        size = sum(leaf.nbytes + 128 for leaf in jax.tree.leaves(frame))
        with self._lock:
            if index not in self._cache and size <= self._free_bytes:
                self._cache[index] = frame
                self._free_bytes -= size
        return frame


def _ready(frame: Frame, dataset: Dataset) -> Batch | None:
    """What training needs of a frame, checked, in scan order; None if it shows too little."""
    where = f"frame {frame.name!r} of {dataset.category.name}"
    if frame.truth is None:
        raise CaperError(f"{where} has no ground truth to train on")
    # A file that was checked as a whole need not be checked again, frame by frame.
    checked = getattr(dataset, "checked", False)
    problems = [] if checked else pose_problems(frame.truth, dataset.category)
    if problems:
        raise CaperError(f"{where}: {'; '.join(problems)}")
    usable = np.isfinite(frame.points).all(-1)
    if usable.sum() < MIN_POINTS:
        return None
    labels = np.full(len(frame.points), -1) if frame.labels is None else frame.labels
    points, labels = frame.points[usable].astype(np.float32), labels[usable].astype(np.int32)
    order = raster_order(points)
    return Batch(
        points=points[order],
        labels=labels[order],
        pose=jax.tree.map(lambda array: np.asarray(array, np.float32), frame.truth),
    )
