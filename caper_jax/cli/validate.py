"""``caper validate``: checks every frame of a dataset and lists all that is wrong."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli import common
from caper_jax.data.readers import formats
from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

if TYPE_CHECKING:
    from caper_jax.data.validation import CategoryReport, Problem

EXIT_PROBLEMS = 1
_SHOWN = 20
_HEADINGS = ("category", "frames", "objects", "too few points", "with problems", "listed splits")


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "validate",
        "Reads every frame of a dataset, checks it against the conventions, and lists everything\n"
        "that is wrong. Exit code 0: clean; 1: problems; 2: a mistake in the arguments.",
        [
            ("--format artimage --data ArtImage", "all categories"),
            ("--format caper --data box_test.h5", "a generated file"),
            ("--format reartmix --data ReArtMix --category box --json box.json", "for programs"),
        ],
    )
    parser.add_argument(
        "--format", required=True, help=f"layout of the data: {', '.join(formats(labeled=True))}"
    )
    parser.add_argument("--data", required=True, type=Path, help="dataset's root folder or .h5")
    parser.add_argument("--category", help="check this one only (default: all that are found)")
    parser.add_argument("--split", help="check frames of this split only (default: all frames)")
    parser.add_argument(
        "--workers", type=common.positive_int, default=4, help="threads (default: %(default)s)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report to this file")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    from caper_jax.data.validation import CategoryReport, Problem, check_category, one_line

    if arguments.json is not None:
        common.check_folder(arguments.json.parent, "--json")
        if arguments.json.resolve() == arguments.data.resolve():
            raise CaperError(f"--json {arguments.json}: is the data; give the report another name")
    try:
        chosen = _categories(arguments)
        _check_split(arguments, chosen)
    except _BrokenFileError as error:
        broken = Problem(one_line(error))
        reports = [CategoryReport(arguments.category or "?", problems=[broken])]
        chosen = []
    else:
        reports = []
    for name in chosen:
        reports.append(
            check_category(
                arguments.format, arguments.data, name, arguments.split, arguments.workers
            )
        )
    print(common.printable(format_report(reports)))
    if arguments.json is not None:
        content = {
            "format": arguments.format,
            "data": str(arguments.data),
            "split": arguments.split,
            "categories": [dataclasses.asdict(report) for report in reports],
        }
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(arguments.json, (json.dumps(content, indent=2) + "\n").encode())
    return EXIT_PROBLEMS if any(report.problems for report in reports) else 0


class _BrokenFileError(CaperError):
    """The data are there but cannot be read: a finding, not a mistake in the arguments."""


def _categories(arguments: argparse.Namespace) -> list[str]:
    from caper_jax import categories
    from caper_jax.data.readers import categories_in

    wanted = None if arguments.category is None else categories.get(arguments.category).name
    try:
        found = categories_in(arguments.format, arguments.data)
    except CaperError as error:
        # A single file that exists is damaged; a folder is of another layout.
        if arguments.format == "caper" and arguments.data.is_file():
            raise _BrokenFileError(str(error)) from error
        raise
    if wanted is not None and wanted not in found:
        raise CaperError(f"{arguments.data}: holds {', '.join(found)}, but no {wanted}")
    return found if wanted is None else [wanted]


def _check_split(arguments: argparse.Namespace, chosen: list[str]) -> None:
    from caper_jax.data.readers import splits_in

    if arguments.split is None:
        return
    listed = {s for name in chosen for s in splits_in(arguments.format, arguments.data, name)}
    if arguments.split not in listed:
        raise CaperError(
            f"{arguments.data}: no split {arguments.split!r}; it lists "
            f"{', '.join(sorted(listed)) or 'none'}"
        )


def format_report(reports: Sequence[CategoryReport]) -> str:
    """A table of the categories, then at most 20 problems, a line each."""
    rows = [_HEADINGS]
    for report in reports:
        splits = (f"{name} {'?' if n is None else n}" for name, n in report.splits.items())
        instances = "-" if report.instances is None else str(report.instances)
        counts = (str(report.few_points), str(report.bad_frames))
        rows.append(
            (report.category, str(report.frames), instances, *counts, ", ".join(splits) or "-")
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:-1], widths[1:-1], strict=True)]
        lines.append("  ".join([*cells, row[-1]]))
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
