"""``caper benchmark training``: steps of both stages on generated frames, and their memory."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from typing import Any

from caper_jax.cli import common
from caper_jax.cli.benchmarks import timing

# Samples per second to reach on two CPU cores: fast per stage, paper with its best batch.
TARGETS = {"fast": 150, "paper": 5}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", default="laptop", help="(default: %(default)s)")
    parser.add_argument("--preset", choices=tuple(TARGETS), default="fast")
    parser.add_argument(
        "--batch",
        action="append",
        type=common.positive_int,
        help="samples per step, may be repeated (default: the preset's; of paper 2, 4 and 16)",
    )
    parser.add_argument(
        "--repeats", type=common.positive_int, default=10, help="steps (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Forward, backward and update of both stages in one step that draws its own frames.

    A sample passes both stages, so ``samples_per_stage`` counts it twice: what two processors
    with one stage each would do.
    """
    default = (None,) if arguments.preset == "fast" else (2, 4, 16)
    for batch in arguments.batch or default:
        batch, call, compiled = step(arguments.category, arguments.preset, batch)
        calls = {"ours": call, "matmul": timing.matmul()}
        medians = timing.interleaved(calls, arguments.repeats)
        yield {
            "preset": arguments.preset,
            "batch": batch,
            "samples_per_s": round(batch / medians["ours"], 1),
            "samples_per_stage": round(2 * batch / medians["ours"], 1),
            "target": TARGETS[arguments.preset],
            "step_ms": round(1000 * medians["ours"], 1),
            "in_matmuls": round(medians["ours"] / medians["matmul"], 1),
            "memory_MB": round(timing.megabytes(compiled)),
            "load_average": timing.load_average(),
        }


def step(category: str, preset: str, batch: int | None) -> tuple[int, Callable[[], Any], Any]:
    """A training run's step: (batch size, a call that takes the next one, the program)."""
    import dataclasses

    import jax
    import numpy as np

    from caper_jax.data.synthetic.scene import Generator
    from caper_jax.training import run as training
    from caper_jax.training.state import TrainState, make_step
    from caper_jax.training.task import Task

    config = training.preset(preset, category)
    size = batch or config.training.batch_size
    task_category = training.categories.get(category)
    task = Task(task_category, config.network, config.loss)
    data = dataclasses.replace(config.data, instances=200)
    generator = Generator(task_category, data, split="train")
    optimizer = config.training.build_optimizer()
    function: Any = make_step(
        task.loss, optimizer, batch_fn=lambda key, bank: generator.draw(key, size, bank)
    )
    state = TrainState.create(task.init(jax.random.key(0)), optimizer, 0)
    numbers = np.zeros(1, np.float32), np.ones(1, np.float32)
    compiled = function.lower(state, *numbers, generator.bank).compile()

    def call() -> Any:
        nonlocal state
        state, _ = compiled(state, *numbers, generator.bank)
        return state.step

    return size, call, compiled
