"""``bin/benchmark estimator``: points to poses, both stages."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks import costs, timing
from benchmarks.arguments import positive_int
from caper_jax import machine

# Clouds per second to reach on two CPU cores, by preset and batch.
TARGETS = {("fast", 1): 100, ("fast", 32): 200, ("paper", 1): 12}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--category",
        action="append",
        help="may be repeated, listed with commas, or all (default: all)",
    )
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
        type=positive_int,
        help="clouds, may be repeated (default: 1 and 32; of paper 1)",
    )
    parser.add_argument(
        "--bfloat16",
        action="store_true",
        help="also with factors rounded to bfloat16: how much faster, how far off",
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=30, help="runs (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """From points to poses on the device, beside a matrix product.

    One cloud comes from the host, as from a camera; those of a larger batch are on the device.
    """
    from caper_jax.cli.common import chosen_categories

    given = arguments.category or ([] if arguments.preset == "fast" else ["laptop"])
    for name in chosen_categories(given):
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
    """Random weights of the published sizes; its encoder also in the naive formulation."""
    import jax
    import numpy as np

    from benchmarks.models import clouds, encoders, random_estimator
    from caper_jax import categories
    from caper_jax.config import preset

    category, network = categories.get(name), preset("paper").network
    estimator = random_estimator(category, network)
    points = clouds(category, batch)
    call, cost = _call(estimator, points)
    calls: dict[str, Callable[[], Any]] = {"ours": call, "matmul": timing.matmul()}
    if rounded:
        with jax.default_matmul_precision("bfloat16"):
            calls["rounded"], _ = _call(estimator, points)
    variables, fast, naive = encoders(network.hs, points * category.unit)
    fast_encoder, naive_encoder = jax.jit(fast), jax.jit(naive)
    calls["encoder"] = lambda: fast_encoder(variables)
    calls["naive"] = lambda: naive_encoder(variables)
    one, other = np.asarray(calls["encoder"]()), np.asarray(calls["naive"]())
    medians = timing.interleaved(calls, repeats)
    more = {
        "encoder_ms": round(1000 * medians["encoder"], 1),
        "naive_ms": round(1000 * medians["naive"], 1),
        "naive/encoder": round(medians["naive"] / medians["encoder"], 1),
        "difference": float(np.abs(one - other).max() / np.abs(other).max()),
    }
    if rounded:
        more["float32/bfloat16"] = round(medians["ours"] / medians["rounded"], 2)
    return {"seconds": medians["ours"], "matmul": medians["matmul"], "costs": cost, "more": more}
