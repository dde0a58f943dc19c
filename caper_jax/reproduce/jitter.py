"""How much estimated poses tremble on an object that does not move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation.metrics import pose_errors
from caper_jax.lie import so3
from caper_jax.reproduce import runs
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.render import Report, Table, number, ratio
from caper_jax.reproduce.videos import Videos
from caper_jax.tracker import Tracker

MODE = "still"
VIDEOS, FRAMES = 30, 30


def run(name: str, options: Options) -> Report:
    """Compares the tracker with estimates of every frame by itself.

    Args:
      name: of the reproduction.
      options: see ``Options``.

    Raises:
      CaperError: a category without a model, too few frames, or --data: only generated objects
        are known not to move.
    """
    if options.data is not None:
        raise CaperError(f"{name} needs objects that do not move; leave out --data")
    if options.frames is not None and options.frames < 3:
        raise CaperError(f"{name} compares frames after the first; --frames must be 3 or more")
    models = runs.need_models(options.category, options.weights)
    rows, facts, result = [], [], {}
    for key, estimator in models.items():
        videos = runs.open_videos(options, estimator.category, VIDEOS, FRAMES, MODE)
        assert videos is not None  # generated ones exist for every category
        facts.append(f"{key}: {videos.description}")
        truths = [_truths(videos, video) for video in videos.index]
        estimates = [_estimates(estimator, videos, video) for video in videos.index]
        single = tremble(estimates, truths, estimator.category)
        result[key] = {"frame_by_frame": single}
        tracker = Tracker(estimator, runs.tracker_config(estimator, options))
        for condition in runs.conditions(options):
            tracks = runs.track_all(tracker, videos, condition)
            tracked = tremble([track.pose for track in tracks], truths, estimator.category)
            result[key][f"tracked, first pose {condition.label}"] = tracked
            rows += jitter_rows(key, condition.label, tracked, single)
    header = ["category", "part", "first pose"]
    for label in ("turn [deg]", "shift [mm]"):
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
            runs.describe_tracker(options),
            "0.000 exactly: registration leaves a root where it is that does not seem to move",
        ],
        result={"categories": result},
    )


def tremble(
    poses: Sequence[ArticulatedPose], truths: Sequence[ArticulatedPose], category: Category
) -> list[dict[str, Any]]:
    """Per part: name, RMS changes from frame to frame, mean rotation error; without frame 0.

    Args:
      poses: of each video, arrays [T, K, ...], T at least 3.
      truths: likewise.
      category: theirs.
    """
    turns, shifts, errors = [], [], []
    for pose, truth in zip(poses, truths, strict=True):
        after, true = (jax.tree.map(lambda array: np.asarray(array)[1:], p) for p in (pose, truth))
        with jax.enable_x64(True):
            rotation = np.asarray(after.rotation, np.float64)
            turns.append(np.asarray(so3.geodesic_distance(rotation[1:], rotation[:-1])))
        shifts.append(np.linalg.norm(np.diff(after.translation, axis=0), axis=-1))
        errors.append(pose_errors(after, true, category).rotation_deg)
    turn, shift = (
        np.sqrt(np.mean(np.concatenate(values) ** 2, axis=0)) for values in (turns, shifts)
    )
    error = np.concatenate(errors).mean(0)
    return [
        {
            "name": part,
            "turn_deg": float(np.degrees(turn[k])),
            "shift_m": float(shift[k]),
            "rotation_error_deg": float(error[k]),
        }
        for k, part in enumerate(category.parts)
    ]


def jitter_rows(category: str, label: str, tracked, single) -> list[list[str]]:
    """One row per part of two results of ``tremble``."""
    rows = []
    for ours, other in zip(tracked, single, strict=True):
        row = [category, ours["name"], label]
        for metric, factor in (("turn_deg", 1.0), ("shift_m", 1000.0)):
            values = ours[metric], other[metric]
            row += [*(number(factor * value, 3) for value in values), number(ratio(*values), 3)]
        row += [number(found["rotation_error_deg"], 2) for found in (ours, other)]
        rows.append(row)
    return rows


def _truths(videos: Videos, name: str) -> ArticulatedPose:
    """Poses [T, K, ...] of a generated video."""
    truths = [frame.truth for frame in videos.frames(name)]
    return jax.tree.map(lambda *rows: np.stack(rows), *truths)


def _estimates(estimator: Estimator, videos: Videos, name: str) -> ArticulatedPose:
    """Poses [T, K, ...] of a video's frames, each estimated by itself."""
    poses = [estimator(frame.points).pose for frame in videos.frames(name)]
    return jax.tree.map(lambda *rows: np.stack([np.asarray(row) for row in rows]), *poses)
