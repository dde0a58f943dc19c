"""Table 9: increments in the Lie algebra against Euclidean ones, trained with equal budgets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import numpy as np

from caper_jax import categories
from caper_jax.config import IncrementKind
from caper_jax.reproduce import comparison, runs, trainings
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import TABLES, Figures
from caper_jax.reproduce.render import Report, Table, number, spread
from caper_jax.tracker import Tracker, config_for

KINDS: tuple[IncrementKind, ...] = get_args(IncrementKind)
_METRICS = (("rotation_deg", 1.0, 2), ("translation_relative", 100.0, 2))


def run(name: str, options: Options) -> Report:
    """Trains a model of each kind per seed and category, and tracks with the network alone.

    Args:
      name: "table9".
      options: see ``Options``; runs are kept under ``out`` and resumed.

    Raises:
      CaperError: unknown categories, settings or data; a run kept there with other settings.
      KeyboardInterrupt: training was stopped; the same call goes on from there.
    """
    trainings.check_budget(options)
    paper = TABLES[name]
    rows: list[list[str]] = []
    facts, result = [], {}
    chosen = options.chosen(paper.variants["lie"])
    for key in chosen:
        source = runs.open_videos(options, categories.get(key), paper.videos, paper.frames)
        if source is None:
            facts.append(f"{key}: {runs.NO_DATA}")
            continue
        facts.append(f"{key}: {source.description}")
        condition = runs.Condition()
        found: dict[str, list[dict[str, Any]]] = {}
        for kind in KINDS:
            found[kind] = []
            for seed in range(options.seeds):
                estimator = trainings.trained(
                    key, kind, [f"network.increment={kind}"], seed, options
                )
                tracker = Tracker(estimator, runs.network_alone(config_for(estimator)))
                tracks = runs.track_all(tracker, source, condition)
                summary = runs.summarize(tracks, source, condition)
                found[kind].append({"seed": seed, "steps": estimator.card["steps"], **summary})
            steps = ", ".join(f"{one['steps']:,}" for one in found[kind])
            facts.append(f"{key}, {kind}: {steps} training steps")
            rows += kind_rows(key, kind, found[kind], paper.variants[kind][key])
        rows += difference_rows(key, found)
        result[key] = {
            "paper": {kind: comparison.paper_json(paper.variants[kind][key]) for kind in KINDS},
            "runs": found,
        }
    header = (
        *("category", "part", "increment"),
        *("rot paper [deg]", "ours"),
        *("trans paper [m]", "paper [%]", "ours [%]"),
    )
    figures = {key: paper.variants["lie"][key] for key in chosen}
    return Report(
        title=paper.title,
        tables=[Table("Mean ± standard deviation over seeds", header, rows, 3)],
        facts=[
            paper.measured_on(),
            *facts,
            f"{options.seeds} runs of each kind, {trainings.describe(options)}",
            "tracker: the network's increments alone, without registration; first pose given",
            "trans [%]: distance of part origins over the diagonal of the object's box at rest",
            "euclidean - lie: difference of the means ± its standard error; above 0 the Lie "
            "algebra is better",
            *comparison.assumptions(figures, paper.dataset),
        ],
        result={"categories": result},
    )


def kind_rows(
    category: str, kind: str, found: Sequence[dict[str, Any]], paper: Figures
) -> list[list[str]]:
    """One row per part, from the summaries of all seeds."""
    rows = []
    for index, part in enumerate(found[0]["parts"]):
        other = paper.beside(index)
        turn, shift = (
            spread(factor * values.mean(), _scaled(factor, deviation(values)), digits)
            for values, factor, digits in _values(found, index)
        )
        rows.append(
            [
                *(category, part["name"], kind),
                *(number(paper.rotation_deg[other], 1), turn),
                number(paper.translation_m[other], 3),
                *(number(100 * paper.translation_relative()[other], 2), shift),
            ]
        )
    return rows


def difference_rows(category: str, found: dict[str, list[dict[str, Any]]]) -> list[list[str]]:
    """One row per part: how much larger the Euclidean errors are, ± the standard error."""
    rows = []
    for index, part in enumerate(found["lie"][0]["parts"]):
        cells = []
        pairs = zip(_values(found["euclidean"], index), _values(found["lie"], index), strict=True)
        for (euclidean, factor, digits), (lie, _, _) in pairs:
            error = None
            if len(lie) > 1:
                error = float(np.sqrt((euclidean.var(ddof=1) + lie.var(ddof=1)) / len(lie)))
            difference = float(euclidean.mean() - lie.mean())
            cells.append(spread(factor * difference, _scaled(factor, error), digits))
        rows.append([category, part["name"], "euclidean - lie", "", cells[0], "", "", cells[1]])
    return rows


def deviation(values: np.ndarray) -> float | None:
    """Standard deviation of a sample; None of a single value."""
    return float(values.std(ddof=1)) if len(values) > 1 else None


def _values(found: Sequence[dict[str, Any]], part: int):
    """Per metric: the mean errors of all seeds [S], the factor to show them by, and digits."""
    for metric, factor, digits in _METRICS:
        values = np.array([one["parts"][part][metric]["mean"] for one in found])
        yield values, factor, digits


def _scaled(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value
