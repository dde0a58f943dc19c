"""What tracking leaves behind: a JSON object per frame, and tables for people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.config import TrackerConfig
from caper_jax.evaluation.records import frame_record
from caper_jax.evaluation.report import format_tables
from caper_jax.evaluation.summaries import align
from caper_jax.evaluation.tracking import Start, Track
from caper_jax.tracking.step import TrackResult

_NAME_WIDTH = 30  # of a video in a table


def track_records(track: Track, category: Category) -> Iterator[dict[str, Any]]:
    """``frame_record`` of every frame of a track.

    Raises:
      CaperError: a pose that is not finite.
    """
    for index, frame in enumerate(track.frames):
        result = TrackResult(
            pose=jax.tree.map(lambda array, i=index: array[i], track.pose),
            labels=None,
            energy=track.energy[index],
            keyframe=track.keyframe[index],
            estimator_queried=track.estimated[index],
            lost=track.lost[index],
        )
        yield frame_record(frame, result, category, float(track.seconds[index]))


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
        f"start: {start}; keyframes: {_describe(config)}",
        f"object masks: {mask_source}; part masks: {part_masks}",
        "",
    ]
    rows = [["video", "frames", "keyframes", "estimates", "lost", "ms per frame"]]
    rows += [
        [
            _shortened(track.name),
            str(len(track.frames)),
            *(str(int(array.sum())) for array in (track.keyframe, track.estimated, track.lost)),
            f"{1000 * np.median(track.seconds):.1f}",
        ]
        for track in tracks
    ]
    lines += align(rows)
    if metrics is not None:
        lines += ["", "errors of all frames but the first of each video, mean / median:", ""]
        lines += format_tables(metrics)
    return "\n".join(lines)


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _describe(config: TrackerConfig) -> str:
    """The policy with the settings that it heeds."""
    if config.policy == "fixed":
        return f"fixed, every {config.interval} frames"
    if config.policy == "none":
        return "none"
    described = f"{config.policy}, energy above {config.threshold:g}"
    if config.max_unmatched < 1.0:
        described += f" or {100 * config.max_unmatched:.0f} % unmatched"
    return described


def _shortened(name: str) -> str:
    return name if len(name) <= _NAME_WIDTH else "…" + name[1 - _NAME_WIDTH :]
