"""What ideas of the paper are worth: models without them, trained with equal budgets."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from caper_jax import categories
from caper_jax.config import IncrementKind, RefinerConfig, override
from caper_jax.data.types import Dataset
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load
from caper_jax.evaluation.protocol import evaluate, model_predictor
from caper_jax.evaluation.report import format_error, format_joint, summarize
from caper_jax.models.files import CARD_FILE
from caper_jax.reproduce import tracking
from caper_jax.reproduce.data import NO_DATA, open_frames, open_videos
from caper_jax.reproduce.options import DEFAULT_MINUTES, Options
from caper_jax.reproduce.paper import Figures, paper
from caper_jax.reproduce.report import (
    RELATIVE,
    Report,
    Table,
    assumptions,
    number,
    paper_json,
    spread,
)
from caper_jax.tracker import Tracker, config_for
from caper_jax.training import train as training

_PRESET = "fast"
# Name -> the settings that take the idea away.
VARIANTS = {
    "full": (),
    "no vertical correction": ("network.vertical_correction=false",),
    "direct joints": ("network.joints=direct",),
    "efficientcaper": ("network.vertical_correction=false", "network.joints=direct"),
}
_HEADER = (
    *("category", "part", "model", "seed"),
    *("rot paper [deg]", "ours", "trans paper [%]", "ours [%]"),
    *("joint axis [deg]", "pivot [mm]", "state"),
)
INCREMENTS: tuple[IncrementKind, ...] = get_args(IncrementKind)
_INCREMENTS_HEADER = (
    *("category", "part", "increment"),
    *("rot paper [deg]", "ours", "trans paper [m]", "paper [%]", "ours [%]"),
)
# Metric -> (factor to show it by, digits).
_METRICS = {"rotation_deg": (1.0, 2), "translation_relative": (100.0, 2)}


def run(name: str, options: Options) -> Report:
    """Trains every variant per category and seed, and measures it on unseen instances.

    Args:
      name: "ablations", single frames without some of the paper's ideas; or "table9", tracking by
        the network alone with increments in the Lie algebra or Euclidean ones.
      options: see ``Options``; runs are kept under ``out`` and resumed.

    Raises:
      CaperError: unknown categories, settings or data; see ``train``.
      KeyboardInterrupt: training was stopped; the same call goes on from there.
    """
    options.budget()  # a contradiction in it is found before anything is drawn
    return _increments(options) if name == "table9" else _ablations(options)


def train(
    category: str, label: str, changes: Sequence[str], seed: int, options: Options
) -> Estimator:
    """A model of one kind; trained now, resumed, or read where an earlier call finished it.

    Args:
      category: its name.
      label: of the kind, in the name of its folder under ``options.out``.
      changes: KEY=VALUE, what makes it of this kind, besides ``options.settings``.
      seed: of weights and data.
      options: give budget and start.

    Raises:
      CaperError: see ``training.train.train``; a run kept there with other settings.
      KeyboardInterrupt: training was stopped before its budget was used up; the same call goes on.
    """
    directory = options.out / "runs" / f"{category}_{label}_{options.budget()}_seed{seed}"
    config = override(training.preset(_PRESET, category), *options.settings, *changes)
    minutes = None if options.steps else options.minutes or DEFAULT_MINUTES
    config = replace(
        config,
        # The outputs of both stages are compared; refiner and uncertainty would take time only.
        network=replace(config.network, refiner=RefinerConfig()),
        calibration_frames=0,
        training=replace(config.training, steps=options.steps, minutes=minutes, seed=seed),
    )
    finished = (directory / CARD_FILE).is_file()
    if not finished and not training.train(config, directory, options.initial).finished:
        raise KeyboardInterrupt
    estimator = load(category, directory)
    if estimator.network != config.network:
        raise CaperError(
            f"{directory} holds a finished run of another network; choose another --out"
        )
    return estimator


def train_seeds(
    category: str, label: str, changes: Sequence[str], options: Options
) -> Iterator[tuple[int, Estimator]]:
    """(seed, model) of all runs of one kind; see ``train``."""
    for seed in range(options.seeds):
        yield seed, train(category, label, changes, seed, options)


def describe_training(options: Options, kind: str = "kind") -> str:
    """Number, budget and start of the runs, as a line of a report."""
    minutes = options.minutes or DEFAULT_MINUTES
    budget = f"{options.steps} steps" if options.steps else f"{minutes:g} minutes"
    start = "random weights" if options.initial is None else f"the model in {options.initial}"
    return (
        f"{options.seeds} runs of each {kind}, {budget} each, preset {_PRESET}, from {start}, on "
        "generated frames"
    )


def frames_of(
    options: Options, names: Iterable[str], facts: list[str]
) -> Iterator[tuple[str, Dataset, str]]:
    """(name, frames, description) of the categories with data; adds a line on each to ``facts``."""
    for name in names:
        source = open_frames(options, categories.get(name))
        facts.append(f"{name}: {NO_DATA if source is None else source[1]}")
        if source is not None:
            yield name, *source


def _steps(category: str, kind: str, runs: Sequence[Mapping[str, Any]]) -> str:
    steps = ", ".join(f"{one['steps']:,}" for one in runs)
    return f"{category}, {kind}: {steps} training steps"


def _ablations(options: Options) -> Report:
    table = paper().tables["ablations"]
    known = table.variants["efficientcaper"]
    beside = {"efficientcaper": known, "full": paper().tables["table1"].categories}
    rows: list[list[str]] = []
    facts: list[str] = []
    result: dict[str, Any] = {}
    chosen = options.chosen(known)
    for key, dataset, description in frames_of(options, chosen, facts):
        result[key] = {"data": description, "variants": {}}
        for variant, changes in VARIANTS.items():
            figures = beside.get(variant, {}).get(key)
            runs = result[key]["variants"][variant] = []
            for seed, estimator in train_seeds(key, variant.replace(" ", "_"), changes, options):
                predictor, num_points = model_predictor(estimator), estimator.network.num_points
                estimates = evaluate(dataset, predictor, options.frames, num_points=num_points)
                summary = summarize(estimates, dataset, "model", None)
                runs.append({"seed": seed, "steps": estimator.card["steps"], **summary})
                rows += _variant_rows(key, variant, seed, summary, figures)
            facts.append(_steps(key, variant, runs))
    return Report(
        title=table.title,
        tables=[Table("Errors of one frame, mean / median", _HEADER, rows, 4)],
        facts=[
            table.measured_on(),
            *facts,
            describe_training(options, "model"),
            "full: all of CAPER++; no vertical correction: the second direction gives way to the "
            "first; direct joints: axis and pivot from pooled features, without heatmap voting; "
            "efficientcaper: neither, which is how the paper describes its forerunner",
            *assumptions({key: known[key] for key in chosen}, table.dataset),
        ],
        result={"categories": result},
    )


def _variant_rows(
    category: str, variant: str, seed: int, tables: Mapping[str, Any], figures: Figures | None
) -> list[list[str]]:
    """One row per part, with the joint that holds it; the paper's figures where it has some."""
    joints = [["-"] * 3, *map(format_joint, tables["joints"])]
    rows = []
    for index, part in enumerate(tables["parts"]):
        beside = figures.part(index) if figures else {}
        rows.append(
            [
                *(category, part["name"], variant, str(seed)),
                number(beside.get("rotation_deg"), 1),
                format_error(part["rotation_deg"], 1.0, 2),
                number(beside.get("translation_relative"), 2, 100.0),
                format_error(part["translation_relative"], 100.0, 2),
                *joints[index],
            ]
        )
    return rows


