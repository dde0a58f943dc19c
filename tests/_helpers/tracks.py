"""Stand-ins for trackers, and tracks made by hand, of a box whose errors are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from _helpers.frames import random_frames
from caper_jax import categories
from caper_jax.data import hdf5
from caper_jax.evaluation.metrics import object_diagonal
from caper_jax.evaluation.tracking import Track
from caper_jax.tracking.step import TrackResult

BOX = categories.get("box")


def write_videos(path, videos: int = 2, frames: int = 4, category=BOX):
    """A file of videos of random frames, two parts; returns the file's dataset."""
    video, frame = np.divmod(np.arange(videos * frames), frames)
    fields = random_frames(videos * frames, 100)
    hdf5.write(path, category=category, split="test", video=video, frame=frame, **fields)
    return hdf5.Hdf5Dataset(path)


def disturbed(pose, degrees: float = 0.0, share: float = 0.0):
    """A pose whose parts are turned about their x and moved by a share of the diagonal.

    Args:
      pose: arrays [F, K, ...].
      degrees, share: how far.
    """
    turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    shift = share * object_diagonal(pose)[:, None, None] * np.array([0.6, 0.0, 0.8])
    return replace(pose, rotation=pose.rotation @ turn, translation=pose.translation + shift)


def track(name: str, truth, pose) -> Track:
    """A track of one video from poses [T, K, ...]."""
    frames = len(truth.rotation)
    none = np.zeros(frames, bool)
    return Track(
        name=name,
        frames=[f"{name}/{index}" for index in range(frames)],
        pose=pose,
        truth=truth,
        energy=np.zeros(frames),
        keyframe=none,
        estimated=none,
        lost=none,
        plausible=~none,
        reason=np.zeros(frames, np.int32),
        size_ratio=np.ones(frames),
        distinct_points=np.full(frames, 1024),
        seconds=np.full(frames, 0.01),
    )


class KnownTracker:
    """Answers with the truth of the frame it is shown, turned and moved by a known amount.

    Every first frame of a video is far off: it must not count.
    """

    def __init__(self, dataset, degrees: float = 0.0, share: float = 0.0) -> None:
        self._frames = {
            frame.points.tobytes(): frame for frame in map(dataset.__getitem__, range(len(dataset)))
        }
        self._first = {dataset[index[0]].name for index in dataset.videos().values()}
        self._degrees, self._share = degrees, share
        self.resets: list[bool] = []
        self.labels: list[bool] = []

    def reset(self, points=None, rotation=None, translation=None, labels=None) -> None:
        self.resets.append(points is not None)

    def __call__(self, points, labels=None, gravity=None) -> TrackResult:
        frame = self._frames[points.tobytes()]
        first = frame.name in self._first
        degrees, share = (90.0, 5.0) if first else (self._degrees, self._share)
        truth = replace(frame.truth, **{k: v[None] for k, v in vars(frame.truth).items()})
        pose = disturbed(truth, degrees, share)
        self.labels.append(labels is not None)
        return TrackResult(
            pose=replace(pose, **{k: v[0] for k, v in vars(pose).items()}),
            labels=None,
            energy=0.0,
            keyframe=first,
            estimator_queried=False,
            lost=first,
            plausible=not first,
            reason=np.int32(3 if first else 0),
            size_ratio=1.0,
            distinct_points=len(points),
        )
