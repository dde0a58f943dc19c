"""Tables 1, 2, 3 and 8, and reliability: the single-frame estimator."""

from __future__ import annotations

from collections.abc import Mapping
from math import erf
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.types import Dataset
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation.metrics import PoseErrors, object_diagonal, pose_errors
from caper_jax.evaluation.protocol import evaluate
from caper_jax.evaluation.report import (
    FLIPPED_DEG,
    format_error,
    format_joint,
    format_share,
    summarize,
)
from caper_jax.models.uncertainty import COVERAGE
from caper_jax.reproduce.data import NO_DATA, NO_MODEL, find_model, find_models, open_frames
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import paper
from caper_jax.reproduce.report import (
    ERROR_HEADER,
    ERROR_LABELS,
    ERROR_NOTES,
    Report,
    Table,
    assumptions,
    error_rows,
    missing_rows,
    number,
    paper_json,
)
from caper_jax.training.fit_uncertainty import nearer_symmetry
from caper_jax.visualization.plots import Curves

_LABEL = "as labeled"
_FLIPPED = f"> {FLIPPED_DEG:.0f} deg [%]"
_SPREAD_HEADER = (
    *("category", "part", "truth", "rot [deg]", _FLIPPED, "trans [mm]"),
    *("IoU size [%]", "IoU full [%]", "joint axis [deg]", "pivot [mm]", "state"),
)
_OPENING_HEADER = (
    *("category", "open by", "frames", "root rot [deg]", _FLIPPED, "root trans [mm]"),
)
_OCCLUSION_CATEGORY = "drawer"  # the paper's
_OCCLUSION_HEADER = (
    *("category", "occluded", "parts so occluded", "rot paper [deg]", "ours"),
    *("trans paper [m]", "paper [%]", "ours [%]"),
)
LEVELS = (0.5, 0.7, 0.8, COVERAGE, 0.95, 0.99)
_LEVELS_DRAWN = np.linspace(0.02, 0.98, 49)


def run(name: str, options: Options) -> Report:
    """Measures every chosen category of a table that has a model.

    Args:
      name: "table1", "table2", "table3", "table8" or "reliability".
      options: see ``Options``.

    Raises:
      CaperError: a category that the table does not have, a damaged model, or data that cannot
        be read or drawn.
    """
    if name == "table8":
        return _occlusion(options)
    if name == "reliability":
        return _reliability(options)
    table = paper().tables[name]
    figures = {key: table.categories[key] for key in options.chosen(table.categories)}
    rows: list[list[str]] = []
    spreads: list[list[str]] = []
    openings: list[list[str]] = []
    facts, result = [], {}
    for key, figure in figures.items():
        errors = measure(key, options)
        result[key] = {"paper": paper_json(figure), **errors}
        if "missing" in errors:
            rows += missing_rows(key, figure, errors["missing"])
            continue
        facts.append(
            f"{key}: {errors['data']}, mean diagonal {errors['mean_diagonal_m']:.3f} m, object "
            f"masks {errors['mask_source']}, {errors['failures']} failures"
        )
        rows += error_rows(key, _LABEL, errors, figure)
        spreads += _spread_rows(key, _LABEL, errors)
        if "up_to_symmetry" in errors:
            spreads += _spread_rows(key, f"{_LABEL}, up to symmetry", errors["up_to_symmetry"])
        openings += _opening_rows(key, errors)
    header = ("category", "part", "truth", *ERROR_HEADER)
    tables = [Table("Mean errors of one frame", header, rows, ERROR_LABELS)]
    if spreads:
        tables.append(Table("All errors, mean / median", _SPREAD_HEADER, spreads, ERROR_LABELS))
    if openings:
        caption = "The root by how far the most open joint is open, mean / median"
        tables.append(Table(caption, _OPENING_HEADER, openings))
    return Report(
        title=table.title,
        tables=tables,
        facts=[
            table.measured_on(),
            *facts,
            "parts of the points are predicted, never given",
            *ERROR_NOTES,
            "means over all frames; a failed frame counts with the worst value",
            *assumptions(figures, table.dataset),
        ],
        result={"categories": result},
    )


def measure(category: str, options: Options) -> dict[str, Any]:
    """Errors of one category's model as ``summarize`` gives them; "missing" says why none.

    Also "data", which describes them, and "mean_diagonal_m" of the objects shown.
    """
    estimator = find_model(category, options)
    if estimator is None:
        return {"missing": NO_MODEL}
    source = open_frames(options, estimator.category)
    if source is None:
        return {"missing": NO_DATA}
    dataset, description = source
    estimates = evaluate(dataset, estimator, options.frames)
    weights = None if options.weights is None else str(options.weights)
    return {
        "data": description,
        "mean_diagonal_m": float(np.mean(object_diagonal(estimates.truth))),
        **summarize(estimates, dataset, "model", weights),
    }