def _increments(options: Options) -> Report:
    table = paper().tables["table9"]
    rows: list[list[str]] = []
    facts, result = [], {}
    chosen = options.chosen(table.variants["lie"])
    for key in chosen:
        videos = open_videos(options, categories.get(key), table.videos, table.frames)
        facts.append(f"{key}: {NO_DATA if videos is None else videos.description}")
        if videos is None:
            continue
        condition = tracking.Condition()
        runs: dict[str, list[dict[str, Any]]] = {kind: [] for kind in INCREMENTS}
        for kind in INCREMENTS:
            for seed, estimator in train_seeds(key, kind, [f"network.increment={kind}"], options):
                tracker = Tracker(estimator, tracking.network_alone(config_for(estimator)))
                tracks = tracking.track_all(tracker, videos, condition)
                summary = tracking.summarize(tracks, videos, condition)
                runs[kind].append({"seed": seed, "steps": estimator.card["steps"], **summary})
            facts.append(_steps(key, kind, runs[kind]))
            rows += increment_rows(key, kind, runs[kind], table.variants[kind][key])
        rows += difference_rows(key, runs)
        beside = {kind: paper_json(table.variants[kind][key]) for kind in INCREMENTS}
        result[key] = {"paper": beside, "runs": runs}
    figures = {key: table.variants["lie"][key] for key in chosen}
    return Report(
        title=table.title,
        tables=[Table("Mean ± standard deviation over seeds", _INCREMENTS_HEADER, rows, 3)],
        facts=[
            table.measured_on(),
            *facts,
            describe_training(options),
            "tracker: the network's increments alone, without registration; first pose given",
            RELATIVE,
            "euclidean - lie: difference of the means ± its standard error; above 0 the Lie "
            "algebra is better",
            *assumptions(figures, table.dataset),
        ],
        result={"categories": result},
    )


def increment_rows(
    category: str, kind: str, runs: Sequence[Mapping[str, Any]], figures: Figures
) -> list[list[str]]:
    """One row per part, from the summaries of all seeds."""
    rows = []
    for index, part in enumerate(runs[0]["parts"]):
        beside = figures.part(index)
        rotation, translation = (
            spread(values.mean(), _deviation(values), digits, factor)
            for values, (factor, digits) in zip(_means(runs, index), _METRICS.values(), strict=True)
        )
        rows.append(
            [
                *(category, part["name"], kind),
                *(number(beside["rotation_deg"], 1), rotation),
                number(beside["translation_m"], 3),
                *(number(beside["translation_relative"], 2, 100.0), translation),
            ]
        )
    return rows


def difference_rows(
    category: str, runs: Mapping[str, Sequence[Mapping[str, Any]]]
) -> list[list[str]]:
    """One row per part: how much larger the Euclidean errors are, ± the standard error."""
    rows = []
    for index, part in enumerate(runs["lie"][0]["parts"]):
        texts = []
        pairs = zip(_means(runs["euclidean"], index), _means(runs["lie"], index), strict=True)
        for (euclidean, lie), (factor, digits) in zip(pairs, _METRICS.values(), strict=True):
            error = None
            if len(lie) > 1:
                error = float(np.sqrt((euclidean.var(ddof=1) + lie.var(ddof=1)) / len(lie)))
            texts.append(spread(euclidean.mean() - lie.mean(), error, digits, factor))
        rows.append([category, part["name"], "euclidean - lie", "", texts[0], "", "", texts[1]])
    return rows


def _deviation(values: np.ndarray) -> float | None:
    """Standard deviation of a sample; None of a single value."""
    return float(values.std(ddof=1)) if len(values) > 1 else None


def _means(runs: Sequence[Mapping[str, Any]], part: int) -> list[np.ndarray]:
    """Per metric the mean errors of all seeds [S]."""
    return [np.array([one["parts"][part][metric]["mean"] for one in runs]) for metric in _METRICS]
