"""Errors apart by what makes frames hard: what is hidden of a part, how far the object is open."""

from __future__ import annotations

from typing import Any

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.evaluation.metrics import PART_METRICS, PoseErrors
from caper_jax.evaluation.summaries import align, cell, summary, turned

# Bins of paper Table 8: the share of a part that is occluded, low to high. (The paper defines its
# level as the visible share, yet calls 80-100 % highly occluded and finds it worst.)
_OCCLUSION = ((0.0, 0.4), (0.4, 0.8), (0.8, 1.0))
# Closed objects look alike from several sides: of a dishwasher's 90 deg, 4.5 are the first bin.
_OPENING = ((0.0, 0.05), (0.05, 0.25), (0.25, 1.0))


def by_occlusion(
    errors: PoseErrors, visibility: np.ndarray, category: Category
) -> list[dict[str, Any]]:
    """Errors of the parts by how much of them is hidden, JSON-ready; see ``_parts``.

    Args:
      errors: of F frames.
      visibility: [F, K] visible share of each part, NaN where unknown.
      category: names the parts.
    """
    # Rounded: files keep float32, whose 0.6 is a little more than 0.6.
    hidden = np.round(1.0 - visibility, 6)
    return [
        {"occluded": [low, high], "parts": _parts(errors, _within(hidden, low, high), category)}
        for low, high in _OCCLUSION
    ]


def by_opening(errors: PoseErrors, state: np.ndarray, category: Category) -> list[dict[str, Any]]:
    """Errors of the parts by how far the most open joint is open, JSON-ready; see ``_parts``.

    Args:
      errors: of F frames.
      state: [F, J] true joint states, radians or meters.
      category: knows the joints' limits, between which the opening is a share, and which of them is
        closed; states beyond count as the limit.
    """
    low, high = np.array([joint.limits for joint in category.joints]).T
    opening = np.clip((state - low) / (high - low), 0.0, 1.0)
    opening = 1.0 - opening if category.closed == "high" else opening
    opening = opening.max(axis=1, keepdims=True)
    opening = np.round(np.broadcast_to(opening, errors.rotation_deg.shape), 6)
    return [
        {"opened": [low, high], "parts": _parts(errors, _within(opening, low, high), category)}
        for low, high in _OPENING
    ]


def _within(shares: np.ndarray, low: float, high: float) -> np.ndarray:
    return (shares >= low) & ((shares < high) | (high == 1.0))


def _parts(errors: PoseErrors, chosen: np.ndarray, category: Category) -> list[dict[str, Any]]:
    """Per part its name, how many of [F, K] frames are chosen, and its errors in them."""
    parts = []
    for k, name in enumerate(category.parts):
        frames = chosen[:, k]
        part: dict[str, Any] = {"name": name, "frames": int(frames.sum())}
        if frames.any():
            part |= {key: summary(getattr(errors, key)[frames, k]) for key in PART_METRICS}
            part["turned"] = turned(errors.rotation_deg[frames, k])
        parts.append(part)
    return parts


def format_bins(bins: list[dict[str, Any]], key: str) -> list[str]:
    """Lines of a table, at most 80 columns, of what either function gives.

    Args:
      bins: by ``by_occlusion`` or ``by_opening``.
      key: "occluded" or "opened".
    """
    rows = [["part", key, "frames", "rotation [deg]", "translation [mm]"]]
    for number in range(len(bins[0]["parts"])):
        for content in bins:
            part = content["parts"][number]
            if part["frames"]:
                cells = [cell(part["rotation_deg"], 1, 2), cell(part["translation_m"], 1000, 1)]
                rows.append([part["name"], share(content[key]), str(part["frames"]), *cells])
    return align(rows)


def share(ends: list[float]) -> str:
    """Both ends of a bin, for people."""
    return f"{100 * ends[0]:.0f}-{100 * ends[1]:.0f} %"