def _spread_rows(category: str, label: str, tables: Mapping[str, Any]) -> list[list[str]]:
    """One row per part, and of the joint that holds it: mean / median of every error."""
    joints = [["-"] * 3, *map(format_joint, tables["joints"])]
    return [
        [
            *(category, part["name"], label),
            format_error(part["rotation_deg"], 1.0, 2),
            number(part["flipped"], 1, 100.0),
            format_error(part["translation_m"], 1000.0, 1),
            format_error(part["iou_size"], 100.0, 1),
            format_error(part["iou_full"], 100.0, 1),
            *joint,
        ]
        for part, joint in zip(tables["parts"], joints, strict=True)
    ]


def _opening_rows(category: str, errors: Mapping[str, Any]) -> list[list[str]]:
    """One row per bin of ``errors_by_opening`` that has frames."""
    roots = [(entry["opened"], entry["parts"][0]) for entry in errors.get("by_opening", ())]
    return [
        [
            *(category, format_share(opened), str(root["frames"])),
            format_error(root["rotation_deg"], 1.0, 2),
            number(root["flipped"], 1, 100.0),
            format_error(root["translation_m"], 1000.0, 1),
        ]
        for opened, root in roots
        if root["frames"]
    ]


def _occlusion(options: Options) -> Report:
    """Table 8: means over all parts of all frames within each bin of occlusion.

    Raises:
      CaperError: no model or no data of a category, or data that do not say what is hidden.
    """
    figures = {entry.occluded: entry for entry in paper().occlusion}
    diagonal = paper().diagonal_m["partnet"][_OCCLUSION_CATEGORY]
    rows: list[list[str]] = []
    facts, result = [], {}
    for category in options.category or (_OCCLUSION_CATEGORY,):
        errors = measure(category, options)
        if "missing" in errors:
            raise CaperError(f"{category}: there is {errors['missing']}")
        if "by_occlusion" not in errors:
            raise CaperError(f"{category}: the data do not say how much of a part is hidden")
        facts.append(f"{category}: {errors['data']}, object masks {errors['mask_source']}")
        bins = [_pooled(entry) for entry in errors["by_occlusion"]]
        result[category] = {"data": errors["data"], "bins": bins}
        for entry in bins:
            rotation = meters = None
            if category == _OCCLUSION_CATEGORY:
                beside = figures[entry["occluded"]]
                rotation, meters = beside.rotation_deg, beside.translation_m
            rows.append(
                [
                    *(category, format_share(entry["occluded"]), str(entry["count"])),
                    number(rotation, 1),
                    number(entry["rotation_deg"], 2),
                    number(meters, 3),
                    number(meters, 2, 100.0 / diagonal),
                    number(entry["translation_relative"], 2, 100.0),
                ]
            )
    caption = "Mean errors of parts by the share that is hidden"
    return Report(
        title="Table 8, self-occlusion (Sec 6.4)",
        tables=[Table(caption, _OCCLUSION_HEADER, rows, 2)],
        facts=[
            "the paper measured on the drawers of ArtImage, ours were measured on:",
            *facts,
            "a part's occlusion: the share of its surface, as seen from the camera's side, that "
            "something hides; the paper calls 80-100 % highly occluded",
            f"the paper's meters are divided by an assumed diagonal: {diagonal:g} m",
        ],
        result={"categories": result},
    )


