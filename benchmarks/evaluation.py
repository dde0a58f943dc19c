"""``bin/benchmark evaluation``: evaluating a file of frames against the estimator alone."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks import timing
from benchmarks.arguments import positive_int
from caper_jax import machine

TARGET_PERCENT = 90


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", default="box", help="(default: %(default)s)")
    parser.add_argument(
        "--frames", type=positive_int, default=1000, help="of the file (default: %(default)s)"
    )
    parser.add_argument(
        "--batch", type=positive_int, default=32, help="clouds per call (default: %(default)s)"
    )
    parser.add_argument(
        "--points",
        type=positive_int,
        default=4096,
        help="per frame of the file (default: %(default)s)",
    )
    parser.add_argument(
        "--grid",
        type=positive_int,
        default=96,
        help="rays per side of the file's frames (default: %(default)s)",
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=5, help="runs (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Frames per second from a file to all errors, in turn with estimates of resident clouds.

    Both see as many batches of the same size, the evaluation those of the file: it also reads,
    samples and measures. Each compiles before.
    """
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.config import GeneratorConfig
    from caper_jax.data import hdf5
    from caper_jax.estimator import load
    from caper_jax.evaluation.protocol import evaluate
    from caper_jax.synthetic.frames import Generator, collect_frames

    category = categories.get(arguments.category)
    estimator = load(category)
    batches = -(-arguments.frames // arguments.batch)
    config = GeneratorConfig(
        instances=min(arguments.frames, 100), grid=arguments.grid, num_points=arguments.points
    )
    estimate = jax.jit(estimator.function)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.h5"
        drawn = collect_frames(Generator(category, config, "test"), 0, arguments.frames)
        hdf5.write(path, category=category, split="test", **drawn)
        dataset = hdf5.Hdf5Dataset(path)
        some = np.resize(drawn["points"], (arguments.batch, *drawn["points"].shape[1:]))
        resident = jax.device_put(estimator.sampled(some))

        def estimated() -> None:
            for _ in range(batches):
                jax.block_until_ready(estimate(estimator.variables, resident))

        def evaluated() -> None:
            evaluate(dataset, estimator, batch_size=arguments.batch)

        # The last batch is full as well for the device.
        frames = batches * arguments.batch
        medians = timing.interleaved(
            {"estimates": estimated, "evaluation": evaluated}, arguments.repeats
        )
    yield {
        "category": category.name,
        "frames": arguments.frames,
        "batch": arguments.batch,
        "estimates_per_s": round(frames / medians["estimates"], 1),
        "evaluated_per_s": round(frames / medians["evaluation"], 1),
        "ratio_%": round(100 * medians["estimates"] / medians["evaluation"], 1),
        "target_%": TARGET_PERCENT,
        "load_average": machine.load_average(),
    }
