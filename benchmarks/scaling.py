"""``bin/benchmark scaling``: time and memory as points, parts and batch grow."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks import timing
from benchmarks.arguments import positive_int
from caper_jax import machine
from caper_jax.cli.common import check_folder

SIZES = {
    "points": (256, 512, 1024, 2048, 4096, 8192, 16384),
    "parts": (2, 4, 8, 16),
    "batch": (1, 4, 16, 64),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--preset", choices=("fast", "paper"), default="fast")
    parser.add_argument(
        "--vary", action="append", choices=tuple(SIZES), help="may be repeated (default: all)"
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the rows there (PNG)")
    parser.add_argument(
        "--repeats", type=positive_int, default=5, help="runs (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The estimator with random weights; 1,024 points, 2 parts and batch 1 where not said."""
    if arguments.plot is not None:
        check_folder(arguments.plot.parent, "--plot")
    rows = []
    for varied in arguments.vary or SIZES:
        for size in SIZES[varied]:
            sizes = {"points": 1024, "parts": 2, "batch": 1, varied: size}
            seconds, memory = _measure(arguments.preset, **sizes, repeats=arguments.repeats)
            row = {
                "varied": varied,
                "size": size,
                "ms": round(1000 * seconds, 2),
                "us_per_unit": round(1e6 * seconds / size, 2),
                "memory_MB": round(memory, 1),
                "load_average": machine.load_average(),
            }
            rows.append(row)
            yield row
    if arguments.plot is not None:
        _draw(arguments.plot, rows, arguments.preset)


def _measure(preset: str, points: int, parts: int, batch: int, repeats: int) -> tuple[float, float]:
    """(seconds per call, MB that the compiled program takes)."""
    import dataclasses

    import jax
    import numpy as np

    from benchmarks.models import chain, random_estimator
    from caper_jax import config

    network = dataclasses.replace(config.preset(preset).network, num_points=points)
    estimator = random_estimator(chain(parts), network)
    rng = np.random.default_rng(0)
    clouds = (rng.uniform(-0.2, 0.2, (batch, points, 3)) + [0.0, 0.0, 1.0]).astype(np.float32)
    function = jax.jit(estimator.function)
    compiled = function.lower(estimator.variables, clouds).compile()
    clouds = jax.device_put(clouds)
    seconds = timing.interleaved({"": lambda: compiled(estimator.variables, clouds)}, repeats)[""]
    return seconds, timing.megabytes(compiled)


def _draw(path: Path, rows: Sequence[dict[str, Any]], preset: str) -> None:
    """Time and memory over each size, on logarithmic axes."""
    from matplotlib.figure import Figure

    from caper_jax.visualization.plots import save_figure

    names = list(dict.fromkeys(row["varied"] for row in rows))
    figure = Figure(figsize=(3.6 * len(names), 5.2), layout="constrained")
    quantities = (("ms", "time [ms]"), ("memory_MB", "memory [MB]"))
    grid = figure.subplots(len(quantities), len(names), squeeze=False)
    for column, name in enumerate(names):
        own = [row for row in rows if row["varied"] == name]
        for axes, (key, label) in zip(grid[:, column], quantities, strict=True):
            sizes = [row["size"] for row in own]
            values = [row[key] for row in own]
            axes.loglog(sizes, values, marker="o", base=2)
            for place in zip(sizes, values, strict=True):
                axes.annotate(
                    f"{place[1]:.3g}",
                    place,
                    (0, 6),
                    textcoords="offset points",
                    ha="center",
                    fontsize=8,
                )
            axes.set_yticks([])
            axes.margins(0.12, 0.2)
            axes.set_xticks(sizes, [str(size) for size in sizes], fontsize=8)
            axes.minorticks_off()
            axes.set_xlabel(name)
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
    figure.suptitle(f"estimator, {preset}: 1,024 points, 2 parts, batch 1 where not varied")
    save_figure(figure, path, dpi=100)
