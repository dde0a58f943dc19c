"""Plots of what was measured: lines, and points in panels; and the one way to write a figure."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

_SIZE, _PANELS_SIZE, _DPI = (8.0, 4.5), (9.5, 7.0), 120


@dataclass(frozen=True)
class Curves:
    """Lines of one plot: label -> (x [N], y [N]).

    Attributes:
      log_x: logarithmic axis, whose ticks are then the points themselves.
      log_y: likewise; otherwise the axis begins at 0.
      marked: mark the points of the lines, where there are few.
    """

    title: str
    x_label: str
    y_label: str
    lines: dict[str, tuple[np.ndarray, np.ndarray]]
    log_x: bool = False
    log_y: bool = False
    marked: bool = False


@dataclass(frozen=True)
class Panels:
    """Several plots of lines in rows of two under one title."""

    title: str
    panels: Sequence[Curves]


@dataclass(frozen=True)
class Scatter:
    """Points of one plot, a panel per label: label -> (x [N], y [N], color [N]), equal axes."""

    title: str
    x_label: str
    y_label: str
    color_label: str
    panels: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Intervals:
    """Values with their intervals about zero, a panel per label: name -> (value, low, high)."""

    title: str
    panels: dict[str, dict[str, tuple[float, float, float]]]


Plot = Curves | Panels | Scatter | Intervals


def write_plot(path: str | Path, plot: Plot) -> Path:
    """Writes a PNG of lines with axes, title and legend, of points in panels, or of intervals.

    Points beyond the axes, which hold 98 % of all, are drawn at their edge.

    Args:
      path: the file; its folder is made if it does not exist.
      plot: what to draw.

    Raises:
      CaperError: the file cannot be written.
    """
    size = _PANELS_SIZE if isinstance(plot, Panels) else _SIZE
    figure = Figure(figsize=size, dpi=_DPI, facecolor="white", layout="constrained")
    if isinstance(plot, Curves):
        _draw_curves(figure.add_subplot(), plot)
    elif isinstance(plot, Panels):
        rows = -(-len(plot.panels) // 2)
        for place, curves in enumerate(plot.panels, start=1):
            _draw_curves(figure.add_subplot(rows, 2, place), curves)
        figure.suptitle(plot.title)
    elif isinstance(plot, Scatter):
        _draw_scatter(figure, plot)
    else:
        _draw_intervals(figure, plot)
    return save_figure(figure, path)


def _draw_curves(axes: Axes, curves: Curves) -> None:
    for label, (x, y) in curves.lines.items():
        axes.plot(x, y, label=label, linewidth=1.2, marker="o" if curves.marked else "", ms=4)
    axes.set(title=curves.title, xlabel=curves.x_label, ylabel=curves.y_label)
    if curves.log_x:
        axes.set_xscale("log")
        ticks = np.unique(np.concatenate([x for x, _ in curves.lines.values()]))
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    if curves.log_y:
        axes.set_yscale("log")
        # Plain numbers; between powers of ten where there are few of these.
        axes.yaxis.set_major_formatter(LogFormatter())
        axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))
    else:
        axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _draw_scatter(figure: Figure, scatter: Scatter) -> None:
    panels = figure.subplots(1, len(scatter.panels), sharex=True, sharey=True, squeeze=False)[0]
    values = np.abs(np.concatenate([np.concatenate(p) for p in scatter.panels.values()]))
    reach = max(float(np.quantile(values, 0.98)), 1e-3)
    for axes, (label, coordinates) in zip(panels, scatter.panels.items(), strict=True):
        x, y, color = (np.clip(v, -reach, reach) for v in coordinates)
        drawn = axes.scatter(x, y, c=color, s=5, cmap="coolwarm", vmin=-reach, vmax=reach)
        axes.set(title=label, xlabel=scatter.x_label, ylabel=scatter.y_label)
        axes.set(xlim=(-1.05 * reach, 1.05 * reach), ylim=(-1.05 * reach, 1.05 * reach))
        axes.set_aspect("equal")
        axes.grid(alpha=0.3)
    figure.colorbar(drawn, ax=panels, label=scatter.color_label, shrink=0.8)
    figure.suptitle(scatter.title)


def _draw_intervals(figure: Figure, intervals: Intervals) -> None:
    """One row per name, top to bottom; those that leave out zero are darker."""
    names = list(dict.fromkeys(name for panel in intervals.panels.values() for name in panel))
    width = max(_SIZE[0], 2.0 + 2.6 * len(intervals.panels))
    figure.set_size_inches(width, max(_SIZE[1], 1.5 + 0.28 * len(names)))
    panels = figure.subplots(1, len(intervals.panels), sharey=True, squeeze=False)[0]
    for axes, (label, values) in zip(panels, intervals.panels.items(), strict=True):
        axes.axvline(0.0, color="0.4", linewidth=1.0)
        for name, (value, low, high) in values.items():
            color = "0.6" if low <= 0.0 <= high else "tab:red" if value > 0 else "tab:blue"
            row = names.index(name)
            axes.plot([low, high], [row, row], color=color, linewidth=2.0)
            axes.plot([value], [row], "o", color=color, markersize=5)
        axes.set(xlabel=label)
        axes.grid(alpha=0.3, axis="x")
    panels[0].set_yticks(range(len(names)), names, fontsize=8)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    figure.suptitle(intervals.title, fontsize=10)


def training_curves(title: str, rows: Sequence[dict[str, Any]]) -> Curves:
    """Loss, and errors in degrees, of a run against its steps.

    Args:
      title: of the plot.
      rows: lines of metrics.jsonl, at least one.
    """
    lines = {}
    for name in ("loss", *(key for key in rows[-1] if key.endswith("_deg"))):
        known = [(row["step"], row[name]) for row in rows if row.get(name) is not None]
        if known:
            step, value = np.array(known, float).T
            label = f"{name[:-4].replace('_', ' ')} [deg]" if name.endswith("_deg") else name
            lines[label] = (step, value)
    return Curves(title, "step", "mean over the batches between two lines", lines)


def save_figure(figure: Figure, path: str | Path, **options: Any) -> Path:
    """Writes a figure as PNG or whatever the path's ending names; makes the folder.

    Args:
      options: as ``Figure.savefig`` takes them.

    Raises:
      CaperError: the file cannot be written, or no such format is known.
    """
    path = Path(path)
    buffer = io.BytesIO()
    try:
        figure.savefig(buffer, format=path.suffix[1:] or "png", **options)
        path.parent.mkdir(parents=True, exist_ok=True)
    except ValueError as error:
        raise CaperError(f"cannot write {path}: {error}") from error
    except OSError as error:
        raise CaperError(f"cannot write {path}: {error.strerror or error}") from error
    write_atomically(path, buffer.getvalue())
    return path
