"""``caper reproduce``: the paper's tables, measured again and set beside its figures."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from caper_jax.cli import common
from caper_jax.machine import machine as describe_machine

if TYPE_CHECKING:
    from caper_jax.reproduce.options import Options
    from caper_jax.reproduce.report import Report

_TRACKING = (
    *("category", "videos", "frames", "mode", "data", "format", "split", "weights", "seed"),
    *("noise", "network_alone", "object_scale"),
)
_STATIC = (
    *("category", "frames", "data", "format", "split", "weights", "seed", "noise"),
    "object_scale",
)
_TRAINED = (
    *("category", "frames", "data", "format", "split", "seed", "noise"),
    *("seeds", "minutes", "steps", "initial", "overrides"),
)
_MOVING = ("category", "videos", "frames", "weights", "seed", "noise", "network_alone")


@dataclass(frozen=True)
class Reproduction:
    """One subcommand.

    Attributes:
      module: of ``caper_jax.reproduce``, with ``run(name, options) -> Report``; imported
        only when it runs.
      summary: one line for --help.
      options: those of ``OPTIONS`` that it takes, besides --out.
    """

    module: str
    summary: str
    options: tuple[str, ...]


REPRODUCTIONS = {
    "table1": Reproduction("static", "pose estimation, ArtImage categories", _STATIC),
    "table2": Reproduction("static", "pose estimation, ReArtMix categories", _STATIC),
    "table3": Reproduction("static", "pose estimation, seven parts of an arm", _STATIC),
    "ablations": Reproduction(
        "ablations", "table 1 without the paper's ideas; trains four models", _TRAINED
    ),
    "table7": Reproduction(
        "root_pose", "the root from its own points or from the whole; trains both", _TRAINED
    ),
    "figure11": Reproduction(
        "root_pose", "rotation decoupled or regressed directly; trains both", _TRAINED
    ),
    "table8": Reproduction("static", "pose estimation by how much is hidden", _STATIC),
    "table4": Reproduction(
        "tracking", "pose tracking, ReArt-Videos categories", (*_TRACKING, "given_masks")
    ),
    "table5": Reproduction(
        "tracking", "pose tracking, seven parts of an arm", (*_TRACKING, "given_masks")
    ),
    "table6": Reproduction(
        "tracking", "pose tracking, PM-Videos categories", (*_TRACKING, "given_masks")
    ),
    "table9": Reproduction(
        "ablations",
        "Lie against Euclidean increments; trains both",
        (
            *("category", "videos", "frames", "mode", "data", "format", "split", "seed", "noise"),
            *("seeds", "minutes", "steps", "initial", "overrides"),
        ),
    ),
    "table10": Reproduction(
        "keyframes", "keyframes none, fixed or dynamic; error against frame", _TRACKING
    ),
    "reliability": Reproduction("static", "how often the truth lies where the model says", _STATIC),
    "jitter": Reproduction("motion", "jitter on an object that stands still", _MOVING),
    "modes": Reproduction("motion", "errors by how camera and joints move", _MOVING),
}

# Field of ``Options`` -> its arguments to argparse.
OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "category": (
        "--category",
        {"action": "append", "default": [], "help": "may be repeated (default: all of the table)"},
    ),
    "videos": (
        "--videos",
        {
            "type": common.positive_int,
            "metavar": "N",
            "help": "per category (default: the paper's)",
        },
    ),
    "frames": (
        "--frames",
        {
            "type": common.positive_int,
            "metavar": "T",
            "help": "of each video, or of a test set of single frames (default: the paper's, or "
            "1,000)",
        },
    ),
    "mode": (
        "--mode",
        {
            "choices": ("paper", "cam", "hard"),
            "help": "how generated videos move (default: paper)",
        },
    ),
    "data": (
        "--data",
        {"type": Path, "metavar": "ROOT", "help": "measure on a data set instead"},
    ),
    "format": ("--format", {"help": "layout of --data, as for caper evaluate"}),
    "split": ("--split", {"help": "of --data (default: test)"}),
    "weights": (
        "--weights",
        {
            "type": Path,
            "metavar": "DIR",
            "help": "model directory, or folder with one per category (default: the shipped ones)",
        },
    ),
    "object_scale": ("--object-scale", common.OBJECT_SCALE),
    "seed": (
        "--seed",
        {
            "type": common.non_negative_int,
            "default": 0,
            "help": "of generated frames and videos (default: %(default)s)",
        },
    ),
    "noise": (
        "--noise",
        {"help": "of generated depth: none, gauss3mm, kinect or realsense (default: kinect)"},
    ),
    "given_masks": (
        "--given-masks",
        {"action": "store_true", "help": "add rows with the data's part labels"},
    ),
    "network_alone": (
        "--network-alone",
        {"action": "store_true", "help": "track without registration, as the paper does"},
    ),
    "seeds": (
        "--seeds",
        {
            "type": common.positive_int,
            "default": 3,
            "metavar": "N",
            "help": "runs of each kind (default: %(default)s)",
        },
    ),
    "minutes": (
        "--minutes",
        {"type": common.positive_float, "help": "of training per run (default: 60)"},
    ),
    "steps": (
        "--steps",
        {"type": common.positive_int, "help": "of training per run, instead of --minutes"},
    ),
    "initial": (
        "--from",
        {
            "type": common.model_folder,
            "metavar": "DIR",
            "dest": "initial",
            "help": "model that each run starts from, as for caper train (default: none)",
        },
    ),
    "overrides": (
        "--set",
        {
            "action": "append",
            "default": [],
            "dest": "overrides",
            "metavar": "KEY=VALUE",
            "help": "another setting of the runs, as for caper train; may be repeated",
        },
    ),
}


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "reproduce",
        "Measures what a table of the paper shows and prints the paper's figures, ours, and what\n"
        "ours were measured on. Writes the same as markdown and JSON, and pictures of curves.",
        [
            ("table1", "single frames, all categories of the table"),
            ("table1 --data ROOT --format artimage --object-scale 3.7", "on the paper's data"),
            ("table1 --noise none", "on clean depth, as the paper's ArtImage is rendered"),
            ("table6 --category laptop", "one category, on generated videos"),
            ("table6 --data PM-Videos --format pm-videos", "on the paper's data"),
            ("table10 --weights runs/arm --frames 1000", "errors against frame, long videos"),
            ("table9 --category box --seeds 3 --minutes 30", "trains six models"),
            ("table7 --category laptop --steps 4000 --seeds 1", "trains two models"),
            ("jitter --category box --videos 4", "a quick look"),
        ],
    )
    commands = parser.add_subparsers(dest="reproduction", required=True, metavar="WHAT")
    for name, reproduction in REPRODUCTIONS.items():
        summary = reproduction.summary
        command = commands.add_parser(name, help=summary, description=summary)
        for option in reproduction.options:
            flag, arguments = OPTIONS[option]
            command.add_argument(flag, **arguments)
        command.add_argument(
            "--out",
            type=Path,
            default=Path("outputs") / "reproduce",
            help="folder of results, generated videos and runs (default: %(default)s)",
        )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = vars(build_parser().parse_args(sys.argv[1:] if argv is None else argv))
    name = arguments.pop("reproduction")
    from caper_jax.reproduce.options import Options
    from caper_jax.reproduce.report import markdown, write_report

    values: dict[str, Any] = {
        key: tuple(v) if isinstance(v, list) else v for key, v in arguments.items()
    }
    options = Options(**values)
    common.check_folder(options.out, "--out")
    module = importlib.import_module(f"caper_jax.reproduce.{REPRODUCTIONS[name].module}")
    report = _with_machine(module.run(name, options))
    options.out.mkdir(parents=True, exist_ok=True)
    written = [*write_report(options.out, name, report), *_write_curves(options, name, report)]
    print(markdown(report))
    print(f"written: {', '.join(map(str, written))}")
    return 0


def _with_machine(report: Report) -> Report:
    """The report with the machine that its times were measured on."""
    machine = describe_machine()
    fact = "machine: " + ", ".join(f"{name} {value}" for name, value in machine.items())
    result = {**report.result, "machine": machine}
    return replace(report, facts=[*report.facts, fact], result=result)


def _write_curves(options: Options, name: str, report: Report) -> list[Path]:
    """Writes the report's plots; returns their paths."""
    from caper_jax.visualization.plots import write_plot

    paths = {options.out / f"{name}_{end}.png": plot for end, plot in report.curves.items()}
    return [write_plot(path, plot) for path, plot in paths.items()]
