"""``bin/benchmark generator``: how fast labeled frames are drawn."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

from benchmarks import costs, timing
from benchmarks.arguments import positive_int
from caper_jax import machine
from caper_jax.cli.common import chosen_categories


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--category",
        action="append",
        help="may be repeated, listed with commas, or all (default: all)",
    )
    parser.add_argument(
        "--grid",
        action="append",
        type=positive_int,
        help="rays per side, may be repeated (default: 96 and 128)",
    )
    parser.add_argument(
        "--batch", type=positive_int, default=24, help="frames (default: %(default)s)"
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=30, help="batches (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Frames per second of ``Generator.batch``, with Kinect noise; the frames stay there."""
    import jax

    from caper_jax import categories
    from caper_jax.config import GeneratorConfig, override
    from caper_jax.synthetic.frames import Generator

    keys = [jax.random.key(index) for index in range(arguments.repeats)]
    chosen = map(categories.get, chosen_categories(arguments.category or ()))
    for category in chosen:
        for grid in arguments.grid or (96, 128):
            config = override(GeneratorConfig(instances=200, grid=grid), *arguments.settings)
            generator = Generator(category, config)
            began = time.perf_counter()
            draw = jax.jit(generator.draw, static_argnames="batch_size")
            lowered = draw.lower(keys[0], batch_size=arguments.batch, bank=generator.bank)
            compiled = lowered.compile()
            compiling = time.perf_counter() - began

            def call(index, compiled=compiled, bank=generator.bank):
                return compiled(keys[index], bank=bank)

            timing.seconds_of(partial(call, 0))  # the first finds the memory
            seconds = timing.median_seconds(call, arguments.repeats)
            yield {
                "category": category.name,
                "grid": config.grid,
                "batch": arguments.batch,
                "frames_per_s": round(arguments.batch / seconds, 1),
                "ms_per_batch": round(1000 * seconds, 2),
                "compile_s": round(compiling, 1),
                "memory_MB": round(timing.megabytes(compiled)),
                **costs.columns(costs.of(lowered, compiled), seconds),
                "load_average": machine.load_average(),
            }
