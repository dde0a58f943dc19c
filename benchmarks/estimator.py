"""``caper benchmark estimator``: points to poses, both stages."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks import costs, timing
from caper_jax import machine
from caper_jax.cli import common

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
        "--bfloat16",
        action="store_true",
        help="also with factors rounded to bfloat16: how much faster, how far off",
    )
    parser.add_argument(
        "--repeats", type=common.positive_int, default=30, help="runs (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """From points to poses on the device, beside a matrix product.

    One cloud comes from the host, as from a camera; those of a larger batch are on the device.
    """
    from caper_jax import categories

    for name in arguments.category or (
        categories.names() if arguments.preset == "fast" else ["laptop"]
    ):
        for batch in arguments.batch or ((1, 32) if arguments.preset == "fast" else (1,)):
            measure = _fast if arguments.preset == "fast" else _paper
            found = measure(name, batch, arguments.repeats, arguments.bfloat16)
            rate = batch / found["seconds"]
            yield {
                "category": name,
                "batch": batch,
                "points_on": "host" if batch == 1 else "device",
                "clouds_per_s": round(rate, 1),
                "target": TARGETS.get((arguments.preset, batch), "-"),
                "ms": round(1000 * found["seconds"], 2),
                "in_matmuls": round(found["seconds"] / found["matmul"], 2),
                **found["more"],
                **costs.columns(found["costs"], found["seconds"]),
                "load_average": machine.load_average(),
            }


def _fast(name: str, batch: int, repeats: int, rounded: bool) -> dict[str, Any]:
    import jax
    import numpy as np

    from benchmarks.models import clouds
    from caper_jax.estimator import load
    from caper_jax.lie import so3

    estimator = load(name)
    points = clouds(estimator.category, batch)
    call, cost = _call(estimator, points)
    calls, more = {"ours": call, "matmul": timing.matmul()}, {}
    if rounded:
        with jax.default_matmul_precision("bfloat16"):
            calls["rounded"], _ = _call(estimator, points)
        one, other = call().pose, calls["rounded"]().pose
        turn = np.degrees(so3.geodesic_distance(one.rotation, other.rotation)).max()
        shift = np.linalg.norm(one.translation - other.translation, axis=-1).max()
        more = {"off_deg": round(float(turn), 3), "off_mm": round(1000 * float(shift), 3)}
    medians = timing.interleaved(calls, repeats)
    if rounded:
        more["float32/bfloat16"] = round(medians["ours"] / medians["rounded"], 2)
    return {"seconds": medians["ours"], "matmul": medians["matmul"], "costs": cost, "more": more}


def _call(estimator: Any, points: Any) -> tuple[Callable[[], Any], costs.Costs]:
    """An estimate of clouds [B, N, 3], and what it costs; the program is compiled here."""
    import jax

    lowered = jax.jit(estimator.function).lower(estimator.variables, points)
    compiled = lowered.compile()
    cost = costs.of(lowered, compiled)
    if len(points) == 1:
        return lambda: compiled(estimator.variables, estimator.sampled(points)), cost
    resident = jax.device_put(points)
    return lambda: compiled(estimator.variables, resident), cost


def _paper(name: str, batch: int, repeats: int, rounded: bool) -> dict[str, Any]:
    import jax
    import numpy as np

    from benchmarks import naive
    from benchmarks.models import clouds, random_estimator
    from caper_jax import categories
    from caper_jax.config import preset
    from caper_jax.models.root import RootNetwork

    category, network = categories.get(name), preset("paper")
    estimator = random_estimator(category, network)
    reference = random_estimator(category, network)
    points = clouds(category, batch)
    ours, cost = _call(estimator, points)
    with naive.formulation():
        others_call, _ = _call(reference, points)
    calls = {
        "ours": ours,
        "naive": others_call,
        "matmul": timing.matmul(),
    }
    if rounded:
        with jax.default_matmul_precision("bfloat16"):
            calls["rounded"], _ = _call(estimator, points)
    medians = timing.interleaved(calls, repeats)

    # Of stage I, whose outputs no decision separates from its weights.
    own = {name: collection["root"] for name, collection in estimator.variables.items()}

    def outputs() -> list[Any]:
        module = RootNetwork(network)
        found = jax.jit(lambda x: module.apply(own, x, train=False))(points * category.unit)
        return jax.tree.leaves(found)

    def off(one: list[Any], other: list[Any]) -> float:
        pairs = zip(one, other, strict=True)
        return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)

    found = outputs()
    with naive.formulation():
        others = outputs()
    more = {
        "naive_ms": round(1000 * medians["naive"], 1),
        "naive/ours": round(medians["naive"] / medians["ours"], 1),
        "difference": off(found, others),
    }
    if rounded:
        with jax.default_matmul_precision("bfloat16"):
            more["bfloat16_difference"] = off(outputs(), found)
        more["float32/bfloat16"] = round(medians["ours"] / medians["rounded"], 2)
    return {"seconds": medians["ours"], "matmul": medians["matmul"], "costs": cost, "more": more}
