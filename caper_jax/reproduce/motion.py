"""Jitter on objects that stand still, and errors by how camera and joints move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError
from caper_jax.evaluation.loading import stack
from caper_jax.evaluation.metrics import pose_errors
from caper_jax.lie import so3
from caper_jax.reproduce.data import Videos, find_models, open_videos
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.report import RELATIVE, Report, Table, number, ratio
from caper_jax.reproduce.tracking import (
    Condition,
    conditions,
    describe_tracker,
    summarize,
    track_all,
    tracker_config,
)
from caper_jax.tracker import Tracker

_VIDEOS, _FRAMES = 30, 30
_MODES = ("paper", "cam", "hard")
_METRICS = (("rotation_deg", 1.0, 2), ("translation_relative", 100.0, 2), ("iou_full", 100.0, 1))


def run(name: str, options: Options) -> Report:
    """Measures the tracker on generated videos.

    Args:
      name: "jitter", which compares the tracker with estimates of every frame by itself, or
        "modes", which compares modes of motion, the first pose given.
      options: see ``Options``.

    Raises:
      CaperError: a category without a model, too few frames, or --data: only of generated videos
        is known how they move.
    """
    if options.data is not None:
        raise CaperError(f"{name} needs generated videos; leave out --data")
    return _jitter(options) if name == "jitter" else _modes(options)


def _open(options: Options, category: Category, mode: str) -> Videos:
    videos = open_videos(options, category, _VIDEOS, _FRAMES, mode)
    assert videos is not None  # generated ones exist for every category
    return videos


def _jitter(options: Options) -> Report:
    if options.frames is not None and options.frames < 3:
        raise CaperError("jitter compares frames after the first; --frames must be 3 or more")
    rows, facts, result = [], [], {}
    for key, estimator in find_models(options).items():
        videos = _open(options, estimator.category, "still")
        facts.append(f"{key}: {videos.description}")
        truths, estimates = [], []
        for name in videos.index:
            frames = list(videos.frames(name))
            truths.append(stack([frame.truth for frame in frames if frame.truth is not None]))
            estimates.append(stack([estimator(frame.points).pose for frame in frames]))
        single = measure_jitter(estimates, truths, estimator.category)
        result[key] = {"frame_by_frame": single}
        tracker = Tracker(estimator, tracker_config(estimator, options))
        for condition in conditions(options):
            poses = [track.pose for track in track_all(tracker, videos, condition)]
            tracked = measure_jitter(poses, truths, estimator.category)
            result[key][f"tracked, first pose {condition.label}"] = tracked
            rows += jitter_rows(key, condition.label, tracked, single)
    header = ["category", "part", "first pose"]
    for label in ("rot change [deg]", "trans change [mm]"):
        header += [f"{label} tracked", "frame by frame", "ratio"]
    header += ["rot error [deg] tracked", "frame by frame"]
    return Report(
        title="Jitter: frame-to-frame change of the pose of an object that stands still",
        tables=[Table("Root mean square over pairs of successive frames", header, rows, 3)],
        facts=[
            *facts,
            "still: camera and joints do not move; noise, ray grid and sampling are fresh in every "
            "frame",
            "pairs from the first frame after the one whose pose was given or estimated; ratio: "
            "tracked over frame by frame",
            "rot error: mean over the same frames; a tracker that holds still at a wrong pose "
            "shows there",
            describe_tracker(options),
            "0.000 exactly: registration leaves a root where it is that does not seem to move",
        ],
        result={"categories": result},
    )


def measure_jitter(
    poses: Sequence[ArticulatedPose], truths: Sequence[ArticulatedPose], category: Category
) -> list[dict[str, Any]]:
    """Per part: name, RMS changes from frame to frame, mean rotation error; without frame 0.

    Args:
      poses: of each video, arrays [T, K, ...], T at least 3.
      truths: likewise.
      category: theirs.
    """
    rotations, translations, errors = [], [], []
    for pose, truth in zip(poses, truths, strict=True):
        after, true = (jax.tree.map(lambda array: np.asarray(array)[1:], p) for p in (pose, truth))
        with jax.enable_x64(True):
            rotation = np.asarray(after.rotation, np.float64)
            rotations.append(np.asarray(so3.geodesic_distance(rotation[1:], rotation[:-1])))
        translations.append(np.linalg.norm(np.diff(after.translation, axis=0), axis=-1))
        errors.append(pose_errors(after, true, category).rotation_deg)
    rotation, translation = (
        np.sqrt(np.mean(np.concatenate(changes) ** 2, axis=0))
        for changes in (rotations, translations)
    )
    error = np.concatenate(errors).mean(0)
    return [
        {
            "name": part,
            "rotation_change_deg": float(np.degrees(rotation[k])),
            "translation_change_m": float(translation[k]),
            "rotation_error_deg": float(error[k]),
        }
        for k, part in enumerate(category.parts)
    ]


def jitter_rows(
    category: str,
    label: str,
    tracked: Sequence[Mapping[str, Any]],
    single: Sequence[Mapping[str, Any]],
) -> list[list[str]]:
    """One row per part of two results of ``measure_jitter``."""
    rows = []
    for ours, other in zip(tracked, single, strict=True):
        row = [category, ours["name"], label]
        for metric, factor in (("rotation_change_deg", 1.0), ("translation_change_m", 1000.0)):
            values = ours[metric], other[metric]
            row += [*(number(value, 3, factor) for value in values), number(ratio(*values), 3)]
        rows.append([*row, *(number(one["rotation_error_deg"], 2) for one in (ours, other))])
    return rows


def _modes(options: Options) -> Report:
    condition = Condition()
    rows, facts = [], []
    result: dict[str, dict[str, Any]] = {}
    for key, estimator in find_models(options).items():
        tracker = Tracker(estimator, tracker_config(estimator, options))
        result[key] = {}
        for mode in _MODES:
            videos = _open(options, estimator.category, mode)
            tracks = track_all(tracker, videos, condition)
            result[key][mode] = summarize(tracks, videos, condition)
            facts.append(f"{key}: {videos.description}")
        rows += mode_rows(key, result[key])
    header = ["category", "part"]
    for label in ("rot [deg]", "trans [%]", "IoU full [%]"):
        header += [f"{label} paper", "cam", "hard", "hard/cam"]
    return Report(
        title="Errors of tracking in three modes of motion",
        tables=[Table("First pose given, part masks predicted", header, rows, 2)],
        facts=[
            *facts,
            "paper: the camera stands still and every joint opens; cam: the camera moves too; "
            "hard: it moves twice as fast and the joints reverse",
            RELATIVE,
            describe_tracker(options),
        ],
        result={"categories": result},
    )


def mode_rows(category: str, summaries: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """One row per part: each error in the three modes, and its ratio of hard to cam.

    Args:
      category: its name.
      summaries: mode -> from ``summarize_tracks``.
    """
    rows = []
    for index, part in enumerate(summaries["paper"]["parts"]):
        row = [category, part["name"]]
        for metric, factor, digits in _METRICS:
            values = [summaries[mode]["parts"][index][metric]["mean"] for mode in _MODES]
            row += [number(value, digits, factor) for value in values]
            row.append(number(ratio(values[2], values[1]), 2))
        rows.append(row)
    return rows
