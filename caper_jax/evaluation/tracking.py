"""Runs a tracker over videos: how each begins, what is given, what counts, and what is written."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import TrackerConfig
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError
from caper_jax.evaluation.loading import stack
from caper_jax.evaluation.metrics import PoseErrors, pose_errors
from caper_jax.evaluation.records import frame_record
from caper_jax.evaluation.report import error_tables, format_tables, text_table
from caper_jax.models import plausibility
from caper_jax.tracker import Tracker
from caper_jax.tracking.step import TrackResult

Start = Literal["truth", "estimator"]
# Fields of a ``TrackResult`` that say whether it can be believed.
_VERDICT = ("plausible", "reason", "size_ratio", "distinct_points")
_NAME_WIDTH = 30  # of a video in a table


@dataclass(frozen=True)
class Track:
    """The results of a tracker on one video of T frames.

    Attributes:
      name: the video's.
      frames: T names.
      pose: arrays [T, K, ...], meters.
      truth: likewise; None where the data have none.
      energy: [T] Eq 16, relative to the object's diagonal.
      keyframe, estimated, lost: [T] bool, see ``tracking.step.TrackResult``.
      labels: [T, N] part of every point that the tracker took of a frame.
      plausible, reason, size_ratio, distinct_points: [T] likewise.
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
    plausible: np.ndarray
    reason: np.ndarray
    size_ratio: np.ndarray
    distinct_points: np.ndarray
    seconds: np.ndarray
    labels: np.ndarray | None = None


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
            tracker(frame.points, labels, frame.gravity)  # compiles, if nothing did before
            tracker.reset()
            if start == "truth":
                if frame.truth is None:
                    raise CaperError(f"frame {frame.name!r} has no ground truth to start from")
                pose = frame.truth
                tracker.reset(frame.points, pose.rotation, pose.translation, labels)
        began = time.perf_counter()
        result = jax.block_until_ready(tracker(frame.points, labels, frame.gravity))
        seconds.append(time.perf_counter() - began)
        results.append(jax.tree.map(np.asarray, result))
        names.append(frame.name)
        truths.append(frame.truth)
    if not results:
        raise CaperError(f"video {name!r} has no frames")
    stacked = stack(results)
    return Track(
        name=name,
        frames=names,
        pose=stacked.pose,
        truth=None if any(truth is None for truth in truths) else stack(truths),
        energy=stacked.energy,
        keyframe=stacked.keyframe,
        estimated=stacked.estimator_queried,
        lost=stacked.lost,
        **{name: getattr(stacked, name) for name in _VERDICT},
        seconds=np.array(seconds),
        labels=stacked.labels,
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
        for key in ("keyframe", "estimated", "lost", "plausible", "seconds")
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
        "implausible": int((~after["plausible"]).sum()),
        "median_seconds_per_frame": float(np.median(after["seconds"])),
    }


def track_records(track: Track, category: Category) -> Iterator[dict[str, Any]]:
    """``frame_record`` of every frame of a track.

    Raises:
      CaperError: a pose that is not finite.
    """
    for index, frame in enumerate(track.frames):
        seconds = float(track.seconds[index])
        yield frame_record(frame, _result(track, index), category, seconds)


def _result(track: Track, index: int) -> TrackResult:
    """What the tracker said of one frame, without labels."""
    return TrackResult(
        pose=jax.tree.map(lambda array: array[index], track.pose),
        labels=None,
        energy=track.energy[index],
        keyframe=track.keyframe[index],
        estimator_queried=track.estimated[index],
        lost=track.lost[index],
        **{name: getattr(track, name)[index] for name in _VERDICT},
    )


def format_tracks(
    tracks: Sequence[Track],
    category: Category,
    config: TrackerConfig,
    start: Start,
    mask_source: str,
    part_masks: str,
    metrics: dict[str, Any] | None,
) -> str:
    """Tables of videos and, with ground truth, of errors, at most 80 columns.

    Args:
      tracks: at least one.
      category: theirs.
      config: of the tracker.
      start: as given to ``track_video``.
      mask_source: of the object masks.
      part_masks: "predicted" or "given".
      metrics: from ``summarize_tracks``.
    """
    frames = sum(len(track.frames) for track in tracks)
    lines = [
        f"{category.name}: {_count(len(tracks), 'video')}, {_count(frames, 'frame')}",
        f"start: {start}; keyframes: {_describe_keyframes(config)}",
        f"object masks: {mask_source}; part masks: {part_masks}",
        "",
    ]
    header = ["video", "frames", "keyframes", "estimates", "lost", "ms per frame"]
    rows = [
        [
            _shorten(track.name),
            str(len(track.frames)),
            *(str(int(array.sum())) for array in (track.keyframe, track.estimated, track.lost)),
            f"{1000 * np.median(track.seconds):.1f}",
        ]
        for track in tracks
    ]
    lines += text_table(header, rows)
    for track in tracks:
        if doubtful := int((~track.plausible).sum()):
            first = int(np.argmin(track.plausible))
            reason = plausibility.implausible_because(_result(track, first), category)
            count = _count(doubtful, "implausible frame")
            text = f"{_shorten(track.name)}: {count}, the first is {track.frames[first]}: {reason}"
            lines += textwrap.wrap(text, 80)
    if metrics is not None:
        lines += ["", "errors of all frames but the first of each video, mean / median:", ""]
        lines += format_tables(metrics)
    return "\n".join(lines)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _describe_keyframes(config: TrackerConfig) -> str:
    """The policy with the settings that it heeds."""
    if config.policy == "fixed":
        return f"fixed, every {config.interval} frames"
    if config.policy == "none":
        return "none"
    text = f"{config.policy}, energy above {config.threshold:g}"
    if config.max_unmatched < 1.0:
        text += f" or {100 * config.max_unmatched:.0f} % unmatched"
    return text


def _shorten(name: str) -> str:
    return name if len(name) <= _NAME_WIDTH else "…" + name[1 - _NAME_WIDTH :]
