"""``caper benchmark estimator``: points to poses, both stages."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from caper_jax.cli import common
from caper_jax.cli.benchmarks import timing

# Clouds per second to reach on two CPU cores, by preset and batch.
TARGETS = {("fast", 1): 100, ("fast", 32): 200, ("paper", 1): 12}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", action="append", help="may be repeated (default: all)")
    parser.add_argument(
        "--preset",
        choices=("fast", "paper"),
        default="fast",
        help="fast: the shipped weights; paper: random ones, beside the naive formulation of the "
        "HS-Encoder (default: %(default)s)",
    )
    parser.add_argument(
        "--batch",
        action="append",
        type=common.positive_int,
        help="clouds, may be repeated (default: 1 and 32; of paper 1)",
    )
    parser.add_argument(
        "--repeats", type=common.positive_int, default=30, help="runs (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """From points [B, 1024, 3] in memory to poses there, beside a matrix product."""
    from caper_jax import categories

    for name in arguments.category or (
        categories.names() if arguments.preset == "fast" else ["laptop"]
    ):
        for batch in arguments.batch or ((1, 32) if arguments.preset == "fast" else (1,)):
            measure = _fast if arguments.preset == "fast" else _paper
            found = measure(name, batch, arguments.repeats)
            rate = batch / found["seconds"]
            yield {
                "category": name,
                "batch": batch,
                "clouds_per_s": round(rate, 1),
                "target": TARGETS.get((arguments.preset, batch), "-"),
                "ms": round(1000 * found["seconds"], 2),
                "in_matmuls": round(found["seconds"] / found["matmul"], 2),
                **found["more"],
                "load_average": timing.load_average(),
            }


def _fast(name: str, batch: int, repeats: int) -> dict[str, Any]:
    from caper_jax.cli.benchmarks.models import clouds
    from caper_jax.estimator import load

    estimator = load(name)
    points = clouds(estimator.category, batch)
    calls = {"ours": lambda: estimator(points), "matmul": timing.matmul()}
    medians = timing.interleaved(calls, repeats)
    return {"seconds": medians["ours"], "matmul": medians["matmul"], "more": {}}


def _paper(name: str, batch: int, repeats: int) -> dict[str, Any]:
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.cli.benchmarks import naive
    from caper_jax.cli.benchmarks.models import clouds, random_estimator
    from caper_jax.networks.caper import RootNetwork
    from caper_jax.networks.presets import preset

    category, network = categories.get(name), preset("paper")
    estimator = random_estimator(category, network)
    reference = random_estimator(category, network)
    points = clouds(category, batch)
    with naive.formulation():
        reference(points)  # traced and compiled here
    calls = {
        "ours": lambda: estimator(points),
        "naive": lambda: reference(points),
        "matmul": timing.matmul(),
    }
    medians = timing.interleaved(calls, repeats)

    # Of stage I, whose outputs no decision separates from its weights.
    own = {name: collection["root"] for name, collection in estimator.variables.items()}

    def outputs() -> Any:
        module = RootNetwork(network)
        return jax.jit(lambda x: module.apply(own, x, train=False))(points * category.unit)

    ours = jax.tree.leaves(outputs())
    with naive.formulation():
        others = jax.tree.leaves(outputs())
    off = max(
        float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(ours, others, strict=True)
    )
    return {
        "seconds": medians["ours"],
        "matmul": medians["matmul"],
        "more": {
            "naive_ms": round(1000 * medians["naive"], 1),
            "naive/ours": round(medians["naive"] / medians["ours"], 1),
            "difference": off,
        },
    }
