"""What ideas are worth: studies as their files describe them, the paper's figures beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from caper_jax import categories
from caper_jax.reproduce.data import NO_DATA, open_frames, open_videos
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import PoseFigures, paper
from caper_jax.reproduce.report import Report, Table, assumptions, number
from caper_jax.reproduce.study import Run, Study, read_study
from caper_jax.reproduce.study_measure import Measured, measure_frames, measure_tracking
from caper_jax.reproduce.study_report import study_report
from caper_jax.reproduce.study_run import MeasureRuns, run_study

_VIDEO_FRAMES = 30  # of each video, as in the paper
_HEADER = ("category", "part", "variant", "rotation [deg]", "translation [m]", "translation [%]")


def run(name: str, options: Options) -> Report:
    """Trains and measures a study that ships, and adds what the paper reports.

    Args:
      name: of the study: "ablations", "table7", "table9" or "figure11".
      options: what differs from its file; runs are kept under ``out`` and resumed.

    Raises:
      CaperError: unknown categories, settings or data; see ``run_file``.
      KeyboardInterrupt: training was stopped; the same call goes on from there.
    """
    report = run_file(name, name, options)
    known = read_study(name).categories
    rows, facts = _paper_rows(name, options.category or known)
    if rows:
        caption = "What the paper reports, of its own data"
        report = replace(report, tables=[*report.tables, Table(caption, _HEADER, rows, 3)])
    return replace(report, facts=[*report.facts, *facts])


def run_file(source: str | Path, name: str, options: Options) -> Report:
    """Trains and measures a study.

    Args:
      source: its file, or the name of one that ships.
      name: of its file of results, NAME.jsonl in ``options.out``.
      options: what differs from its file; runs are kept under ``out`` and resumed.

    Raises:
      CaperError: see ``study.read_study``, ``train_many``; data that contradict each other or
        lack every category.
      KeyboardInterrupt: training was stopped; the same call goes on from there.
    """
    study = adjusted(read_study(source), options)
    options.dataset()  # a contradiction in it is found before anything is trained
    facts: list[str] = []
    measure = _measure_with(study, options, facts)
    result = run_study(study, name, options.out, measure, options.settings, options.initial)
    return study_report(result, facts)


def adjusted(study: Study, options: Options) -> Study:
    """A study with what was given on the command line in the place of its own."""
    given: dict[str, Any] = {
        "categories": options.category,
        "seeds": options.seeds,
        "steps": options.steps,
        "preset": options.preset,
        "frames": options.frames,
    }
    return replace(study, **{key: value for key, value in given.items() if value})


def _measure_with(study: Study, options: Options, facts: list[str]) -> MeasureRuns:
    """Measures the models of a category; adds a line on the data to ``facts``."""

    def measure(runs: Sequence[Run], folders: Mapping[str, Path]) -> list[Measured] | None:
        category = categories.get(runs[0].training.category)
        if study.measure == "tracking":
            count = max(1, study.frames // _VIDEO_FRAMES)
            videos = open_videos(
                replace(options, frames=None), category, options.videos or count, _VIDEO_FRAMES
            )
            facts.append(f"{category.name}: {videos.description if videos else NO_DATA}")
            return measure_tracking(runs, folders, videos) if videos else None
        source = open_frames(replace(options, frames=study.frames), category)
        facts.append(f"{category.name}: {source[1] if source else NO_DATA}")
        if source is None:
            return None
        return measure_frames(
            runs, folders, source[0], study.frames, root_alone=study.measure == "root"
        )

    return measure


def _paper_rows(name: str, chosen: Sequence[str]) -> tuple[list[list[str]], list[str]]:
    """Rows of the paper's figures of the chosen categories, and what is assumed of them."""
    rows: list[list[str]] = []
    if name == "table7":
        diagonals = paper().diagonal_m["partnet"]
        for category in chosen:
            for variant, figures in paper().root_input.get(category, {}).items():
                root = categories.get(category).parts[0]
                rows.append(_pose_row(category, root, variant, figures, diagonals[category]))
        return rows, ["the paper's meters are divided by assumed diagonals of its objects"]
    if name not in paper().tables:
        return rows, []
    table = paper().tables[name]
    variants: dict[str, Any] = dict(table.variants)
    if name == "ablations":
        variants["full"] = paper().tables["table1"].categories
    shown = {}
    for category in chosen:
        for variant, of_category in variants.items():
            if category not in of_category:
                continue
            shown[category] = of_category[category]
            for index, part in enumerate(categories.get(category).parts):
                figures = of_category[category].part(index)
                rows.append(
                    [
                        *(category, part, variant),
                        number(figures["rotation_deg"], 1),
                        number(figures["translation_m"], 3),
                        number(figures["translation_relative"], 2, 100.0),
                    ]
                )
    return rows, assumptions(shown, table.dataset)


def _pose_row(
    category: str, part: str, variant: str, figures: PoseFigures, diagonal: float
) -> list[str]:
    relative = figures.translation_m / diagonal
    return [
        *(category, part, variant),
        number(figures.rotation_deg, 1),
        number(figures.translation_m, 3),
        number(relative, 2, 100.0),
    ]
