"""Table 10: keyframes none, fixed or dynamic; and how errors grow with the length of a video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.config import KeyframePolicy, TrackerConfig
from caper_jax.estimator import Estimator
from caper_jax.evaluation.tracking import Track, track_errors
from caper_jax.reproduce import comparison, runs
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import TABLES
from caper_jax.reproduce.render import Curves, Report, Table, spread
from caper_jax.tracker import Tracker

POLICIES: tuple[KeyframePolicy, ...] = ("none", "fixed", "dynamic")
CATEGORIES = ("robotarm",)
PER_FRAMES = 100  # slopes are per so many frames
# Frames in a row that no video has: the static estimator never comes to the rescue.
_NEVER = 10**9


def run(name: str, options: Options) -> Report:
    """Measures one model under each policy, the first pose given as in the paper.

    Args:
      name: "table10".
      options: see ``Options``; with a large ``frames``, the growth of errors shows.

    Raises:
      CaperError: unknown categories, a damaged model, or data that cannot be read or drawn.
    """
    paper = TABLES[name]
    rows: list[list[str]] = []
    growth: list[list[str]] = []
    facts, result, shown = [], {}, {}
    curves: dict[str, Curves] = {}
    for key in options.category or CATEGORIES:
        figures = {
            policy: of_policy[key]
            for policy, of_policy in paper.variants.items()
            if key in of_policy
        }
        if figures:
            shown[key] = figures["dynamic"]
        found = _measure(key, options, paper.videos, paper.frames)
        result[key] = {
            "paper": {policy: comparison.paper_json(figure) for policy, figure in figures.items()},
            **found,
        }
        facts.append(f"{key}: {found['data']}")
        if not found["policies"]:
            parts = categories.get(key).parts
            for policy, figure in figures.items():
                rows += comparison.paper_rows(key, parts, figure, f"{policy}: {found['data']}")
            continue
        for policy, summary in found["policies"].items():
            rows += comparison.rows(key, policy, summary, figures.get(policy))
            growth += growth_rows(key, policy, summary["growth"])
        curves |= _curves(key, found["policies"])
    header = ["category", "part", "keyframes", *comparison.HEADER[3:]]
    tables = [Table("Errors of tracking, the first pose given", header, rows, comparison.LABELS)]
    if growth:
        caption = "Growth of the error with the frame: least-squares slope ± its standard error"
        per = f"per {PER_FRAMES} frames"
        header = ["category", "keyframes", "part", f"rot [deg {per}]", f"trans [% {per}]"]
        tables.append(Table(caption, header, growth, 3))
    return Report(
        title=paper.title,
        tables=tables,
        facts=[
            paper.measured_on(),
            *facts,
            runs.describe_tracker(options),
            "none: every frame is a keyframe with the tracked pose, and a lost track is not "
            "started again; fixed and dynamic: a keyframe's pose comes from the static estimator",
            *comparison.COLUMNS,
            "a slope is fitted to each video, its standard error is that of their mean: frames of "
            "one video are not independent",
            *(comparison.assumptions(shown, paper.dataset) if shown else ()),
        ],
        result={"categories": result},
        curves=curves,
    )


def _measure(name: str, options: Options, videos: int, frames: int) -> dict[str, Any]:
    """All policies of one category, JSON-ready; "data" says why there are none."""
    case = runs.find_case(name, options, videos, frames)
    if isinstance(case, str):
        return {"data": case, "policies": {}}
    estimator, source = case
    found, condition = {}, runs.Condition()
    for policy in POLICIES:
        tracker = Tracker(estimator, policy_config(policy, estimator, options))
        tracks = runs.track_all(tracker, source, condition)
        summary = runs.summarize(tracks, source, condition)
        found[policy] = {**summary, "growth": error_growth(tracks, source.category)}
    return {"data": source.description, "policies": found}


def policy_config(policy: KeyframePolicy, estimator: Estimator, options: Options) -> TrackerConfig:
    """The tracker of a policy; without keyframes, nothing rescues a track that drifts away."""
    config = replace(runs.tracker_config(estimator, options), policy=policy)
    return replace(config, patience=_NEVER) if policy == "none" else config


def error_growth(tracks: Sequence[Track], category: Category) -> dict[str, Any]:
    """Error against frame, of the root and the last part, over all frames but the first.

    Args:
      tracks: of videos with ground truth; curves reach as far as the shortest.
      category: theirs.

    Returns:
      JSON-ready: "frames" [T - 1] and per part "rotation_deg" and "translation_relative", each
      with the "mean" over videos [T - 1], and the "slope" per frame with its "standard_error"
      (None for a single video).
    """
    errors = [track_errors(track, category) for track in tracks]
    length = min(len(track.frames) for track in tracks)
    turn = np.stack([error.rotation_deg[1:length] for error in errors])
    shift = np.stack([error.translation_relative[1:length] for error in errors])
    frames = np.arange(1, length)
    parts = {}
    for part in (0, category.num_parts - 1):
        parts[category.parts[part]] = {
            metric: {
                "mean": values[:, :, part].mean(0).tolist(),
                **slope(frames, values[..., part]),
            }
            for metric, values in (("rotation_deg", turn), ("translation_relative", shift))
        }
    return {"frames": frames.tolist(), "parts": parts}


def slope(frames: np.ndarray, errors: np.ndarray) -> dict[str, float | None]:
    """Least-squares slope of the mean error against the frame, and its standard error.

    The slope of the mean is the mean of the videos' slopes; these are independent of each other,
    the frames of a video are not.

    Args:
      frames: [T].
      errors: [V, T].

    Returns:
      "slope" per frame and "standard_error"; None for what too few frames or videos do not say.
    """
    if len(frames) < 2:
        return {"slope": None, "standard_error": None}
    centered = frames - frames.mean()
    slopes = errors @ centered / (centered @ centered)
    videos = len(slopes)
    error = float(slopes.std(ddof=1) / np.sqrt(videos)) if videos > 1 else None
    return {"slope": float(slopes.mean()), "standard_error": error}


def growth_rows(category: str, policy: str, growth: dict[str, Any]) -> list[list[str]]:
    """One row per part of ``error_growth``."""
    rows = []
    for part, metrics in growth["parts"].items():
        cells = []
        for metric, factor in (("rotation_deg", 1.0), ("translation_relative", 100.0)):
            scale = factor * PER_FRAMES
            value, error = metrics[metric]["slope"], metrics[metric]["standard_error"]
            cells.append(
                "-"
                if value is None
                else spread(scale * value, None if error is None else scale * error, 3)
            )
        rows.append([category, policy, part, *cells])
    return rows


def _curves(category: str, policies: dict[str, dict[str, Any]]) -> dict[str, Curves]:
    """Pictures of the error against the frame, one per metric."""
    pictures = {}
    for metric, factor, label in (
        ("rotation_deg", 1.0, "rotation error [deg]"),
        ("translation_relative", 100.0, "translation error [% of the diagonal]"),
    ):
        lines = {
            f"{policy}, {part}": (
                np.array(found["growth"]["frames"]),
                factor * np.array(metrics[metric]["mean"]),
            )
            for policy, found in policies.items()
            for part, metrics in found["growth"]["parts"].items()
        }
        pictures[f"{category}_{metric.partition('_')[0]}"] = Curves(
            f"{category}: mean over videos", "frame", label, lines
        )
    return pictures
