"""Medians of interleaved runs, and the references that make them ratios."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any


def seconds_of(call: Callable[[], Any]) -> float:
    """Seconds until the arrays that ``call`` returns are there."""
    import jax

    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def median_seconds(call: Callable[[int], Any], repeats: int) -> float:
    """Median time of ``call(0)``, ..., until its arrays are there; compile before."""
    return statistics.median(seconds_of(partial(call, index)) for index in range(repeats))


def interleaved(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median seconds of each call, run in turn so that a busy moment meets all of them alike.

    Each runs once before, to compile.
    """
    for call in calls.values():
        seconds_of(call)
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            seconds[name].append(seconds_of(call))
    return {name: statistics.median(values) for name, values in seconds.items()}


def matmul() -> Callable[[], Any]:
    """Reference for networks: one float32 product of 1024 x 1024 matrices (2.1 GFLOP)."""
    import jax
    import numpy as np

    matrix = jax.device_put(np.random.default_rng(0).normal(size=(1024, 1024)).astype(np.float32))
    product = jax.jit(lambda a: a @ a)
    return lambda: product(matrix)


def elementwise() -> Callable[[], Any]:
    """Reference for geometry: sine times cosine of 6 million float32 numbers."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    numbers = jax.device_put(np.linspace(0.0, 3.0, 6_000_000, dtype=np.float32))
    function = jax.jit(lambda x: jnp.sin(x) * jnp.cos(x))
    return lambda: function(numbers)


def megabytes(compiled: Any) -> float:
    """Memory (MB) of a compiled program: arguments, results and everything between."""
    use = compiled.memory_analysis()
    sizes = use.argument_size_in_bytes + use.output_size_in_bytes + use.temp_size_in_bytes
    return (sizes - use.alias_size_in_bytes) / 1e6
