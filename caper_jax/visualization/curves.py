"""Line plots of what an evaluation measured."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from caper_jax.evaluation.tables.render import Curves
from caper_jax.files import write_atomically

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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomically(path, buffer.getvalue())
