"""Runs of a tracker under the conditions of a table: models, videos, and one row's label."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.config import TrackerConfig
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load, shipped_weights
from caper_jax.evaluation.metrics import object_diagonal, pose_errors_up_to_symmetry
from caper_jax.evaluation.tracking import (
    Start,
    Track,
    joined_tables,
    summarize_tracks,
    track_video,
)
from caper_jax.models.files import CARD_FILE, read_card
from caper_jax.progress import progress
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.videos import TEST_DATA, Videos, dataset_videos, generated_videos
from caper_jax.tracker import Tracker, config_for

NO_MODEL = "no model"
NO_DATA = "no data"


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
        """For people, as a row of a table."""
        pose = "given" if self.start == "truth" else "estimated"
        return f"{pose}, part masks given" if self.given_masks else pose


def conditions(options: Options) -> list[Condition]:
    """The paper's first, then the first pose estimated, then (if asked) with part labels."""
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
    """For people."""
    if options.network_alone:
        return "tracker: the network's increments alone, without registration"
    return "tracker: the network's increments, refined by registration (beyond the paper)"


def find_model(category: str, weights: Path | None, object_scale: float = 1.0) -> Estimator | None:
    """The model of a category; None where there is none, which is no error.

    Args:
      category: its name, or FILE.py:NAME.
      weights: a model directory, or a folder with one per category, named like it; None for the
        package's own.
      object_scale: see ``estimator.load``.

    Raises:
      CaperError: unknown category, a damaged model, or a folder without any.
    """
    category = categories.get(category).name
    if weights is None:
        present = (shipped_weights() / category).is_dir()
        return load(category, None, object_scale) if present else None
    if (weights / CARD_FILE).is_file():
        same = _model_category(weights) == category
        return load(category, weights, object_scale) if same else None
    if not any(weights.glob(f"*/{CARD_FILE}")):
        raise CaperError(f"--weights {weights}: neither a model directory nor a folder of them")
    directory = weights / category
    return load(category, directory, object_scale) if directory.is_dir() else None


def need_models(
    names: Sequence[str], weights: Path | None, object_scale: float = 1.0
) -> dict[str, Estimator]:
    """The models of some categories; of all that have one, where none is named.

    Raises:
      CaperError: a named category without a model, or no model at all.
    """
    found = {
        categories.get(name).name: find_model(name, weights, object_scale)
        for name in names or categories.names()
    }
    missing = [name for name, model in found.items() if model is None]
    models = {name: model for name, model in found.items() if model is not None}
    if not models or (names and missing):
        raise CaperError(
            f"there is no model of {', '.join(missing)}; train some and pass their folder as "
            "--weights"
        )
    return models


def _model_category(directory: Path) -> Any:
    """The category that a model's card names."""
    return read_card(directory).get("category")


def open_videos(
    options: Options, category: Category, videos: int, frames: int, mode: str = "paper"
) -> Videos | None:
    """The videos to measure on; None where the data set has none of this category.

    Args:
      options: name the data set, or how to generate.
      category: to show.
      videos, frames, mode: of generated videos, as far as the options do not say otherwise.

    Raises:
      CaperError: options that contradict each other; see ``generated_videos`` and
        ``dataset_videos``.
    """
    source = options.dataset()
    if source is None:
        return generated_videos(
            options.out / "videos",
            category,
            options.mode or mode,
            options.videos or videos,
            options.frames or frames,
            options.seed,
            options.drawn(TEST_DATA),
        )
    for name in ("mode", "frames"):
        if getattr(options, name) is not None:
            raise CaperError(f"--{name} is of generated videos; leave out --data or --{name}")
    format, root, split = source
    return dataset_videos(format, root, category, split, options.videos)


def find_case(
    name: str, options: Options, videos: int, frames: int
) -> tuple[Estimator, Videos] | str:
    """The model of a category and the videos to measure it on, or why there are none.

    Args:
      name: of the category.
      options, videos, frames: see ``open_videos``.

    Raises:
      CaperError: see ``find_model`` and ``open_videos``.
    """
    estimator = find_model(name, options.weights, options.object_scale)
    if estimator is None:
        return NO_MODEL
    source = open_videos(options, estimator.category, videos, frames)
    return NO_DATA if source is None else (estimator, source)


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
    better reading of the truth, frame by frame; "parts" never has them.

    Args:
      tracks: at least one; all with ground truth.
      videos: what they went through.
      condition: under which.
    """
    category, mask_source = videos.category, videos.dataset.mask_source
    arguments = (category, condition.start, mask_source, condition.part_masks)
    found = summarize_tracks(tracks, *arguments)
    truths = [track.truth for track in tracks if track.truth is not None]
    diagonals = [object_diagonal(truth) for truth in truths]
    found["mean_diagonal_m"] = float(np.concatenate(diagonals).mean())
    if category.symmetries:
        errors = [
            pose_errors_up_to_symmetry(track.pose, truth, category)
            for track, truth in zip(tracks, truths, strict=True)
        ]
        found["up_to_symmetry"] = {
            "reasons": [symmetry.reason for symmetry in category.symmetries],
            "parts": joined_tables(errors, category)["parts"],
        }
    return found
