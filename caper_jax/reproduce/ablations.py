"""What each idea of the paper is worth: models without it, trained with equal budgets."""

from __future__ import annotations

from typing import Any

from caper_jax import categories
from caper_jax.evaluation.protocol import evaluate, model_predictor
from caper_jax.evaluation.report import summarize
from caper_jax.evaluation.summaries import cell
from caper_jax.reproduce import comparison, runs, trainings
from caper_jax.reproduce.frames import open_frames
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import TABLES, Figures
from caper_jax.reproduce.render import Report, Table, number
from caper_jax.reproduce.static import joint_cells

# Name -> the settings that take the idea away.
VARIANTS = {
    "full": (),
    "no vertical correction": ("network.vertical_correction=false",),
    "direct joints": ("network.joints=direct",),
    "efficientcaper": ("network.vertical_correction=false", "network.joints=direct"),
}
HEADER = (
    *("category", "part", "model", "seed"),
    *("rot paper [deg]", "ours", "trans paper [%]", "ours [%]"),
    *("joint axis [deg]", "pivot [mm]", "state"),
)


def run(name: str, options: Options) -> Report:
    """Trains every variant per category and seed, and measures it on frames of unseen instances.

    Args:
      name: "ablations".
      options: see ``Options``; runs are kept under ``out`` and resumed.

    Raises:
      CaperError: unknown categories, settings or data; see ``trainings.trained``.
      KeyboardInterrupt: training was stopped; the same call goes on from there.
    """
    trainings.check_budget(options)
    paper = TABLES[name]
    known = paper.variants["efficientcaper"]
    beside = {"efficientcaper": known, "full": TABLES["table1"].categories}
    rows: list[list[str]] = []
    facts: list[str] = []
    result: dict[str, Any] = {}
    chosen = options.chosen(known)
    for key in chosen:
        source = open_frames(options, categories.get(key), paper.frames)
        if source is None:
            facts.append(f"{key}: {runs.NO_DATA}")
            continue
        dataset, description = source
        facts.append(f"{key}: {description}")
        result[key] = {"data": description, "variants": {}}
        for variant, changes in VARIANTS.items():
            figure = beside.get(variant, {}).get(key)
            result[key]["variants"][variant] = found = []
            for seed in range(options.seeds):
                label = variant.replace(" ", "_")
                estimator = trainings.trained(key, label, changes, seed, options)
                points = estimator.network.num_points
                errors = evaluate(dataset, model_predictor(estimator), options.frames, 16, points)
                summary = summarize(errors, dataset, "model", None)
                found.append({"seed": seed, "steps": estimator.card["steps"], **summary})
                rows += variant_rows(key, variant, seed, summary, figure)
            steps = ", ".join(f"{one['steps']:,}" for one in found)
            facts.append(f"{key}, {variant}: {steps} training steps")
    figures = {key: known[key] for key in chosen}
    return Report(
        title=paper.title,
        tables=[Table("Errors of one frame, mean / median", HEADER, rows, 4)],
        facts=[
            paper.measured_on(),
            *facts,
            f"{options.seeds} runs of each model, {trainings.describe(options)}",
            "full: all of CAPER++; no vertical correction: the second direction gives way to the "
            "first; direct joints: axis and pivot from pooled features, without heatmap voting; "
            "efficientcaper: neither, which is how the paper describes its forerunner",
            *comparison.assumptions(figures, paper.dataset),
        ],
        result={"categories": result},
    )


def variant_rows(
    category: str, variant: str, seed: int, tables: dict[str, Any], paper: Figures | None
) -> list[list[str]]:
    """One row per part, with the joint that holds it; the paper's figures where it has some."""
    rows = []
    for index, part in enumerate(tables["parts"]):
        turn = shift = None
        if paper is not None:
            other = paper.beside(index)
            turn, shift = paper.rotation_deg[other], 100 * paper.translation_relative()[other]
        rows.append(
            [
                *(category, part["name"], variant, str(seed)),
                *(number(turn, 1), cell(part["rotation_deg"], 1.0, 2)),
                *(number(shift, 2), cell(part["translation_relative"], 100.0, 2)),
                *joint_cells(tables, index),
            ]
        )
    return rows
