"""Runs a study: trains its members side by side, measures them, and keeps a line per model."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from caper_jax.errors import CaperError
from caper_jax.files import write_atomically
from caper_jax.reproduce.study import Run, Study, runs_of, trainings
from caper_jax.reproduce.study_measure import Measured
from caper_jax.training.train_many import train_many

RUNS_FOLDER = "runs"

# (runs of one category, member -> model directory) -> what was measured of each; None: no data.
MeasureRuns = Callable[[Sequence[Run], Mapping[str, Path]], list[Measured] | None]


@dataclass(frozen=True)
class StudyResult:
    """What a study found.

    Attributes:
      study: what was compared.
      measured: of every model that was trained to its end, by category, variant and seed.
      diverged: name of each training that did not -> the step.
    """

    study: Study
    measured: list[Measured]
    diverged: dict[str, int]


def run_study(
    study: Study,
    name: str,
    out: Path,
    measure: MeasureRuns,
    extra: tuple[str, ...] = (),
    initial: Path | None = None,
) -> StudyResult:
    """Trains and measures; the same call resumes what was stopped.

    Args:
      study: what to compare.
      name: of its file of results.
      out: gets runs/ with a model directory per training, and NAME.jsonl with a line per model.
      measure: errors of the models of one category.
      extra: "section.key=value" of all trainings.
      initial: model directory that all start from.

    Raises:
      CaperError: see ``study.runs_of`` and ``train_many``; nothing to measure on.
      KeyboardInterrupt: training was stopped; the same call goes on from there.
    """
    runs = runs_of(study, extra)
    results = {r.name: r for r in train_many(trainings(runs), out / RUNS_FOLDER, initial)}
    if not all(result.ended for result in results.values()):
        raise KeyboardInterrupt
    folders = {name: r.directory for name, r in results.items() if r.finished}
    measured: list[Measured] = []
    for category in dict.fromkeys(run.category for run in runs):
        own = [run for run in runs if run.category == category and run.member in folders]
        measured += (measure(own, folders) or []) if own else []
    if not measured:
        raise CaperError("no model of the study could be measured: no data of its categories")
    out.mkdir(parents=True, exist_ok=True)
    lines = "".join(json.dumps(_line(one)) + "\n" for one in measured)
    write_atomically(out / f"{name}.jsonl", lines.encode())
    return StudyResult(
        study=study,
        measured=measured,
        diverged={n: r.diverged for n, r in results.items() if r.diverged is not None},
    )


def _line(one: Measured) -> dict[str, Any]:
    run = one.run
    return {
        "category": run.category,
        "variant": run.variant,
        "seed": run.seed,
        "member": run.member,
        **one.errors,
    }
