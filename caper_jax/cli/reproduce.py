"""``caper reproduce``: the paper's tables, measured again and set beside its figures."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli import common
from caper_jax.cli.common import Settings
from caper_jax.cli.train import SECTIONS as TRAINING_SECTIONS
from caper_jax.cli.train import default_sections
from caper_jax.errors import CaperError, unknown_name
from caper_jax.machine import split_cores
from caper_jax.reproduce.options import Options

if TYPE_CHECKING:
    from caper_jax.reproduce.report import Report

EXAMPLES = (
    ("table1", "single frames, all categories of the table"),
    ("table1 --data ROOT --format artimage --object-scale 3.7", "on the paper's data"),
    ("table1 --noise none", "on clean depth, as the paper's ArtImage is rendered"),
    ("table6 --category laptop", "one category, on generated videos"),
    ("table6 --data PM-Videos --format pm-videos", "on the paper's data"),
    ("table10 --weights runs/arm --frames 1000", "errors against frame, long videos"),
    ("table9 --category box --seeds 3 --steps 2000", "trains six models"),
    ("table7 --category laptop --preset fast", "trains 16 models of full size"),
    ("robustness --category box", "what stray points do"),
    ("sweep --sweep occlusion,points --category box", "error against one condition at a time"),
    ("jitter --category box --videos 4", "a quick look"),
)
SECTIONS = {name: text for name, text in TRAINING_SECTIONS.items() if name != "loader"}

_TRACKING = (
    *("category", "videos", "frames", "mode", "data", "format", "split", "weights", "seed"),
    *("noise", "network_alone", "object_scale"),
)
_TRACKED = (*_TRACKING, "given_masks")
_STATIC = (
    *("category", "frames", "data", "format", "split", "weights", "seed", "noise"),
    "object_scale",
)
_TRAINED = (
    *("category", "frames", "data", "format", "split", "seed", "noise"),
    *("seeds", "steps", "preset", "initial", "settings"),
)
_ROBUST = ("category", "frames", "weights", "seed", "noise")
_MOVING = ("category", "videos", "frames", "weights", "seed", "noise", "network_alone")


@dataclass(frozen=True)
class Reproduction:
    """One subcommand.

    Attributes:
      module: of ``caper_jax.reproduce``, with ``run(name, options) -> Report``; imported
        only when it runs.
      summary: one line for --help.
      options: fields of ``Options`` that it takes, besides out.
    """

    module: str
    summary: str
    options: tuple[str, ...]


REPRODUCTIONS = {
    "table1": Reproduction("static", "pose estimation, ArtImage categories", _STATIC),
    "table2": Reproduction("static", "pose estimation, ReArtMix categories", _STATIC),
    "table3": Reproduction("static", "pose estimation, seven parts of an arm", _STATIC),
    "ablations": Reproduction(
        "ablations", "table 1 without ideas of the paper and of ours; trains all", _TRAINED
    ),
    "table7": Reproduction(
        "ablations", "the root from its own points or from the whole; trains both", _TRAINED
    ),
    "figure11": Reproduction(
        "ablations", "rotation decoupled or regressed directly; trains both", _TRAINED
    ),
    "table8": Reproduction("static", "pose estimation by how much is hidden", _STATIC),
    "table4": Reproduction("tracking", "pose tracking, ReArt-Videos categories", _TRACKED),
    "table5": Reproduction("tracking", "pose tracking, seven parts of an arm", _TRACKED),
    "table6": Reproduction("tracking", "pose tracking, PM-Videos categories", _TRACKED),
    "table9": Reproduction(
        "ablations",
        "Lie against Euclidean increments; trains both",
        (*_TRAINED, "videos", "mode"),
    ),
    "table10": Reproduction(
        "tracking", "keyframes none, fixed or dynamic; error against frame", _TRACKING
    ),
    "reliability": Reproduction("static", "how often the truth lies where the model says", _STATIC),
    "robustness": Reproduction("robustness", "stray points, loose masks and few points", _ROBUST),
    "plausibility": Reproduction(
        "robustness", "which wrong units and wrong objects a model recognizes", _ROBUST
    ),
    "sweep": Reproduction(
        "sweep",
        "error against occlusion, noise, distance, points, mask, roll",
        (*_ROBUST, "sweep"),
    ),
    "jitter": Reproduction("motion", "jitter on an object that stands still", _MOVING),
    "modes": Reproduction("motion", "errors by how camera and joints move", _MOVING),
}


def parse(argv: Sequence[str]) -> tuple[str, Options]:
    """What to reproduce, and how.

    Raises:
      CaperError: no such table, or an option that it does not take.
    """
    name = argv[0] if argv and not argv[0].startswith("-") else None
    if name is not None and name not in REPRODUCTIONS:
        raise unknown_name("reproduction", name, REPRODUCTIONS)
    rest = list(argv if name is None else argv[1:])
    settings = Settings(SECTIONS, default_sections)
    made, given = common.parse_with_settings(
        Options, rest, EXAMPLES, settings, prog="caper reproduce", notes=_what(name)
    )
    if name is None:
        raise CaperError(f"say what to reproduce: {', '.join(REPRODUCTIONS)}")
    options = replace(made, settings=tuple(given))
    for each in fields(Options):
        takes = each.name in (*REPRODUCTIONS[name].options, "out")
        if not takes and getattr(options, each.name) != each.default:
            taken = ", ".join(map(_flag, REPRODUCTIONS[name].options))
            raise CaperError(f"{_flag(each.name)} is no option of {name}, which takes {taken}")
    common.check_folder(options.out, "--out")
    return name, options


def _flag(option: str) -> str:
    return "--section.key" if option == "settings" else common.flag(Options, option)


def _what(name: str | None) -> str:
    """For --help: what can be reproduced, or which options one table takes."""
    if name is not None:
        options = REPRODUCTIONS[name].options
        taken = " ".join(map(_flag, (*options, "out")))
        return f"\n{name}: {REPRODUCTIONS[name].summary}; takes\n  {taken}\n"
    lines = [f"  {key:<11}  {item.summary}\n" for key, item in REPRODUCTIONS.items()]
    return "\nwhat to reproduce (caper reproduce WHAT [OPTIONS]):\n" + "".join(lines)


def run(parsed: tuple[str, Options]) -> int:
    """Runs the command; returns its exit code."""
    name, given = parsed
    options = replace(
        given,
        # None: all of the table, which knows them.
        category=tuple(common.chosen_categories(given.category, ())),
        initial=given.initial and common.model_folder(given.initial),
    )
    if "seeds" in REPRODUCTIONS[name].options:
        split_cores()  # models are trained side by side
    module = importlib.import_module(f"caper_jax.reproduce.{REPRODUCTIONS[name].module}")
    show_report(module.run(name, options), name, options.out)
    return 0


def show_report(report: Report, name: str, out: Path) -> None:
    """Writes a report with its pictures, prints it, and says where it is."""
    from caper_jax.reproduce.report import markdown, write_report
    from caper_jax.visualization.plots import write_plot

    report = _with_machine(report)
    out.mkdir(parents=True, exist_ok=True)
    written = write_report(out, name, report)
    for end, plot in report.curves.items():
        written.append(write_plot(out / f"{name}_{end}.png", plot))
    print(markdown(report))
    print(f"written: {', '.join(map(str, written))}")


def _with_machine(report: Report) -> Report:
    """The report with the machine that its times were measured on."""
    from caper_jax.machine import machine as describe

    machine = describe()
    fact = "machine: " + ", ".join(f"{name} {value}" for name, value in machine.items())
    result = {**report.result, "machine": machine}
    return replace(report, facts=[*report.facts, fact], result=result)
