"""``bin/benchmark loader``: what feeding from disk costs a training step."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.arguments import positive_int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", required=True)
    parser.add_argument("--data", required=True, type=Path, help="dataset's folder or .h5 file")
    parser.add_argument("--format", default="caper", help="layout of --data (default: caper)")
    parser.add_argument("--split", help="(default: all there is)")
    parser.add_argument(
        "--repeats", type=positive_int, default=100, help="steps (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Steps of the `fast` preset, in turn on one batch in memory and on batches of the loader.

    The first row pays for reading every frame once; the second finds them in memory, as all
    epochs but the first do where the set fits.
    """
    import jax
    import numpy as np

    from caper_jax.data.loader import Loader
    from caper_jax.data.readers import open_dataset
    from caper_jax.training import train as training
    from caper_jax.training.objective import Objective
    from caper_jax.training.optimizer import Optimizer
    from caper_jax.training.step import TrainState, compile_step

    config = training.preset("fast", arguments.category)
    dataset = open_dataset(arguments.format, arguments.data, arguments.category, arguments.split)
    task = Objective(dataset.category, config.network, config.loss)
    optimizer = Optimizer.of(config.training)
    step = compile_step(task, optimizer)
    state = TrainState.create(task.init(jax.random.key(0)), optimizer, 0)
    size = config.training.batch_size
    numbers = np.zeros(1, np.float32), np.ones(1, np.float32)

    with Loader(dataset, size, config.network.num_points) as loader:
        resident = jax.device_put(loader(0))
        state, _ = jax.block_until_ready(step(state, *numbers, resident))

        def timed(batch_of, at: int) -> float:
            nonlocal state
            began = time.perf_counter()
            state, _ = step(state, *numbers, batch_of(at))
            jax.block_until_ready(state.step)
            return time.perf_counter() - began

        epoch = -(-len(dataset) // size)
        for phase, start in (("first", 1), ("later", max(epoch, 1 + arguments.repeats))):
            alone, fed = [], []
            for at in range(start, start + arguments.repeats):
                alone.append(timed(lambda _: resident, at))
                fed.append(timed(loader, at))
            yield {
                "frames": phase,
                "step_ms": round(1000 * statistics.median(alone), 2),
                "fed_step_ms": round(1000 * statistics.median(fed), 2),
                "slower_%": round(100 * (statistics.median(fed) / statistics.median(alone) - 1), 1),
                "fed_samples_s": round(size / statistics.median(fed), 1),
            }
