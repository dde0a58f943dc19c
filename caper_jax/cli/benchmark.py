"""``caper benchmark``: how fast the parts of this program are on this machine."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from caper_jax.cli import benchmark_loader, benchmark_tracker, common


@dataclass(frozen=True)
class Benchmark:
    """One subcommand.

    Attributes:
      summary: one line for --help.
      add_arguments: adds its options to a parser.
      run: measures; yields one row after the other, each with the same keys, for table and JSON.
    """

    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], Any]
    run: Callable[[argparse.Namespace], Iterator[dict[str, Any]]]


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "benchmark",
        "Measures speed after compilation, on this machine and with whatever else runs on it:\n"
        "the load average is printed with the result.",
        [
            ("generator", "frames/s of the generator, all categories"),
            ("generator --category box --json speed.json", "one category, kept in a file"),
            ("loader --category box --data box.h5", "feeding from disk against memory"),
            ("tracker --category laptop", "frames/s of the tracker, beside the estimator"),
            ("generator --category box --set table=0.5", "with table pixels in half the masks"),
        ],
    )
    commands = parser.add_subparsers(dest="benchmark", required=True, metavar="BENCHMARK")
    for name, benchmark in BENCHMARKS.items():
        command = commands.add_parser(name, help=benchmark.summary, description=benchmark.summary)
        benchmark.add_arguments(command)
        command.add_argument(
            "--json", type=Path, metavar="FILE", help="write machine and rows there too"
        )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    if arguments.json is not None:
        common.check_folder(arguments.json.parent, "--json")
    facts = machine()
    rows: list[dict[str, Any]] = []
    for row in BENCHMARKS[arguments.benchmark].run(arguments):
        if not rows:
            print(", ".join(f"{name} {value}" for name, value in facts.items()))
            print("  ".join(f"{name:>14}" for name in row))
        print("  ".join(f"{_shown(value):>14}" for value in row.values()), flush=True)
        rows.append(row)
    if arguments.json is not None:
        from caper_jax.files import write_atomically

        report = {"benchmark": arguments.benchmark, "machine": facts, "rows": rows}
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(arguments.json, (json.dumps(report, indent=1) + "\n").encode())
    return 0


def machine() -> dict[str, Any]:
    """What a figure depends on: cores, load, versions, device."""
    import jax

    # What this process may use, where the system says so.
    affinity = getattr(os, "sched_getaffinity", None)
    return {
        "cores": os.cpu_count() if affinity is None else len(affinity(0)),
        "load_average": _load(),
        "jax": jax.__version__,
        "device": f"{jax.devices()[0].device_kind} x {jax.device_count()}",
    }


def median_seconds(call: Callable[[int], Any], repeats: int) -> float:
    """Median time of ``call(0)``, ..., until its arrays are there; compile before."""
    import jax

    seconds = []
    for index in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(call(index))
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


def _load() -> float:
    """Processes that wanted to run, mean over the last minute."""
    return round(os.getloadavg()[0], 2)


def _shown(value: Any) -> str:
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def _generator_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", action="append", help="may be repeated (default: all)")
    parser.add_argument(
        "--grid",
        action="append",
        type=common.positive_int,
        help="rays per side, may be repeated (default: 96 and 128)",
    )
    parser.add_argument(
        "--batch", type=common.positive_int, default=24, help="frames (default: %(default)s)"
    )
    parser.add_argument(
        "--repeats", type=common.positive_int, default=30, help="batches (default: %(default)s)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="another value of the [data] section, e.g. table=0.5, may be repeated",
    )


def _run_generator(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Frames per second of ``Generator.batch``, with Kinect noise."""
    import jax

    from caper_jax import categories
    from caper_jax.configuration import override
    from caper_jax.data.synthetic.config import GeneratorConfig
    from caper_jax.data.synthetic.scene import Generator

    chosen = [categories.get(name) for name in arguments.category or categories.names()]
    for category in chosen:
        for grid in arguments.grid or (96, 128):
            config = override(GeneratorConfig(instances=200, grid=grid), *arguments.set)
            generator = Generator(category, config)

            def call(index, generator=generator):
                return generator.batch(jax.random.key(index), arguments.batch)

            compiling = median_seconds(call, 1)
            seconds = median_seconds(call, arguments.repeats)
            yield {
                "category": category.name,
                "grid": config.grid,
                "frames_per_s": round(arguments.batch / seconds, 1),
                "ms_per_batch": round(1000 * seconds, 2),
                "compile_s": round(compiling, 1),
                "load_average": _load(),
            }


BENCHMARKS = {
    "generator": Benchmark(
        "frames/s of the generator per category, with Kinect noise",
        _generator_arguments,
        _run_generator,
    ),
    "loader": Benchmark(
        "what feeding from disk costs a training step of the fast preset",
        benchmark_loader.add_arguments,
        benchmark_loader.run,
    ),
    "tracker": Benchmark(
        "one step of the tracker against one single-frame estimate, batch 1",
        benchmark_tracker.add_arguments,
        benchmark_tracker.run,
    ),
}
