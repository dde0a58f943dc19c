"""``bin/benchmark start``: what one waits for before the first pose, in fresh processes."""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from typing import Any

from benchmarks.arguments import positive_int
from caper_jax import machine
from caper_jax.errors import CaperError

_IMPORT = """
import time
import jax, flax
began = time.perf_counter()
import caper_jax
print(time.perf_counter() - began)
"""

# What a command does: the cache of the commands, then three lines of the library.
_FIRST_POSE = """
import numpy as np
import caper_jax
from caper_jax.machine import keep_programs
keep_programs()
points = np.random.default_rng(0).uniform(-0.1, 0.1, (1500, 3)) + [0.0, 0.0, 0.8]
estimator = caper_jax.load("laptop")
print(np.asarray(estimator(points.astype(np.float32)).pose.rotation).shape)
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--repeats", type=positive_int, default=3, help="processes (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Whole processes, from the start of Python to its end; the import beyond jax and flax."""
    switched_off = {machine.SWITCH: "off"}
    imports = [float(_run(_IMPORT, switched_off)[1]) for _ in range(arguments.repeats)]
    bare = [_run("import jax, flax", switched_off)[0] for _ in range(arguments.repeats)]
    cold = [_run(_FIRST_POSE, switched_off)[0] for _ in range(arguments.repeats)]
    with tempfile.TemporaryDirectory() as folder:
        kept = {machine.SWITCH: "on", "XDG_CACHE_HOME": folder}
        _run(_FIRST_POSE, kept)
        warm = [_run(_FIRST_POSE, kept)[0] for _ in range(arguments.repeats)]
    reference = statistics.median(bare)
    for name, seconds, target in (
        ("import caper_jax, beyond jax and flax", imports, 0.3),
        ("first pose, compiling", cold, 6.0),
        ("first pose, programs kept", warm, 2.5),
        ("import jax, flax (reference)", bare, "-"),
    ):
        median = statistics.median(seconds)
        yield {
            "what": f"{name:<38}",
            "seconds": round(median, 2),
            "target": target,
            "in_imports": round(median / reference, 2),
            "load_average": machine.load_average(),
        }


def _run(program: str, environment: Mapping[str, str]) -> tuple[float, str]:
    """Runs Python on a program: (seconds, what it printed)."""
    inherited = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        env={**inherited, **environment},
        check=False,
    )
    if done.returncode:
        raise CaperError(f"a process to measure failed: {done.stderr.strip()[-300:]}")
    return time.perf_counter() - began, done.stdout
