"""``bin/benchmark training``: steps of both stages on generated frames, and their memory."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from benchmarks import costs, timing
from benchmarks.arguments import positive_int
from caper_jax import machine

if TYPE_CHECKING:
    from caper_jax.config import BatchNormExtent

# Samples per second to reach on two CPU cores: fast per stage, paper with its best batch.
TARGETS = {"fast": 150, "paper": 5}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", default="laptop", help="(default: %(default)s)")
    parser.add_argument("--preset", choices=tuple(TARGETS), default="fast")
    parser.add_argument(
        "--batch",
        action="append",
        type=positive_int,
        help="samples per step, may be repeated (default: the preset's; of paper 2, 4 and 16)",
    )
    parser.add_argument(
        "--steps-per-dispatch",
        type=positive_int,
        default=1,
        metavar="N",
        help="steps compiled into one call, to hide the cost of calling (default: %(default)s)",
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=10, help="calls (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Forward, backward and update of both stages in one step that draws its own frames.

    A sample passes both stages, so ``samples_per_stage`` counts it twice: what two processors
    with one stage each would do.
    """
    default = (None,) if arguments.preset == "fast" else (2, 4, 16)
    count = arguments.steps_per_dispatch
    for batch in arguments.batch or default:
        step = make(arguments.category, arguments.preset, batch, count)
        calls = {"ours": step.call, "matmul": timing.matmul()}
        medians = timing.interleaved(calls, arguments.repeats)
        seconds = medians["ours"] / count
        yield {
            "preset": arguments.preset,
            "batch": step.batch,
            "steps/call": count,
            "samples_per_s": round(step.batch / seconds, 1),
            "samples_per_stage": round(2 * step.batch / seconds, 1),
            "target": TARGETS[arguments.preset],
            "step_ms": round(1000 * seconds, 2),
            "in_matmuls": round(seconds / medians["matmul"], 1),
            "memory_MB": round(step.megabytes),
            "compile_s": round(step.compile_seconds, 1),
            # Of several steps in a loop the compiler counts one.
            **costs.columns(step.costs, seconds),
            "load_average": machine.load_average(),
        }


@dataclass(frozen=True)
class Step:
    """A training run's step.

    Attributes:
      batch: samples per step.
      call: takes the next steps.
      costs: of one step.
      gradients: shapes of the gradients.
      reductions: sums over devices in the program.
      megabytes: that the program takes.
      compile_seconds: how long tracing and compiling took.
    """

    batch: int
    call: Callable[[], Any]
    costs: costs.Costs
    gradients: Any
    reductions: int
    megabytes: float
    compile_seconds: float


def make(
    category: str,
    preset: str,
    batch: int | None = None,
    count: int = 1,
    mesh: Any = None,
    batch_norm: BatchNormExtent = "global",
) -> Step:
    """Compiles the step of a preset.

    Args:
      category, preset: of the run.
      batch: samples per step over all devices; by default the preset's.
      count: steps per call.
      mesh: devices that share the batch.
      batch_norm: "global" or "local", see ``training.step.compile_step``.
    """
    import jax
    import numpy as np

    from caper_jax.synthetic.frames import Generator
    from caper_jax.training import parallel
    from caper_jax.training import train as training
    from caper_jax.training.objective import Objective
    from caper_jax.training.optimizer import Optimizer
    from caper_jax.training.step import TrainState, compile_step

    config = training.preset(preset, category)
    size = batch or config.training.batch_size
    task_category = training.categories.get(category)
    task = Objective(task_category, config.network, config.loss)
    data = replace(config.data, instances=200)
    generator = Generator(task_category, data, split="train")
    optimizer = Optimizer.of(config.training)
    function: Any = compile_step(
        task,
        optimizer,
        batch_fn=lambda key, bank: generator.draw(key, size, bank),
        mesh=mesh,
        batch_norm=batch_norm,
    )
    variables = task.init(jax.random.key(0))
    gradients = jax.eval_shape(lambda: variables["params"])
    sharding = parallel.one_device() if mesh is None else parallel.replicated(mesh)
    state = parallel.place(TrainState.create(variables, optimizer, 0), sharding)
    numbers = np.zeros(count, np.float32), np.ones(count, np.float32)
    *numbers, bank = parallel.place((*numbers, generator.bank), sharding)
    began = time.perf_counter()
    lowered = function.lower(state, *numbers, bank)
    compiled = lowered.compile()
    seconds = time.perf_counter() - began

    def call() -> Any:
        nonlocal state
        state, _ = compiled(state, *numbers, bank)
        return state.step

    return Step(
        size,
        call,
        costs.of(lowered, compiled),
        gradients,
        0 if mesh is None else compiled.as_text().count(" all-reduce("),
        timing.megabytes(compiled),
        seconds,
    )
