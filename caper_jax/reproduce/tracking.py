"""Tables 4, 5 and 6: errors of the tracker beside the paper's; and how any table tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from caper_jax.config import TrackerConfig
from caper_jax.estimator import Estimator
from caper_jax.evaluation.metrics import object_diagonal, pose_errors_up_to_symmetry
from caper_jax.evaluation.tracking import (
    Start,
    Track,
    joined_tables,
    summarize_tracks,
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
)
from caper_jax.tracker import Tracker, config_for

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
      name: "table4", "table5" or "table6".
      options: see ``Options``.

    Raises:
      CaperError: a category that the table does not have, a damaged model, or data that cannot
        be read or drawn.
    """
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
