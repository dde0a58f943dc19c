"""The loader: every frame once an epoch, the same batch for a step at any time, in any process."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import replace

import jax
import numpy as np
import pytest
from _helpers.frames import random_frames

from caper_jax import categories
from caper_jax.data.loader import Loader
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError

FRAMES, POINTS = 10, 64


class Frames:
    """A dataset in memory that counts its readings."""

    category = categories.get("box")
    format, split, mask_source = "memory", "train", "simulated"

    def __init__(self, change=lambda frame, index: frame):
        arrays = random_frames(FRAMES, POINTS)
        self.names = [f"{i}" for i in range(FRAMES)]
        self.readings: Counter[int] = Counter()
        self._lock = threading.Lock()
        self._frames = [
            change(
                Frame(
                    name=self.names[i],
                    points=arrays["points"][i],
                    labels=arrays["labels"][i].astype(np.int32),
                    truth=jax.tree.map(lambda leaf, i=i: leaf[i], arrays["pose"]),
                ),
                i,
            )
            for i in range(FRAMES)
        ]

    def __len__(self):
        return FRAMES

    def __getitem__(self, index):
        with self._lock:
            self.readings[index] += 1
        return self._frames[index]

    def index_of(self, translation):
        """The frame whose root stands at ``translation`` [3]."""
        roots = np.stack([frame.truth.translation[0] for frame in self._frames])
        return int(np.linalg.norm(roots - translation, axis=-1).argmin())


def frames_of(dataset, batch):
    return [dataset.index_of(root) for root in batch.pose.translation[:, 0]]


def assert_equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_every_frame_comes_once_an_epoch_in_a_new_order():
    dataset = Frames()
    with Loader(dataset, 4, 16, process=(0, 1)) as loader:
        seen = [index for step in range(10) for index in frames_of(dataset, loader(step))]
    epochs = [seen[start : start + FRAMES] for start in range(0, 40, FRAMES)]
    assert all(sorted(epoch) == list(range(FRAMES)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4


def test_a_batch_holds_points_of_its_frames():
    dataset = Frames()
    with Loader(dataset, 3, 64, process=(0, 1)) as loader:
        batch = loader(0)
    assert batch.points.shape == (3, 64, 3) and batch.points.dtype == np.float32
    assert batch.labels.shape == (3, 64) and batch.labels.dtype == np.int32
    for points, labels, index in zip(
        batch.points, batch.labels, frames_of(dataset, batch), strict=True
    ):
        source = dataset._frames[index]
        distance = np.abs(points[:, None] - source.points[None]).max(-1)
        assert distance.min(1).max() == 0
        np.testing.assert_array_equal(labels, source.labels[distance.argmin(1)])
        assert len(set(distance.argmin(1))) == POINTS  # 64 of 40: all, some of them twice


def test_a_resumed_run_sees_the_batches_it_would_have_seen():
    with Loader(Frames(), 4, 16, process=(0, 1)) as loader:
        straight = [loader(step) for step in range(9)]
    with Loader(Frames(), 4, 16, process=(0, 1), prefetch=0, cache_gib=0) as loader:
        for step in (7, 8, 2, 3, 0):  # and in any order
            assert_equal(loader(step), straight[step])
    with Loader(Frames(), 4, 16, seed=1, process=(0, 1)) as loader:
        assert not np.array_equal(loader(0).points, straight[0].points)


def test_points_are_picked_anew_in_every_epoch():
    dataset = Frames()
    with Loader(dataset, FRAMES, 16, process=(0, 1)) as loader:
        first, second = loader(0), loader(1)
    one, other = frames_of(dataset, first).index(3), frames_of(dataset, second).index(3)
    assert not np.array_equal(first.points[one], second.points[other])


def test_processes_share_the_batch_without_reading_each_others_frames():
    whole = Loader(Frames(), 6, 16, process=(0, 1))
    datasets = [Frames() for _ in range(3)]
    shares = [
        Loader(dataset, 6, 16, process=(index, 3), prefetch=0)
        for index, dataset in enumerate(datasets)
    ]
    for step in range(3):
        rows = [share(step) for share in shares]
        assert_equal(jax.tree.map(lambda *parts: np.concatenate(parts), *rows), whole(step))
    assert all(sum(dataset.readings.values()) <= 6 for dataset in datasets)
    for loader in (whole, *shares):
        loader.close()


@pytest.mark.parametrize(("cache_gib", "readings"), [(1.0, FRAMES), (0.0, 40)])
def test_frames_are_read_once_where_memory_allows(cache_gib, readings):
    dataset = Frames()
    with Loader(dataset, 4, 16, process=(0, 1), workers=1, prefetch=0, cache_gib=cache_gib) as load:
        for step in range(10):
            load(step)
    assert sum(dataset.readings.values()) == readings


def test_frames_that_show_too_little_are_passed_over():
    dataset = Frames(lambda frame, i: replace(frame, points=frame.points[:3]) if i % 2 else frame)
    with Loader(dataset, 5, 16, process=(0, 1)) as loader:
        seen = {index for step in range(4) for index in frames_of(dataset, loader(step))}
    assert seen == {0, 2, 4, 6, 8}
    nothing = Frames(lambda frame, i: replace(frame, points=frame.points[:3]))
    with (
        Loader(nothing, 2, 16, process=(0, 1)) as loader,
        pytest.raises(CaperError, match="no frame of the memory data shows 48 points of box"),
    ):
        loader(0)


def test_what_cannot_be_trained_on_is_named():
    def broken(frame, index):
        return replace(frame, truth=frame.truth.replace(size=-frame.truth.size))

    for change, message in (
        (lambda frame, i: replace(frame, truth=None), r"frame '\d' of box has no ground truth"),
        (broken, r"frame '\d' of box: size must be positive"),
    ):
        with (
            Loader(Frames(change), 2, 16, process=(0, 1)) as loader,
            pytest.raises(CaperError, match=message),
        ):
            loader(0)
    with pytest.raises(CaperError, match="batch_size 5 cannot be split over 2 processes"):
        Loader(Frames(), 5, process=(0, 2))
