"""Plots: lines and points end up in the file."""

from __future__ import annotations

import numpy as np
from PIL import Image

from caper_jax.visualization.plots import Curves, Scatter, write_plot


def test_curves_are_drawn(tmp_path):
    x = np.arange(50)
    lines = {"none": (x, 0.1 * x), "dynamic": (x, np.ones(50))}
    write_plot(tmp_path / "a.png", Curves("growth", "frame", "error [deg]", lines))
    with Image.open(tmp_path / "a.png") as image:
        colors = np.asarray(image.convert("RGB")).reshape(-1, 3)
    for wanted in ((31, 119, 180), (255, 127, 14)):  # matplotlib's first two colors
        assert (colors == wanted).all(1).sum() > 100


def test_scatter_keeps_what_lies_beyond_its_axes(tmp_path):
    values = np.append(np.linspace(-1, 1, 200), 1e6)
    panels = {"one": (values, values, values), "other": (values, -values, values)}
    write_plot(tmp_path / "s.png", Scatter("title", "x", "y", "color", panels))
    assert (tmp_path / "s.png").stat().st_size > 10_000