def _pooled(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Means over all parts in a bin, from their means and counts; None in an empty bin."""
    parts = [part for part in entry["parts"] if part["frames"]]
    counts = [part["frames"] for part in parts]
    means = {
        metric: float(np.average([part[metric]["mean"] for part in parts], weights=counts))
        if parts
        else None
        for metric in ("rotation_deg", "translation_relative")
    }
    return {"occluded": tuple(entry["occluded"]), "count": sum(counts), **means}


def _reliability(options: Options) -> Report:
    """Shares of truths inside the regions that a calibrated model states, per part and joint.

    Raises:
      CaperError: a named category without a calibrated model or without data.
    """
    rows: list[list[str]] = []
    facts, result, curves = [], {}, {}
    for category, estimator in find_models(options).items():
        source = open_frames(options, estimator.category)
        if source is None or estimator.calibration is None:
            if options.category:
                missing = NO_DATA if source is None else "no calibration in the model card"
                raise CaperError(f"{category}: there is {missing}")
            continue
        dataset, description = source
        levels, deviations = measure_reliability(estimator, dataset, options.frames)
        facts.append(f"{category}: {description}")
        lines, table = {}, {}
        for (kind, part), values in levels.items():
            shares = [float((values <= level).mean()) for level in LEVELS]
            table[f"{kind} {part}"] = dict(zip(map(str, LEVELS), shares, strict=True))
            texts = [number(share, 1, 100.0) for share in shares]
            rows.append([category, kind, part, *texts, deviations[kind, part]])
            inside = np.array([(values <= level).mean() for level in _LEVELS_DRAWN])
            lines[f"{kind} {part}"] = (_LEVELS_DRAWN, inside)
        result[category] = {"data": description, "shares": table}
        lines["perfect"] = (_LEVELS_DRAWN, _LEVELS_DRAWN)
        curves[category] = Curves(
            f"reliability: {category}", "stated share", "share of truths inside", lines
        )
    header = ("category", "of", "part", *(f"{100 * level:.0f} %" for level in LEVELS), "median std")
    return Report(
        title="Reliability of the stated standard deviations",
        tables=[Table("Share of truths [%] inside the region stated to hold", header, rows, 3)],
        facts=[
            *facts,
            "a region is a ball about the estimate, of a rotation vector or a position, or an "
            "interval of an extent or a joint state, of normally distributed errors with the "
            "stated deviation",
            "of objects with a declared symmetry, the truth is the nearer of the equivalent poses",
            f"calibrated for {100 * COVERAGE:.0f} %; smaller and larger shares are as the normal "
            "distribution has them",
        ],
        result={"categories": result},
        curves=curves,
    )


def measure_reliability(
    estimator: Estimator, dataset: Dataset, limit: int | None
) -> tuple[dict[tuple[str, str], np.ndarray], dict[tuple[str, str], str]]:
    """By (kind, part): the level [F] of the region that just holds each truth; the median std."""
    stated: list[Any] = []

    def predict(frames, points):
        prediction = estimator(points)
        deviations = (
            *(prediction.rotation_std, prediction.translation_std, prediction.state_std),
            prediction.size_std,  # None of models whose calibration is older
        )
        stated.append(jax.tree.map(np.asarray, deviations))
        return prediction.pose

    num_points = estimator.network.num_points
    estimates = evaluate(dataset, predict, limit, num_points=num_points)
    # The first call was for the compiler; the last batch was filled up.
    rotation_std, translation_std, state_std, size_std = jax.tree.map(
        lambda *batches: np.concatenate(batches)[: len(estimates.names)], *stated[1:]
    )
    category = estimator.category
    truth = nearer_symmetry(estimates.estimate, estimates.truth, category)
    errors = pose_errors(estimates.estimate, truth, category, estimates.failed)
    off = None if size_std is None else np.abs(estimates.estimate.size - truth.size)
    return _levels(category, errors, rotation_std, translation_std, state_std, off, size_std)


def _levels(
    category: Category,
    errors: PoseErrors,
    rotation_std,
    translation_std,
    state_std,
    size_error,
    size_std,
):
    """What ``measure_reliability`` gives, from deviations in radians and meters."""
    levels, deviations = {}, {}

    def add(kind: str, part: str, error, std, share, digits: int, unit: str, factor=1.0) -> None:
        levels[kind, part] = np.array([share(radius) for radius in error / std])
        deviations[kind, part] = f"{factor * np.median(std):.{digits}f} {unit}"

    for k, part in enumerate(category.parts):
        degrees = np.degrees(rotation_std[:, k])
        add("rotation", part, errors.rotation_deg[:, k], degrees, ball_share, 2, "deg")
        meters = translation_std[:, k]
        add("translation", part, errors.translation_m[:, k], meters, ball_share, 1, "mm", 1000)
        if size_std is not None:  # the three extents together
            extents = size_error[:, k].ravel(), size_std[:, k].ravel()
            add("size", part, *extents, interval_share, 1, "mm", 1000)
    for j, kind in enumerate(category.joint_types):
        part, error, std = category.parts[j + 1], errors.state[:, j], state_std[:, j]
        if kind == "revolute":
            add("state", part, error, np.degrees(std), interval_share, 2, "deg")
        else:
            add("state", part, error, std, interval_share, 1, "mm", 1000)
    return levels, deviations


def ball_share(radius: float) -> float:
    """Share of a normal distribution in three dimensions within so many standard deviations."""
    density = np.sqrt(2 / np.pi) * radius * np.exp(-0.5 * radius**2)
    return erf(radius / np.sqrt(2)) - density


def interval_share(radius: float) -> float:
    """The same in one dimension."""
    return erf(radius / np.sqrt(2))
