"""``bin/benchmark iou``: exact intersection over union of oriented boxes."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks import timing
from benchmarks.arguments import positive_int
from caper_jax import machine

TARGET = 20_000  # pairs per second on two CPU cores


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--pairs", type=positive_int, default=4096, help="at once (default: %(default)s)"
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=10, help="runs (default: %(default)s)"
    )


def call(pairs: int) -> Callable[[], Any]:
    """The overlap of so many pairs of boxes that cut each other, as one call."""
    import jax
    import numpy as np

    from caper_jax.geometry import boxes
    from caper_jax.lie import so3

    rng = np.random.default_rng(0)

    def one() -> list[Any]:
        turns = rng.normal(size=(pairs, 3)).astype(np.float32)
        centers = rng.uniform(-0.1, 0.1, (pairs, 3)).astype(np.float32)
        sizes = rng.uniform(0.1, 0.5, (pairs, 3)).astype(np.float32)
        return [jax.jit(so3.exp)(turns), *jax.device_put((centers, sizes))]

    given = (*one(), *one())
    return lambda: boxes.iou_full(*given)


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Pairs in one batch, beside a matrix product."""
    calls = {"ours": call(arguments.pairs), "matmul": timing.matmul()}
    medians = timing.interleaved(calls, arguments.repeats)
    yield {
        "pairs": arguments.pairs,
        "pairs_per_s": round(arguments.pairs / medians["ours"]),
        "target": TARGET,
        "ms": round(1000 * medians["ours"], 2),
        "in_matmuls": round(medians["ours"] / medians["matmul"], 2),
        "load_average": machine.load_average(),
    }
