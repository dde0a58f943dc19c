"""What a reproduction says: tables as markdown, everything as JSON, curves for a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax.files import write_atomically


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; the first ``labels`` columns are flush left."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    labels: int = 1


@dataclass(frozen=True)
class Curves:
    """Lines of one picture: label -> (x, y)."""

    title: str
    x_label: str
    y_label: str
    lines: dict[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Scatter:
    """Points of one picture, a panel per label: label -> (x, y, color), all with equal axes."""

    title: str
    x_label: str
    y_label: str
    color_label: str
    panels: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Report:
    """A reproduction.

    Attributes:
      title: what is reproduced.
      tables: ours beside the paper's.
      facts: what it was measured on and under which assumptions, one sentence each.
      result: JSON-ready; every number of the tables, unrounded.
      curves: pictures, by the end of their file names.
    """

    title: str
    tables: Sequence[Table]
    facts: Sequence[str]
    result: dict[str, Any]
    curves: Mapping[str, Curves | Scatter] = field(default_factory=dict)


def markdown(report: Report) -> str:
    """The report as markdown that is readable as it is."""
    lines = [f"# {report.title}"]
    for table in report.tables:
        lines += ["", f"**{table.caption}**", "", *_markdown_table(table)]
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


def number(value: float | None, digits: int) -> str:
    """A cell; "-" for what there is not."""
    return "-" if value is None else f"{value:.{digits}f}"


def spread(mean: float, deviation: float | None, digits: int) -> str:
    """A cell ``mean ± deviation``."""
    return f"{mean:.{digits}f} ± {number(deviation, digits)}"


def ratio(ours: float, reference: float | None) -> float | None:
    """Ours over the reference; None without one, or where it is zero."""
    return ours / reference if reference else None


def _markdown_table(table: Table) -> list[str]:
    rows = [list(table.header), *map(list, table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rule = [
        "-" * width if k < table.labels else "-" * (width - 1) + ":"
        for k, width in enumerate(widths)
    ]
    rows.insert(1, rule)
    return [
        "| "
        + " | ".join(
            cell.ljust(width) if k < table.labels else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        + " |"
        for row in rows
    ]
