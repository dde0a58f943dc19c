"""Plots: lines and points end up in the file."""

from __future__ import annotations

import numpy as np
from PIL import Image

from caper_jax.visualization import plots
from caper_jax.visualization.plots import Curves, Panels, Scatter, write_plot


def test_curves_are_drawn(tmp_path):
    x = np.arange(50)
    lines = {"none": (x, 0.1 * x), "dynamic": (x, np.ones(50))}
    write_plot(tmp_path / "a.png", Curves("growth", "frame", "error [deg]", lines))
    with Image.open(tmp_path / "a.png") as image:
        colors = np.asarray(image.convert("RGB")).reshape(-1, 3)
    for wanted in ((31, 119, 180), (255, 127, 14)):  # matplotlib's first two colors
        assert (colors == wanted).all(1).sum() > 100


def test_panels_are_plots_in_rows_of_two(tmp_path, monkeypatch):
    """Logarithmic axes have plain numbers, and ticks at the points."""
    kept = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, path: kept.append(figure) or path)
    x, y = np.array([48.0, 100.0, 1024.0]), np.array([40.0, 9.0, 2.5])
    one = Curves("", "points", "error [deg]", {"median": (x, y)}, True, True, True)
    other = Curves("", "points", "share [%]", {"turned": (x, y)})
    write_plot(tmp_path / "p.png", Panels("title", [one, one, other]))
    (figure,) = kept
    figure.draw_without_rendering()
    first, _, last = figure.axes
    assert [label.get_text() for label in first.get_xticklabels()] == ["48", "100", "1024"]
    assert (
        (first.get_yscale(), last.get_yscale())
        == ("log", "linear")
        == (
            first.get_xscale(),
            last.get_xscale(),
        )
    )
    shown = {label.get_text() for label in first.get_yticklabels(which="both")}
    assert "10" in shown and not [text for text in shown if "$" in text]
    assert last.get_ylim()[0] == 0 and first.get_position().y0 > last.get_position().y0


def test_scatter_keeps_what_lies_beyond_its_axes(tmp_path):
    values = np.append(np.linspace(-1, 1, 200), 1e6)
    panels = {"one": (values, values, values), "other": (values, -values, values)}
    write_plot(tmp_path / "s.png", Scatter("title", "x", "y", "color", panels))
    assert (tmp_path / "s.png").stat().st_size > 10_000
