"""Plots of what an evaluation measured: lines, and points in panels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from caper_jax.reproduce.render import Curves, Scatter
from caper_jax.visualization.figures import save_figure

_SIZE, _DPI = (8.0, 4.5), 120


def write_curves(path: Path, curves: Curves) -> None:
    """Writes a PNG of lines with axes, title and legend.

    Args:
      path: the file; its folder exists.
      curves: the lines.
    """
    figure = Figure(figsize=_SIZE, dpi=_DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for label, (x, y) in curves.lines.items():
        axes.plot(x, y, label=label, linewidth=1.2)
    axes.set(title=curves.title, xlabel=curves.x_label, ylabel=curves.y_label)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path)


def training_curves(title: str, rows: Sequence[dict[str, Any]]) -> Curves:
    """Loss, and errors in degrees, of a run against its steps.

    Args:
      title: of the picture.
      rows: lines of metrics.jsonl, at least one.
    """
    lines = {}
    for name in ("loss", *(key for key in rows[-1] if key.endswith("_deg"))):
        found = [(row["step"], row[name]) for row in rows if row.get(name) is not None]
        if found:
            step, value = np.array(found, float).T
            label = f"{name[:-4].replace('_', ' ')} [deg]" if name.endswith("_deg") else name
            lines[label] = (step, value)
    return Curves(title, "step", "mean over the batches between two lines", lines)


def write_scatter(path: Path, scatter: Scatter) -> None:
    """Writes a PNG with one panel of points per label, equal axes and one color bar.

    Args:
      path: the file; its folder exists.
      scatter: the points; what lies beyond the axes (98 % of all points are within) is drawn at
        their edge.
    """
    figure = Figure(figsize=_SIZE, dpi=_DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(scatter.panels), sharex=True, sharey=True, squeeze=False)[0]
    every = np.abs(np.concatenate([np.concatenate(p) for p in scatter.panels.values()]))
    reach = max(float(np.quantile(every, 0.98)), 1e-3)
    for axes, (label, values) in zip(panels, scatter.panels.items(), strict=True):
        x, y, color = (np.clip(v, -reach, reach) for v in values)
        drawn = axes.scatter(x, y, c=color, s=5, cmap="coolwarm", vmin=-reach, vmax=reach)
        axes.set(title=label, xlabel=scatter.x_label, ylabel=scatter.y_label)
        axes.set(xlim=(-1.05 * reach, 1.05 * reach), ylim=(-1.05 * reach, 1.05 * reach))
        axes.set_aspect("equal")
        axes.grid(alpha=0.3)
    figure.colorbar(drawn, ax=panels, label=scatter.color_label, shrink=0.8)
    figure.suptitle(scatter.title)
    save_figure(figure, path)
