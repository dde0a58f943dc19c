"""Rows of ours beside the paper's, part by part; shared by all tables of errors."""

from __future__ import annotations

from typing import Any

from caper_jax import categories
from caper_jax.reproduce.paper import Figures
from caper_jax.reproduce.render import number, ratio

HEADER = (
    *("category", "part", "first pose"),
    *("rot paper [deg]", "ours", "ratio"),
    *("trans paper [m]", "paper [%]", "ours [%]", "ratio"),
    *("IoU paper [%]", "IoU size", "IoU full"),
)
LABELS = 3
COUNTS_HEADER = (
    *("category", "first pose", "frames", "keyframes", "static estimates"),
    *("lost", "ms per frame"),
)
COUNTS_LABELS = 2
# What the columns mean, beneath every table that has them.
ERROR_COLUMNS = (
    "ratio: ours over the paper's, below 1 is better",
    "trans [%]: distance of part origins over the diagonal of the object's box at rest",
    "IoU size: of the boxes' sizes alone, most likely the paper's 3D IoU; IoU full: exact, of the "
    "oriented boxes in the camera's frame",
)
SYMMETRY = (
    "up to symmetry: against the better of the readings that the category declares equally right, "
    "frame by frame"
)
COLUMNS = (
    *ERROR_COLUMNS,
    "means over all frames of all videos but the first of each; a lost frame counts with the pose "
    "that was held",
    SYMMETRY,
)


def rows(
    category: str, label: str, summary: dict[str, Any], paper: Figures | None
) -> list[list[str]]:
    """One row per part, and another where the category has a declared symmetry.

    Args:
      category: its name.
      label: of the condition.
      summary: from ``runs.summarize``.
      paper: figures to stand beside; None where the paper has none.
    """
    table = _part_rows(category, label, summary["parts"], paper)
    if "up_to_symmetry" in summary:
        symmetric = summary["up_to_symmetry"]["parts"]
        table += _part_rows(category, f"{label}, up to symmetry", symmetric, paper)
    return table


def _part_rows(
    category: str, label: str, parts: list[dict[str, Any]], paper: Figures | None
) -> list[list[str]]:
    table = []
    for index, part in enumerate(parts):
        turn, shift = part["rotation_deg"]["mean"], part["translation_relative"]["mean"]
        cells: list[float | None] = [None] * 4
        if paper is not None:
            other = paper.beside(index)
            cells = [
                paper.rotation_deg[other],
                paper.translation_m[other],
                paper.translation_relative()[other],
                paper.iou[other] if paper.iou else None,
            ]
        paper_turn, meters, relative, iou = cells
        table.append(
            [
                *(category, part["name"], label),
                *(number(paper_turn, 2), number(turn, 2), number(ratio(turn, paper_turn), 2)),
                number(meters, 3),
                number(None if relative is None else 100 * relative, 2),
                *(number(100 * shift, 2), number(ratio(shift, relative), 2)),
                number(iou, 1),
                number(100 * part["iou_size"]["mean"], 1),
                number(100 * part["iou_full"]["mean"], 1),
            ]
        )
    return table


def paper_rows(
    category: str, parts: tuple[str, ...], paper: Figures, reason: str
) -> list[list[str]]:
    """The paper's figures where there is nothing of ours, for a reason such as "no model"."""
    table = []
    for index, part in enumerate(parts):
        other = paper.beside(index)
        iou = paper.iou[other] if paper.iou else None
        table.append(
            [
                *(category, part, reason),
                *(number(paper.rotation_deg[other], 2), "-", "-"),
                number(paper.translation_m[other], 3),
                *(number(100 * paper.translation_relative()[other], 2), "-", "-"),
                *(number(iou, 1), "-", "-"),
            ]
        )
    return table


def counts_row(category: str, label: str, summary: dict[str, Any]) -> list[str]:
    """What the tracker did, and how fast."""
    return [
        *(category, label),
        *(str(summary[key]) for key in ("frames", "keyframes", "estimated", "lost")),
        number(1000 * summary["median_seconds_per_frame"], 1),
    ]


def paper_json(paper: Figures) -> dict[str, Any]:
    """The paper's figures, and the assumption that makes them relative."""
    return {
        "rotation_deg": list(paper.rotation_deg),
        "translation_m": list(paper.translation_m),
        "assumed_diagonal_m": paper.diagonal_m,
        "translation_relative": list(paper.translation_relative()),
        "iou_percent": list(paper.iou),
    }


def assumptions(figures: dict[str, Figures], dataset: str) -> list[str]:
    """What must be assumed of the paper's objects to compare with them, for people."""
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
