"""Table 10: keyframes none, fixed or dynamic; and how errors grow with the length of a video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from caper_jax.articulation.category import Category
from caper_jax.config import KeyframePolicy, TrackerConfig
from caper_jax.estimator import Estimator
from caper_jax.evaluation.tracking import Track, track_errors
from caper_jax.reproduce.data import find_case
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import paper
from caper_jax.reproduce.report import (
    ERROR_HEADER,
    ERROR_LABELS,
    Report,
    Table,
    assumptions,
    error_rows,
    missing_rows,
    paper_json,
    spread,
)
from caper_jax.reproduce.tracking import (
    TRACKING_NOTES,
    Condition,
    describe_tracker,
    summarize,
    track_all,
    tracker_config,
)
from caper_jax.tracker import Tracker
from caper_jax.visualization.plots import Curves

POLICIES: tuple[KeyframePolicy, ...] = ("none", "fixed", "dynamic")
_CATEGORIES = ("robotarm",)
_PER_FRAMES = 100  # slopes are per so many frames
# Frames in a row that no video has: the static estimator never comes to the rescue.
_NEVER = 10**9
# Metric -> (its name in files, label of its axis, factor to show it by).
_CURVES = {
    "rotation_deg": ("rotation", "rotation error [deg]", 1.0),
    "translation_relative": ("translation", "translation error [% of the diagonal]", 100.0),
}


def run(name: str, options: Options) -> Report:
    """Measures one model under each policy, the first pose given as in the paper.

    Args:
      name: "table10".
      options: see ``Options``; with a large ``frames``, the growth of errors shows.

    Raises:
      CaperError: unknown categories, a damaged model, or data that cannot be read or drawn.
    """
    table = paper().tables[name]
    rows: list[list[str]] = []
    growth: list[list[str]] = []
    facts, result, shown = [], {}, {}
    curves: dict[str, Curves] = {}
    for key in options.category or _CATEGORIES:
        figures = {
            policy: of_policy[key]
            for policy, of_policy in table.variants.items()
            if key in of_policy
        }
        if figures:
            shown[key] = figures["dynamic"]
        errors = _measure(key, options, table.videos, table.frames)
        beside = {policy: paper_json(figure) for policy, figure in figures.items()}
        result[key] = {"paper": beside, **errors}
        facts.append(f"{key}: {errors['data']}")
        if not errors["policies"]:
            for policy, figure in figures.items():
                rows += missing_rows(key, figure, f"{policy}: {errors['data']}")
            continue
        for policy, summary in errors["policies"].items():
            rows += error_rows(key, policy, summary, figures.get(policy))
            growth += _growth_rows(key, policy, summary["growth"])
        curves |= _growth_curves(key, errors["policies"])
    header = ["category", "part", "keyframes", *ERROR_HEADER]
    tables = [Table("Errors of tracking, the first pose given", header, rows, ERROR_LABELS)]
    if growth:
        caption = "Growth of the error with the frame: least-squares slope ± its standard error"
        per = f"per {_PER_FRAMES} frames"
        header = ["category", "keyframes", "part", f"rot [deg {per}]", f"trans [% {per}]"]
        tables.append(Table(caption, header, growth, 3))
    return Report(
        title=table.title,
        tables=tables,
        facts=[
            table.measured_on(),
            *facts,
            describe_tracker(options),
            "none: every frame is a keyframe with the tracked pose, and a lost track is not "
            "started again; fixed and dynamic: a keyframe's pose comes from the static estimator",
            *TRACKING_NOTES,
            "a slope is fitted to each video, its standard error is that of their mean: frames of "
            "one video are not independent",
            *assumptions(shown, table.dataset),
        ],
        result={"categories": result},
        curves=curves,
    )


def _measure(name: str, options: Options, videos: int, frames: int) -> dict[str, Any]:
    """All policies of one category, JSON-ready; "data" says why there are none."""
    case = find_case(name, options, videos, frames)
    if isinstance(case, str):
        return {"data": case, "policies": {}}
    estimator, source = case
    summaries, condition = {}, Condition()
    for policy in POLICIES:
        tracker = Tracker(estimator, policy_config(policy, estimator, options))
        tracks = track_all(tracker, source, condition)
        summary = summarize(tracks, source, condition)
        summaries[policy] = {**summary, "growth": error_growth(tracks, source.category)}
    return {"data": source.description, "policies": summaries}


def policy_config(policy: KeyframePolicy, estimator: Estimator, options: Options) -> TrackerConfig:
    """The tracker of a policy; without keyframes, nothing rescues a track that drifts away."""
    config = replace(tracker_config(estimator, options), policy=policy)
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
    frames = np.arange(1, length)
    parts: dict[str, dict[str, Any]] = {}
    for part in (0, category.num_parts - 1):
        metrics = parts[category.parts[part]] = {}
        for metric in _CURVES:
            values = np.stack([getattr(error, metric)[1:length, part] for error in errors])
            metrics[metric] = {"mean": values.mean(0).tolist(), **slope(frames, values)}
    return {"frames": frames.tolist(), "parts": parts}


def slope(
    frames: Shaped[np.ndarray, " frames"], errors: Float[np.ndarray, "videos frames"]
) -> dict[str, float | None]:
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


def _growth_rows(category: str, policy: str, growth: Mapping[str, Any]) -> list[list[str]]:
    """One row per part of ``error_growth``."""
    rows = []
    for part, metrics in growth["parts"].items():
        texts = []
        for metric, (_, _, factor) in _CURVES.items():
            value, error = metrics[metric]["slope"], metrics[metric]["standard_error"]
            texts.append("-" if value is None else spread(value, error, 3, factor * _PER_FRAMES))
        rows.append([category, policy, part, *texts])
    return rows


def _growth_curves(category: str, policies: Mapping[str, Any]) -> dict[str, Curves]:
    """Plots of the error against the frame, one per metric."""
    plots = {}
    for metric, (name, label, factor) in _CURVES.items():
        lines = {
            f"{policy}, {part}": (
                np.array(summary["growth"]["frames"]),
                factor * np.array(metrics[metric]["mean"]),
            )
            for policy, summary in policies.items()
            for part, metrics in summary["growth"]["parts"].items()
        }
        plots[f"{category}_{name}"] = Curves(f"{category}: mean over videos", "frame", label, lines)
    return plots
