"""Runs a tracker over labeled videos: how each begins, what is given, and what counts."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError
from caper_jax.evaluation.metrics import PoseErrors, pose_errors
from caper_jax.evaluation.report import error_tables
from caper_jax.tracker import Tracker

Start = Literal["truth", "estimator"]
STARTS: tuple[Start, ...] = ("truth", "estimator")


@dataclass(frozen=True)
class Track:
    """What a tracker said about one video of T frames.

    Attributes:
      name: the video's.
      frames: T names.
      pose: arrays [T, K, ...], meters.
      truth: likewise; None where the data have none.
      energy: [T] Eq 16, relative to the object's diagonal.
      keyframe, estimated, lost: [T] bool, see ``tracking.step.TrackResult``.
      seconds: [T] from points to pose, after a first call that compiles.
    """

    name: str
    frames: list[str]
    pose: ArticulatedPose
    truth: ArticulatedPose | None
    energy: np.ndarray
    keyframe: np.ndarray
    estimated: np.ndarray
    lost: np.ndarray
    seconds: np.ndarray


def track_video(
    tracker: Tracker,
    name: str,
    frames: Iterable[Frame],
    start: Start = "truth",
    given_masks: bool = False,
) -> Track:
    """Tracks through one video, frame by frame as a live stream.

    Args:
      tracker: is reset.
      name: of the video.
      frames: in the order of time.
      start: where frame 0's pose comes from: the ground truth's part poses (and nothing else of
        it), as in the paper, or the static estimator. Ground truth is not looked at afterwards.
      given_masks: hand over the data's part labels instead of predicting them; results of such a
        run are to be labeled so.

    Raises:
      CaperError: no frames, or a start or masks that the data do not have.
    """
    names, truths, results, seconds = [], [], [], []
    tracker.reset()
    for number, frame in enumerate(frames):
        if given_masks and frame.labels is None:
            raise CaperError(f"frame {frame.name!r} has no part labels to give to the tracker")
        labels = frame.labels if given_masks else None
        if number == 0:
            tracker(frame.points, labels)  # compiles, if nothing did before
            tracker.reset()
            if start == "truth":
                if frame.truth is None:
                    raise CaperError(f"frame {frame.name!r} has no ground truth to start from")
                pose = frame.truth
                tracker.reset(frame.points, pose.rotation, pose.translation, labels)
        began = time.perf_counter()
        result = jax.block_until_ready(tracker(frame.points, labels))
        seconds.append(time.perf_counter() - began)
        results.append(jax.tree.map(np.asarray, replace(result, labels=None)))
        names.append(frame.name)
        truths.append(frame.truth)
    if not results:
        raise CaperError(f"video {name!r} has no frames")
    stacked = jax.tree.map(lambda *rows: np.stack(rows), *results)
    known = [truth for truth in truths if truth is not None]
    return Track(
        name=name,
        frames=names,
        pose=stacked.pose,
        truth=jax.tree.map(lambda *rows: np.stack(rows), *known)
        if len(known) == len(truths)
        else None,
        energy=stacked.energy,
        keyframe=stacked.keyframe,
        estimated=stacked.estimator_queried,
        lost=stacked.lost,
        seconds=np.array(seconds),
    )


def track_errors(track: Track, category: Category) -> PoseErrors:
    """Errors of all T frames; a lost frame counts with the pose that was held.

    Raises:
      CaperError: a video without ground truth.
    """
    if track.truth is None:
        raise CaperError(f"video {track.name!r} has no ground truth")
    return pose_errors(track.pose, track.truth, category)


def joined_tables(
    errors: Sequence[PoseErrors], category: Category
) -> dict[str, list[dict[str, Any]]]:
    """``error_tables`` over all frames of all videos (their errors) but the first of each."""
    joined = PoseErrors(
        **{
            key: np.concatenate([getattr(error, key)[1:] for error in errors])
            for key in PoseErrors.__dataclass_fields__
        }
    )
    return error_tables(joined, category)


def summarize_tracks(
    tracks: Sequence[Track], category: Category, start: Start, mask_source: str, part_masks: str
) -> dict[str, Any]:
    """JSON-ready metrics over all frames of all videos but the first of each (Sec 6.3).

    Args:
      tracks: at least one; all with ground truth.
      category: theirs.
      start: as given to ``track_video``.
      mask_source: of the object masks.
      part_masks: "predicted" or "given".
    """
    errors = [track_errors(track, category) for track in tracks]
    tables = joined_tables(errors, category)
    after = {
        key: np.concatenate([getattr(track, key)[1:] for track in tracks])
        for key in ("keyframe", "estimated", "lost", "seconds")
    }
    return {
        "category": category.name,
        "videos": len(tracks),
        "frames": len(after["lost"]),
        "start": start,
        "mask_source": mask_source,
        "part_masks": part_masks,
        **tables,
        "keyframes": int(after["keyframe"].sum()),
        "estimated": int(after["estimated"].sum()),
        "lost": int(after["lost"].sum()),
        "median_seconds_per_frame": float(np.median(after["seconds"])),
    }
