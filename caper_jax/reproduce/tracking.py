"""Tables 4, 5, 6 and 10: errors of the tracker beside the paper's; and how any table tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from caper_jax.articulation.category import Category
from caper_jax.config import KeyframePolicy, TrackerConfig
from caper_jax.estimator import Estimator
from caper_jax.evaluation.metrics import object_diagonal, pose_errors_up_to_symmetry
from caper_jax.evaluation.tracking import (
    Start,
    Track,
    joined_tables,
    summarize_tracks,
    track_errors,
    track_video,
)
from caper_jax.progress import progress
from caper_jax.reproduce.data import Videos, find_case
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import paper
from caper_jax.reproduce.report import (
    ERROR_HEADER,
    ERROR_LABELS,
    ERROR_NOTES,
    Report,
    Table,
    assumptions,
    error_rows,
    missing_rows,
    number,
    paper_json,
    spread,
)
from caper_jax.tracker import Tracker, config_for
from caper_jax.visualization.plots import Curves

TRACKING_NOTES = (
    *ERROR_NOTES,
    "means over all frames of all videos but the first of each; a lost frame counts with the pose "
    "that was held",
)
_COUNTS = ("frames", "keyframes", "estimated", "lost")
_COUNTS_HEADER = (
    *("category", "first pose", "frames", "keyframes", "static estimates"),
    *("lost", "ms per frame"),
)

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


@dataclass(frozen=True)
class Condition:
    """What a tracker is given besides the clouds.

    Attributes:
      start: see ``track_video``.
      given_masks: hand over the data's part labels.
    """

    start: Start = "truth"
    given_masks: bool = False

    @property
    def part_masks(self) -> str:
        return "given" if self.given_masks else "predicted"

    @property
    def label(self) -> str:
        """In a row of a table."""
        pose = "given" if self.start == "truth" else "estimated"
        return f"{pose}, part masks given" if self.given_masks else pose


def run(name: str, options: Options) -> Report:
    """Measures every chosen category of a table that has a model.

    Args:
      name: "table4", "table5", "table6", or "table10", which compares policies of keyframes.
      options: see ``Options``.

    Raises:
      CaperError: a category that the table does not have, a damaged model, or data that cannot
        be read or drawn.
    """
    if name == "table10":
        return _keyframes(options)
    table = paper().tables[name]
    figures = {key: table.categories[key] for key in options.chosen(table.categories)}
    rows: list[list[str]] = []
    counts: list[list[str]] = []
    facts: list[str] = []
    result: dict[str, dict[str, Any]] = {}
    for key, figure in figures.items():
        case = find_case(key, options, table.videos, table.frames)
        result[key] = {"paper": paper_json(figure)}
        if isinstance(case, str):
            result[key] |= {"missing": case, "runs": []}
            rows += missing_rows(key, figure, case)
            continue
        estimator, videos = case
        tracker = Tracker(estimator, tracker_config(estimator, options))
        runs = []
        for condition in conditions(options):
            summary = summarize(track_all(tracker, videos, condition), videos, condition)
            runs.append({"label": condition.label, **summary})
            rows += error_rows(key, condition.label, summary, figure)
            milliseconds = number(summary["median_seconds_per_frame"], 1, 1000.0)
            texts = [str(summary[count]) for count in _COUNTS]
            counts.append([key, condition.label, *texts, milliseconds])
        mask_source = videos.dataset.mask_source
        result[key] |= {"data": videos.description, "mask_source": mask_source, "runs": runs}
        facts.append(
            f"{key}: {videos.description}, mean diagonal {runs[0]['mean_diagonal_m']:.3f} m, "
            f"object masks {mask_source}"
        )
    header = ("category", "part", "first pose", *ERROR_HEADER)
    tables = [Table("Errors of tracking", header, rows, ERROR_LABELS)]
    if counts:
        milliseconds = f"{1000 / paper().frames_per_second:g}"
        caption = f"The tracker at work (the paper: {milliseconds} ms per frame)"
        tables.append(Table(caption, _COUNTS_HEADER, counts, 2))
    return Report(
        title=table.title,
        tables=tables,
        facts=[
            table.measured_on(),
            *facts,
            describe_tracker(options),
            *TRACKING_NOTES,
            *assumptions(figures, table.dataset),
        ],
        result={"categories": result},
    )


def conditions(options: Options) -> list[Condition]:
    """The paper's first, then the first pose estimated, then, with --given-masks, these too."""
    rows = [Condition(), Condition("estimator")]
    return rows + [Condition(given_masks=True)] if options.given_masks else rows


def tracker_config(estimator: Estimator, options: Options) -> TrackerConfig:
    """The model's own, or the one whose poses are the network's increments alone."""
    config = config_for(estimator)
    return network_alone(config) if options.network_alone else config


def network_alone(config: TrackerConfig) -> TrackerConfig:
    """Without registration: the paper's tracker."""
    return replace(config, registration=replace(config.registration, steps=0))


def describe_tracker(options: Options) -> str:
    """The tracker of ``tracker_config``, as a line of a report."""
    if options.network_alone:
        return "tracker: the network's increments alone, without registration"
    return "tracker: the network's increments, refined by registration (beyond the paper)"


def track_all(tracker: Tracker, videos: Videos, condition: Condition) -> list[Track]:
    """Tracks through every video."""
    tracks = []
    title = f"tracking {videos.category.name} (first pose {condition.label})"
    with progress(title, total=len(videos.index)) as bar:
        for name in videos.index:
            arguments = (name, videos.frames(name), condition.start, condition.given_masks)
            tracks.append(track_video(tracker, *arguments))
            bar.update(1)
    return tracks


def summarize(tracks: Sequence[Track], videos: Videos, condition: Condition) -> dict[str, Any]:
    """Metrics of the tracks over all frames but the first, JSON-ready.

    Besides those of ``summarize_tracks``: "mean_diagonal_m" of the objects shown and, for a
    category with declared symmetries, "up_to_symmetry" with the errors of the parts against the
    better of the equivalent truths, frame by frame; "parts" never has them.

    Args:
      tracks: at least one; all with ground truth.
      videos: what they went through.
      condition: under which.
    """
    category, mask_source = videos.category, videos.dataset.mask_source
    summary = summarize_tracks(tracks, category, condition.start, mask_source, condition.part_masks)
    truths = [track.truth for track in tracks if track.truth is not None]
    diagonals = [object_diagonal(truth) for truth in truths]
    summary["mean_diagonal_m"] = float(np.concatenate(diagonals).mean())
    if category.symmetries:
        errors = [
            pose_errors_up_to_symmetry(track.pose, truth, category)
            for track, truth in zip(tracks, truths, strict=True)
        ]
        summary["up_to_symmetry"] = {
            "reasons": [symmetry.reason for symmetry in category.symmetries],
            "parts": joined_tables(errors, category)["parts"],
        }
    return summary


def _keyframes(options: Options) -> Report:
    """Measures one model under each policy, the first pose given as in the paper.

    With a large ``frames``, the growth of errors shows.
    """
    table = paper().tables["table10"]
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
