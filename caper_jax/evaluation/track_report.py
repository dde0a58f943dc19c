"""What tracking leaves behind: a JSON object per frame, and tables for people."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.config import TrackerConfig
from caper_jax.errors import CaperError
from caper_jax.evaluation.report import format_tables
from caper_jax.evaluation.summaries import align
from caper_jax.evaluation.tracking import Start, Track
from caper_jax.tracking.step import TrackResult

_NAME_WIDTH = 30  # of a video in a table


def frame_record(
    frame: str | int, result: TrackResult, category: Category, seconds: float
) -> dict[str, Any]:
    """One frame, JSON-ready: meters and degrees, camera frame (OpenCV).

    "parts" holds by name rotation [3, 3] and translation [3] (part frame -> camera), size [3] and
    box_center [3] (rest frame of the part); "joints" by the name of the part that they carry type,
    state with its unit, axis [3] and pivot [3] (root's rest frame; no pivot of a prismatic joint).

    Args:
      frame: name or number.
      result: of one frame, without batch axes.
      category: names the parts.
      seconds: from points to pose.

    Raises:
      CaperError: a pose that is not finite.
    """
    pose = {key: np.asarray(value, np.float64) for key, value in vars(result.pose).items()}
    if not all(np.isfinite(value).all() for value in pose.values()):
        raise CaperError(
            f"frame {frame}: the model gave no finite pose; check the masks and the unit of depth"
        )
    # A tenth of a micrometer, or of a microradian: below what float32 holds. + 0.0 mends -0.0.
    rounded = {key: value.round(7) + 0.0 for key, value in pose.items()}
    parts = {
        name: {
            key: rounded[key][part].tolist()
            for key in ("rotation", "translation", "size", "box_center")
        }
        for part, name in enumerate(category.parts)
    }
    joints = {}
    for joint, kind in enumerate(category.joint_types):
        turns = kind == "revolute"
        state = float(pose["joint_state"][joint])
        joints[category.parts[joint + 1]] = {
            "type": kind,
            "state": round(float(np.degrees(state)) if turns else state, 6),
            "unit": "degrees" if turns else "meters",
            "axis": rounded["joint_axis"][joint].tolist(),
            "pivot": rounded["joint_pivot"][joint].tolist() if turns else None,
        }
    return {
        "frame": frame,
        "parts": parts,
        "joints": joints,
        "energy": round(float(result.energy), 7),
        "keyframe": bool(result.keyframe),
        "estimated": bool(result.estimator_queried),
        "lost": bool(result.lost),
        "milliseconds": round(1000 * seconds, 3),
    }


def json_line(record: dict[str, Any]) -> str:
    """A record as one line of JSON, without line break."""
    return json.dumps(record, allow_nan=False)


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
