"""Mean, median and share of turned frames of an error: for JSON, and as text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Beyond this a part is turned, taken for another side of itself, rather than inaccurate.
TURNED_DEG = 30.0


def summary(values: np.ndarray) -> dict[str, float | None]:
    """Mean and median; None where the error has no meaning (pivots of prismatic joints)."""
    if np.isnan(values).all():
        return {"mean": None, "median": None}
    # Nine digits: the truth's IoU is 1, not one rounding of float64 below it.
    return {
        "mean": float(f"{np.mean(values):.9g}"),
        "median": float(f"{np.median(values):.9g}"),
    }


def turned(rotation_deg: np.ndarray) -> float:
    """Share of frames in which a part is off by more than ``TURNED_DEG``."""
    return float(np.mean(rotation_deg > TURNED_DEG))


def cell(summary: dict[str, float | None], factor: float, digits: int) -> str:
    """``mean / median`` in another unit; "-" where the error has no meaning."""
    mean, median = summary["mean"], summary["median"]
    if mean is None or median is None:
        return "-"
    return f"{factor * mean:.{digits}f} / {factor * median:.{digits}f}"


def align(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines; the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *others in rows:
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]))
    return lines
