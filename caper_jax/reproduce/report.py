"""What a reproduction reports: ours beside the paper's, as markdown, JSON and plots."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tabulate import tabulate

from caper_jax import categories
from caper_jax.files import write_atomically
from caper_jax.reproduce.paper import Figures
from caper_jax.visualization.plots import Plot

# Columns of ``error_rows`` after those that say of what: category, part and a condition.
ERROR_HEADER = (
    *("rot paper [deg]", "ours", "ratio"),
    *("trans paper [m]", "paper [%]", "ours [%]", "ratio"),
    *("IoU paper [%]", "IoU size", "IoU full"),
)
ERROR_LABELS = 3
# What these columns mean.
RELATIVE = "trans [%]: distance of part origins over the diagonal of the object's box at rest"
ERROR_NOTES = (
    "ratio: ours over the paper's, below 1 is better",
    RELATIVE,
    "IoU size: of the boxes' sizes alone, most likely the paper's 3D IoU; IoU full: exact, of the "
    "oriented boxes in the camera's frame",
    "up to symmetry: against the better of the poses that the category declares equivalent, frame "
    "by frame",
)


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; the first ``labels`` columns are flush left."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    labels: int = 1


@dataclass(frozen=True)
class Report:
    """A reproduction.

    Attributes:
      title: what is reproduced.
      tables: ours beside the paper's.
      facts: what it was measured on and under which assumptions, one sentence each.
      result: JSON-ready; every number of the tables, unrounded.
      curves: plots, by the end of their file names.
    """

    title: str
    tables: Sequence[Table]
    facts: Sequence[str]
    result: dict[str, Any]
    curves: Mapping[str, Plot] = field(default_factory=dict)


def markdown(report: Report) -> str:
    """The report as markdown that is readable as it is."""
    lines = [f"# {report.title}"]
    for table in report.tables:
        lines += ["", f"**{table.caption}**", ""]
        columns = len(table.header)
        alignment = ["left"] * table.labels + ["right"] * (columns - table.labels)
        arguments: dict[str, Any] = {"colalign": alignment} if table.rows else {}
        lines += tabulate(
            table.rows, table.header, tablefmt="pipe", disable_numparse=True, **arguments
        ).splitlines()
    lines += ["", *(f"- {fact}" for fact in report.facts)]
    return "\n".join(lines) + "\n"


def write_report(folder: Path, name: str, report: Report) -> list[Path]:
    """Writes ``<name>.md`` and ``<name>.json``; returns their paths.

    Args:
      folder: exists.
      name: of the reproduction.
      report: its result.
    """
    content = {
        "reproduction": name,
        "title": report.title,
        "facts": list(report.facts),
        **report.result,
    }
    text = json.dumps(content, indent=2, allow_nan=False)
    files = {f"{name}.md": markdown(report), f"{name}.json": text + "\n"}
    for file, written in files.items():
        write_atomically(folder / file, written.encode())
    return [folder / file for file in files]


def number(value: float | None, digits: int, factor: float = 1.0) -> str:
    """A number in another unit; "-" for what there is not."""
    return "-" if value is None else f"{factor * value:.{digits}f}"


def spread(mean: float, deviation: float | None, digits: int, factor: float = 1.0) -> str:
    """``mean ± deviation`` in another unit."""
    return f"{factor * mean:.{digits}f} ± {number(deviation, digits, factor)}"


def ratio(ours: float | None, reference: float | None) -> float | None:
    """Ours over the reference; None without one, or where it is zero."""
    return ours / reference if reference and ours is not None else None


def error_rows(
    category: str, label: str, summary: Mapping[str, Any], paper: Figures | None
) -> list[list[str]]:
    """One row per part, and another where the category has a declared symmetry.

    Args:
      category: its name.
      label: of the condition.
      summary: "parts", as ``error_tables`` gives them, and perhaps "up_to_symmetry" with the same.
      paper: figures to stand beside; None where the paper has none.
    """
    rows = [
        _error_row(category, part["name"], label, part, paper.part(index) if paper else {})
        for index, part in enumerate(summary["parts"])
    ]
    if "up_to_symmetry" in summary:
        rows += error_rows(category, f"{label}, up to symmetry", summary["up_to_symmetry"], paper)
    return rows


def missing_rows(category: str, paper: Figures, reason: str) -> list[list[str]]:
    """The paper's figures where there is nothing of ours, for a reason such as "no model"."""
    return [
        _error_row(category, name, reason, {}, paper.part(index))
        for index, name in enumerate(categories.get(category).parts)
    ]


def _error_row(
    category: str,
    part: str,
    label: str,
    ours: Mapping[str, Any],
    paper: Mapping[str, float | None],
) -> list[str]:
    mean = {key: value["mean"] for key, value in ours.items() if isinstance(value, dict)}.get
    rotation, translation = mean("rotation_deg"), mean("translation_relative")
    paper_rotation, paper_relative = paper.get("rotation_deg"), paper.get("translation_relative")
    return [
        *(category, part, label),
        number(paper_rotation, 2),
        number(rotation, 2),
        number(ratio(rotation, paper_rotation), 2),
        number(paper.get("translation_m"), 3),
        number(paper_relative, 2, 100.0),
        number(translation, 2, 100.0),
        number(ratio(translation, paper_relative), 2),
        number(paper.get("iou_percent"), 1),
        number(mean("iou_size"), 1, 100.0),
        number(mean("iou_full"), 1, 100.0),
    ]


def paper_json(figures: Figures) -> dict[str, Any]:
    """The paper's figures, and the assumption that makes them relative."""
    relative = [error / figures.diagonal_m for error in figures.translation_m]
    return {
        "rotation_deg": list(figures.rotation_deg),
        "translation_m": list(figures.translation_m),
        "assumed_diagonal_m": figures.diagonal_m,
        "translation_relative": relative,
        "iou_percent": list(figures.iou_percent),
    }


def assumptions(figures: Mapping[str, Figures], dataset: str) -> list[str]:
    """What must be assumed of the paper's objects to compare with them; nothing without figures."""
    if not figures:
        return []
    sizes = ", ".join(f"{name} {figure.diagonal_m:g} m" for name, figure in figures.items())
    return [
        f"the paper does not state the size of the objects of {dataset}; its meters are divided by "
        f"an assumed diagonal: {sizes}",
        *(
            f"{name}: the paper's objects have {len(figure.rotation_deg)} parts, ours "
            f"{categories.get(name).num_parts}; its last part stands beside each further one"
            for name, figure in figures.items()
            if len(figure.rotation_deg) != categories.get(name).num_parts
        ),
    ]
