"""``bin/benchmark``: how fast the parts of this program are on this machine."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.arguments import create_parser
from caper_jax.cli import common
from caper_jax.errors import CaperError
from caper_jax.machine import machine

# Subcommand -> one line for --help; the module of the same name in benchmarks/ holds it.
SUMMARIES = {
    "ceilings": "what the device does at most: a copy, and matrix products by precision",
    "estimator": "clouds/s of the single-frame estimator, batch 1 and 32",
    "training": "samples/s of a training step, data generation included, and its memory",
    "grid": "many trainings in one program against the same one after another",
    "tracker": "one step of the tracker against one single-frame estimate, or of many at once",
    "generator": "frames/s of the generator per category, with Kinect noise",
    "evaluation": "frames/s from a file to all errors against the estimator alone",
    "loader": "what feeding from disk costs a training step of the fast preset",
    "se3": "exponentials and logarithms of a million twists, beside jaxlie where it is installed",
    "iou": "pairs/s of the exact intersection over union of oriented boxes",
    "start": "seconds of the import and to a first pose, with and without kept programs",
    "processes": "samples/s of training in two processes against one; or many devices on paper",
    "scaling": "time and memory as points, parts and batch grow",
    "profile": "what takes the time in the estimator and in the tracker",
    "gate": "ratios to plain computations against the committed ones; fails on a loss of a quarter",
}


def build_parser() -> argparse.ArgumentParser:
    parser = create_parser(
        "bin/benchmark",
        "Measures speed after compilation, on this machine and with whatever else runs on it:\n"
        "the load average is printed with the result.",
        [
            ("estimator --category box --category laptop", "clouds/s, points to poses"),
            ("estimator --preset paper", "the published sizes beside their naive formulation"),
            ("tracker --videos 256 --keep-programs", "many videos at once; compiles once"),
            ("grid --preset ablation --members 8", "eight trainings side by side"),
            ("generator", "frames/s of the generator, all categories"),
            ("generator --category box --json speed.json", "one category, kept in a file"),
            ("evaluation --category box", "what an evaluation costs beyond its estimates"),
            ("loader --category box --data box.h5", "feeding from disk against memory"),
            ("tracker --category laptop", "frames/s of the tracker, beside the estimator"),
            ("generator --category box --data.table 0.5", "with table pixels in half the masks"),
            ("profile --plot profile.png", "what takes the time, as a picture"),
            ("processes --model --preset fast --step-ms 20", "many devices on paper"),
            ("gate", "exit code 1 where a ratio fell by a quarter"),
        ],
    )
    commands = parser.add_subparsers(dest="benchmark", required=True, metavar="BENCHMARK")
    parser.set_defaults(settings=[])
    for name, summary in SUMMARIES.items():
        command = commands.add_parser(name, help=summary, description=summary)
        _module(name).add_arguments(command)
        command.add_argument(
            "--json", type=Path, metavar="FILE", help="write machine and rows there too"
        )
        command.add_argument(
            "--keep-programs",
            action="store_true",
            help="use and keep compiled programs, as other commands do; without times of "
            "compilation",
        )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv[:1] == ["--gate"]:  # what such a guard is called elsewhere
        argv[0] = "gate"
    argv, settings = common.split_settings(argv, ("data",))
    arguments = build_parser().parse_args(argv)
    if settings and arguments.benchmark != "generator":
        raise CaperError(f"{settings[0]}: only the generator's benchmark takes settings")
    arguments.settings = [setting.removeprefix("data.") for setting in settings]
    if arguments.json is not None:
        common.check_folder(arguments.json.parent, "--json")
    if not arguments.keep_programs:
        _compile_anew()
    facts = {**machine(), "programs": "kept" if arguments.keep_programs else "new"}
    rows: list[dict[str, Any]] = []
    module = _module(arguments.benchmark)
    for row in module.run(arguments):
        if arguments.keep_programs and "compile_s" in row:
            row["compile_s"] = "-"  # where programs are found it says nothing
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
    return module.verdict(rows) if hasattr(module, "verdict") else 0


def _module(name: str) -> Any:
    return importlib.import_module(f"benchmarks.{name}")


def _compile_anew() -> None:
    """Times of compilation are those without programs kept from earlier runs."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(common.run(main, sys.argv[1:], command="benchmark"))
