"""Tables 4, 5 and 6: errors of the tracker beside the paper's."""

from __future__ import annotations

from typing import Any

from caper_jax import categories
from caper_jax.reproduce import comparison, runs
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import FRAMES_PER_SECOND, TABLES
from caper_jax.reproduce.render import Report, Table
from caper_jax.tracker import Tracker


def run(name: str, options: Options) -> Report:
    """Measures every chosen category of a table that has a model.

    Args:
      name: "table4", "table5" or "table6".
      options: see ``Options``.

    Raises:
      CaperError: a category that the table does not have, a damaged model, or data that cannot
        be read or drawn.
    """
    paper = TABLES[name]
    figures = {key: paper.categories[key] for key in options.chosen(paper.categories)}
    rows: list[list[str]] = []
    counts: list[list[str]] = []
    facts, result = [], {}
    for key, figure in figures.items():
        found = _measure(key, options, paper.videos, paper.frames)
        result[key] = {"paper": comparison.paper_json(figure), **found}
        if found["runs"]:
            facts.append(
                f"{key}: {found['data']}, mean diagonal "
                f"{found['runs'][0]['mean_diagonal_m']:.3f} m, object masks {found['mask_source']}"
            )
        else:
            parts = categories.get(key).parts
            rows += comparison.paper_rows(key, parts, figure, found["missing"])
        for summary in found["runs"]:
            rows += comparison.rows(key, summary["label"], summary, figure)
            counts.append(comparison.counts_row(key, summary["label"], summary))
    tables = [Table("Errors of tracking", comparison.HEADER, rows, comparison.LABELS)]
    if counts:
        caption = f"The tracker at work (the paper: {1000 / FRAMES_PER_SECOND:g} ms per frame)"
        tables.append(Table(caption, comparison.COUNTS_HEADER, counts, comparison.COUNTS_LABELS))
    return Report(
        title=paper.title,
        tables=tables,
        facts=[
            paper.measured_on(),
            *facts,
            runs.describe_tracker(options),
            *comparison.COLUMNS,
            *comparison.assumptions(figures, paper.dataset),
        ],
        result={"categories": result},
    )


def _measure(name: str, options: Options, videos: int, frames: int) -> dict[str, Any]:
    """All runs of one category, JSON-ready; "missing" says why there are none."""
    case = runs.find_case(name, options, videos, frames)
    if isinstance(case, str):
        return {"missing": case, "runs": []}
    estimator, source = case
    tracker = Tracker(estimator, runs.tracker_config(estimator, options))
    found = []
    for condition in runs.conditions(options):
        tracks = runs.track_all(tracker, source, condition)
        found.append({"label": condition.label, **runs.summarize(tracks, source, condition)})
    return {
        "data": source.description,
        "mask_source": source.dataset.mask_source,
        "runs": found,
    }
