"""``caper validate``: checks every frame of a dataset and lists all that is wrong."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli import common
from caper_jax.cli.common import Count
from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

if TYPE_CHECKING:
    from caper_jax.data.validation import CategoryReport, Problem

EXIT_PROBLEMS = 1
_SHOWN = 20
EXAMPLES = (
    ("--format artimage --data ArtImage", "all categories"),
    ("--format caper --data box_test.h5", "a generated file"),
    ("--format reartmix --data ReArtMix --category box --json box.json", "for programs"),
)
_HEADINGS = ("category", "frames", "objects", "too few points", "with problems", "listed splits")


@dataclass(frozen=True)
class Validate:
    """Reads every frame of a dataset and lists everything that is wrong with it.

    Frames are checked against the conventions. Exit code 0: clean; 1: problems; 2: a mistake in
    the arguments.

    Attributes:
      format: layout of the data: artimage, caper, captra, pm-videos, reart-videos or reartmix
      data: dataset's root folder or .h5
      category: a name, several with commas, or all there are
      split: check frames of this split only (default: all frames)
      workers: threads
      json: write the report to this file
    """

    format: str
    data: Path
    category: tuple[str, ...] = ()
    split: str | None = None
    workers: Count = 4
    json: Path | None = None


def parse(argv: Sequence[str]) -> Validate:
    options = common.parse(Validate, argv, EXAMPLES)
    if options.json is not None:
        common.check_folder(options.json.parent, "--json")
        if options.json.resolve() == options.data.resolve():
            raise CaperError(f"--json {options.json}: is the data; give the report another name")
    return options


def run(options: Validate) -> int:
    """Runs the command; returns its exit code."""
    from caper_jax.data.validation import CategoryReport, Problem, check_category, one_line

    try:
        chosen = _categories(options)
        _check_split(options, chosen)
    except _BrokenFileError as error:
        named = ", ".join(options.category) or "?"
        reports = [CategoryReport(named, problems=[Problem(one_line(error))])]
    else:
        reports = [
            check_category(options.format, options.data, name, options.split, options.workers)
            for name in chosen
        ]
    print(common.printable(format_report(reports)))
    if options.json is not None:
        content = {
            "format": options.format,
            "data": str(options.data),
            "split": options.split,
            "categories": [dataclasses.asdict(report) for report in reports],
        }
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(options.json, (json.dumps(content, indent=2) + "\n").encode())
    return EXIT_PROBLEMS if any(report.problems for report in reports) else 0


class _BrokenFileError(CaperError):
    """The data are there but cannot be read: a finding, not a mistake in the arguments."""


def _categories(options: Validate) -> list[str]:
    from caper_jax import categories
    from caper_jax.data.readers import categories_in

    given = common.chosen_categories(options.category, ())
    wanted = [categories.get(name).name for name in given]
    try:
        held = categories_in(options.format, options.data)
    except CaperError as error:
        # A single file that exists is damaged; a folder is of another layout.
        if options.format == "caper" and options.data.is_file():
            raise _BrokenFileError(str(error)) from error
        raise
    for name in wanted:
        if name not in held:
            raise CaperError(f"{options.data}: holds {', '.join(held)}, but no {name}")
    return wanted or held


def _check_split(options: Validate, chosen: list[str]) -> None:
    from caper_jax.data.readers import splits_in

    if options.split is None:
        return
    listed = {s for name in chosen for s in splits_in(options.format, options.data, name)}
    if options.split not in listed:
        raise CaperError(
            f"{options.data}: no split {options.split!r}; it lists "
            f"{', '.join(sorted(listed)) or 'none'}"
        )


def format_report(reports: Sequence[CategoryReport]) -> str:
    """A table of the categories, then at most 20 problems, a line each."""
    from tabulate import tabulate

    rows = []
    for report in reports:
        splits = (f"{name} {'?' if n is None else n}" for name, n in report.splits.items())
        instances = "-" if report.instances is None else report.instances
        counts = (report.frames, instances, report.few_points, report.bad_frames)
        rows.append((report.category, *counts, ", ".join(splits) or "-"))
    align = ("left", *["right"] * 4, "left")
    lines = tabulate(rows, _HEADINGS, tablefmt="plain", colalign=align).splitlines()
    lines.append("")
    messages = _messages([problem for report in reports for problem in report.problems])
    if not messages:
        lines.append("no problems")
    else:
        lines += messages[:_SHOWN]
        if len(messages) > _SHOWN:
            lines.append(f"and {len(messages) - _SHOWN} more (--json FILE keeps them all)")
    return "\n".join(lines)


def _messages(problems: Sequence[Problem]) -> list[str]:
    """One line per problem; one that many frames have in common (a broken model) stands once."""
    counts: dict[str, int] = {}
    for problem in problems:
        counts[problem.message] = counts.get(problem.message, 0) + 1
    return [
        message if count == 1 else f"{message} ({count} frames)"
        for message, count in counts.items()
    ]
