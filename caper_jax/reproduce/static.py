"""Tables 1, 2 and 3: errors of the single-frame estimator beside the paper's."""

from __future__ import annotations

from typing import Any

import numpy as np

from caper_jax import categories
from caper_jax.evaluation.breakdown import share
from caper_jax.evaluation.metrics import object_diagonal
from caper_jax.evaluation.protocol import evaluate, model_predictor
from caper_jax.evaluation.report import summarize
from caper_jax.evaluation.summaries import TURNED_DEG, cell
from caper_jax.reproduce import comparison, runs
from caper_jax.reproduce.frames import open_frames
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import TABLES
from caper_jax.reproduce.render import Report, Table, number

_LABEL = "as labeled"
HEADER = ("category", "part", "truth", *comparison.HEADER[3:])
SPREAD_HEADER = (
    *("category", "part", "truth", "rot [deg]", f"> {TURNED_DEG:.0f} deg [%]", "trans [mm]"),
    *("IoU size [%]", "IoU full [%]", "joint axis [deg]", "pivot [mm]", "state"),
)

OPENING_HEADER = (
    *("category", "open by", "frames"),
    *("root rot [deg]", f"> {TURNED_DEG:.0f} deg [%]", "root trans [mm]"),
)
_OPENING_TITLE = "The root by how far the most open joint is open, mean / median"


def run(name: str, options: Options) -> Report:
    """Measures every chosen category of a table that has a model.

    Args:
      name: "table1", "table2" or "table3".
      options: see ``Options``.

    Raises:
      CaperError: a category that the table does not have, a damaged model, or data that cannot
        be read or drawn.
    """
    paper = TABLES[name]
    figures = {key: paper.categories[key] for key in options.chosen(paper.categories)}
    rows: list[list[str]] = []
    spreads: list[list[str]] = []
    openings: list[list[str]] = []
    facts, result = [], {}
    for key, figure in figures.items():
        found = measure(key, options, paper.frames)
        result[key] = {"paper": comparison.paper_json(figure), **found}
        if "missing" in found:
            parts = categories.get(key).parts
            rows += comparison.paper_rows(key, parts, figure, found["missing"])
            continue
        facts.append(
            f"{key}: {found['data']}, mean diagonal {found['mean_diagonal_m']:.3f} m, object masks "
            f"{found['mask_source']}, {found['failures']} failures"
        )
        rows += comparison.rows(key, _LABEL, found, figure)
        spreads += spread_rows(key, _LABEL, found)
        openings += opening_rows(key, found)
        if "up_to_symmetry" in found:
            spreads += spread_rows(key, f"{_LABEL}, up to symmetry", found["up_to_symmetry"])
    tables = [Table("Mean errors of one frame", HEADER, rows, comparison.LABELS)]
    if spreads:
        tables.append(Table("All errors, mean / median", SPREAD_HEADER, spreads, comparison.LABELS))
    if openings:
        tables.append(Table(_OPENING_TITLE, OPENING_HEADER, openings, 1))
    return Report(
        title=paper.title,
        tables=tables,
        facts=[
            paper.measured_on(),
            *facts,
            "parts of the points are predicted, never given",
            *comparison.ERROR_COLUMNS,
            "means over all frames; a failed frame counts with the worst value",
            comparison.SYMMETRY,
            *comparison.assumptions(figures, paper.dataset),
        ],
        result={"categories": result},
    )


def measure(category: str, options: Options, frames: int) -> dict[str, Any]:
    """Errors of one category's model as ``summarize`` gives them; "missing" says why none.

    Also "data", for people, and "mean_diagonal_m" of the objects shown.

    Args:
      category: its name.
      options: see ``Options``.
      frames: of a generated set, where the options do not say how many.
    """
    estimator = runs.find_model(category, options.weights, options.object_scale)
    if estimator is None:
        return {"missing": runs.NO_MODEL}
    source = open_frames(options, estimator.category, frames)
    if source is None:
        return {"missing": runs.NO_DATA}
    dataset, description = source
    points = estimator.network.num_points
    found = evaluate(dataset, model_predictor(estimator), options.frames, num_points=points)
    weights = None if options.weights is None else str(options.weights)
    return {
        "data": description,
        "mean_diagonal_m": float(np.mean(object_diagonal(found.truth))),
        **summarize(found, dataset, "model", weights),
    }


def spread_rows(category: str, label: str, tables: dict[str, Any]) -> list[list[str]]:
    """One row per part, and of the joint that holds it: mean / median of every error."""
    rows = []
    for index, part in enumerate(tables["parts"]):
        cells = [
            cell(part["rotation_deg"], 1.0, 2),
            number(100 * part["turned"], 1),
            cell(part["translation_m"], 1000.0, 1),
            cell(part["iou_size"], 100.0, 1),
            cell(part["iou_full"], 100.0, 1),
        ]
        cells += joint_cells(tables, index)
        rows.append([category, part["name"], label, *cells])
    return rows


def opening_rows(category: str, found: dict[str, Any]) -> list[list[str]]:
    """One row per bin of ``breakdown.by_opening`` that has frames."""
    rows = []
    for content in found.get("by_opening", ()):
        root = content["parts"][0]
        if root["frames"]:
            cells = [
                cell(root["rotation_deg"], 1.0, 2),
                number(100 * root["turned"], 1),
                cell(root["translation_m"], 1000.0, 1),
            ]
            rows.append([category, share(content["opened"]), str(root["frames"]), *cells])
    return rows


def joint_cells(tables: dict[str, Any], part: int) -> list[str]:
    """Mean / median of the joint that holds a part: axis [deg], pivot [mm], state with its unit."""
    if part == 0:
        return ["-"] * 3
    joint = tables["joints"][part - 1]
    meters = joint["state_unit"] == "meters"
    state = cell(joint["state"], 1000.0 if meters else 1.0, 2)
    return [
        cell(joint["axis_deg"], 1.0, 2),
        cell(joint["pivot_m"], 1000.0, 1),
        f"{state} {'mm' if meters else 'deg'}",
    ]
