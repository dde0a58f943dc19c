"""How much harder the tracker finds videos that the paper does not show."""

from __future__ import annotations

from typing import Any

from caper_jax.errors import CaperError
from caper_jax.reproduce import runs
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.render import Report, Table, number, ratio
from caper_jax.tracker import Tracker

MODES = ("paper", "cam", "hard")
VIDEOS, FRAMES = 30, 30
_METRICS = (("rotation_deg", 1.0, 2), ("translation_relative", 100.0, 2), ("iou_full", 100.0, 1))


def run(name: str, options: Options) -> Report:
    """Measures categories in each mode, the first pose given.

    Args:
      name: of the reproduction.
      options: see ``Options``.

    Raises:
      CaperError: a category without a model, or --data: only generated videos have modes.
    """
    if options.data is not None:
        raise CaperError(f"{name} compares modes of generated videos; leave out --data")
    models = runs.need_models(options.category, options.weights)
    condition = runs.Condition()
    rows, facts, result = [], [], {}
    for key, estimator in models.items():
        tracker = Tracker(estimator, runs.tracker_config(estimator, options))
        found = {}
        for mode in MODES:
            videos = runs.open_videos(options, estimator.category, VIDEOS, FRAMES, mode)
            assert videos is not None  # generated ones exist for every category
            tracks = runs.track_all(tracker, videos, condition)
            found[mode] = runs.summarize(tracks, videos, condition)
            facts.append(f"{key}: {videos.description}")
        rows += mode_rows(key, found)
        result[key] = found
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
            "trans [%]: distance of part origins over the diagonal of the object's box at rest",
            runs.describe_tracker(options),
        ],
        result={"categories": result},
    )


def mode_rows(category: str, found: dict[str, dict[str, Any]]) -> list[list[str]]:
    """One row per part: each error in the three modes, and its ratio of hard to cam.

    Args:
      category: its name.
      found: mode -> from ``summarize_tracks``.
    """
    rows = []
    for index, part in enumerate(found["paper"]["parts"]):
        row = [category, part["name"]]
        for metric, factor, digits in _METRICS:
            values = [found[mode]["parts"][index][metric]["mean"] for mode in MODES]
            row += [number(factor * value, digits) for value in values]
            row.append(number(ratio(values[2], values[1]), 2))
        rows.append(row)
    return rows
