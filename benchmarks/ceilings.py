"""``bin/benchmark ceilings``: what the device does at most, measured by large operations."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from benchmarks import timing
from benchmarks.arguments import positive_int
from caper_jax import machine

# Rows and columns of the matrices, and numbers copied: large enough that a call costs nothing
# beside its work and that no cache holds them, small enough for a processor's patience.
_SIZES = {"accelerator": (8192, 2**28), "cpu": (1024, 2**25)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--size",
        type=positive_int,
        help="rows of the matrices (default: 8192, on a CPU 1024)",
    )
    parser.add_argument(
        "--numbers",
        type=positive_int,
        help="float32 numbers that are copied (default: 2^28, on a CPU 2^25)",
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=20, help="runs (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A copy and matrix products in turn, on random numbers: zeros cost less power than data do.

    Where the hardware has it, a float32 product at default precision rounds its factors (TF32 on
    NVIDIA); "highest" does not.
    """
    size, numbers = sizes()
    size, numbers = arguments.size or size, arguments.numbers or numbers
    medians = timing.interleaved(calls(size, numbers), arguments.repeats)
    for name, seconds in medians.items():
        copies = name == "copy"
        yield {
            "what": f"{name:<24}",
            "size": numbers if copies else size,
            "ms": round(1000 * seconds, 3),
            "GFLOP/s": "-" if copies else round(product_flops(size) / seconds / 1e9, 1),
            "GB/s": round(copied_bytes(numbers) / seconds / 1e9, 1) if copies else "-",
            "load_average": machine.load_average(),
        }


def sizes() -> tuple[int, int]:
    """(rows of the matrices, numbers to copy) that suit this device."""
    import jax

    return _SIZES["cpu" if jax.default_backend() == "cpu" else "accelerator"]


def product_flops(size: int) -> int:
    """Of a product of square matrices: a multiplication and an addition per term."""
    return 2 * size**3


def copied_bytes(numbers: int) -> int:
    """Of a copy of float32 numbers: each is read and written."""
    return 2 * 4 * numbers


def calls(size: int, numbers: int) -> dict[str, Callable[[], Any]]:
    """The operations by name, their data on the device."""
    import jax
    import jax.numpy as jnp

    keys = jax.random.split(jax.random.key(0), 3)
    a, b = (jax.random.normal(key, (size, size)) for key in keys[:2])
    low = a.astype(jnp.bfloat16), b.astype(jnp.bfloat16)
    values = jax.random.normal(keys[2], (numbers,))
    # Negated: the compiler might leave out a bare copy.
    copy = jax.jit(lambda x: -x)
    product = jax.jit(lambda x, y: x @ y)
    exact = jax.jit(lambda x, y: jnp.matmul(x, y, precision="highest"))
    return {
        "copy": lambda: copy(values),
        "product, float32": lambda: product(a, b),
        "product, float32 highest": lambda: exact(a, b),
        "product, bfloat16": lambda: product(*low),
    }


@cache
def rates() -> tuple[float, float]:
    """(FLOP/s of a float32 product at default precision, bytes/s of a copy); measured once."""
    size, numbers = sizes()
    every = calls(size, numbers)
    medians = timing.interleaved({key: every[key] for key in ("product, float32", "copy")}, 10)
    return (
        product_flops(size) / medians["product, float32"],
        copied_bytes(numbers) / medians["copy"],
    )
