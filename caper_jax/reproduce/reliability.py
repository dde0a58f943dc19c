"""Reliability of the stated standard deviations: how often the truth lies where they say."""

from __future__ import annotations

from collections.abc import Callable
from math import erf
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.types import Dataset
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation.metrics import PoseErrors, pose_errors
from caper_jax.evaluation.protocol import evaluate
from caper_jax.models.uncertainty import COVERAGE
from caper_jax.reproduce import runs
from caper_jax.reproduce.frames import open_frames
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.render import Curves, Report, Table, number
from caper_jax.training.fit_uncertainty import nearer_symmetry

LEVELS = (0.5, 0.7, 0.8, COVERAGE, 0.95, 0.99)
HEADER = ("category", "of", "part", *(f"{100 * level:.0f} %" for level in LEVELS), "median std")
_FRAMES = 1000
_CURVE = np.linspace(0.02, 0.98, 49)


def run(name: str, options: Options) -> Report:
    """Shares of truths inside the regions that a calibrated model states, per part and joint.

    Args:
      name: "reliability".
      options: see ``Options``; without a category all that have a calibrated model.

    Raises:
      CaperError: a named category without a calibrated model or without data.
    """
    rows: list[list[str]] = []
    facts, result, curves = [], {}, {}
    models = runs.need_models(options.category, options.weights, options.object_scale)
    for category, estimator in models.items():
        source = open_frames(options, estimator.category, _FRAMES)
        missing = runs.NO_DATA if source is None else "no calibration in the model card"
        if source is None or estimator.calibration is None:
            if options.category:
                raise CaperError(f"{category}: there is {missing}")
            continue
        dataset, description = source
        scores, deviations = measure(estimator, dataset, options.frames)
        facts.append(f"{category}: {description}")
        lines, table = {}, {}
        for (kind, part), levels in scores.items():
            shares = [float((levels <= level).mean()) for level in LEVELS]
            table[f"{kind} {part}"] = dict(zip(map(str, LEVELS), shares, strict=True))
            cells = [number(100 * share, 1) for share in shares]
            rows.append([category, kind, part, *cells, deviations[kind, part]])
            inside = np.array([(levels <= level).mean() for level in _CURVE])
            lines[f"{kind} {part}"] = (_CURVE, inside)
        result[category] = {"data": description, "shares": table}
        lines["perfect"] = (_CURVE, _CURVE)
        curves[category] = Curves(
            f"reliability: {category}", "stated share", "share of truths inside", lines
        )
    return Report(
        title="Reliability of the stated standard deviations",
        tables=[Table("Share of truths [%] inside the region stated to hold", HEADER, rows, 3)],
        facts=[
            *facts,
            "a region is a ball about the estimate, of a rotation vector, a position or a joint "
            "state, of normally distributed errors with the stated deviation",
            "of objects with a declared symmetry, the truth is the nearer of its two readings",
            f"calibrated for {100 * COVERAGE:.0f} %; smaller and larger shares are as the normal "
            "distribution has them",
        ],
        result={"categories": result},
        curves=curves,
    )


def measure(
    estimator: Estimator, dataset: Dataset, limit: int | None
) -> tuple[dict[tuple[str, str], np.ndarray], dict[tuple[str, str], str]]:
    """By (kind, part): the level [F] of the region that just holds each truth; the median std."""
    stated: list[Any] = []

    def predict(frames, points):
        found = estimator(points)
        stated.append(
            jax.tree.map(np.asarray, (found.rotation_std, found.translation_std, found.state_std))
        )
        return found.pose

    points = estimator.network.num_points
    found = evaluate(dataset, predict, limit, num_points=points)
    # The first call was for the compiler; the last batch was filled up.
    columns = zip(*stated[1:], strict=True)
    turn, shift, state = (np.concatenate(column)[: len(found.names)] for column in columns)
    truth = nearer_symmetry(found.estimate, found.truth, estimator.category)
    errors = pose_errors(found.estimate, truth, estimator.category, found.failed)
    return _levels(estimator.category, errors, turn, shift, state)


def _levels(category: Category, errors: PoseErrors, turn, shift, state):
    levels, deviations = {}, {}

    def add(kind: str, part: str, ratio: np.ndarray, text: str, share: Callable) -> None:
        levels[kind, part] = np.array([share(value) for value in ratio])
        deviations[kind, part] = text

    for k, part in enumerate(category.parts):
        degrees, meters = np.degrees(turn[:, k]), shift[:, k]
        text = f"{np.median(degrees):.2f} deg"
        add("rotation", part, errors.rotation_deg[:, k] / degrees, text, ball_share)
        text = f"{1000 * np.median(meters):.1f} mm"
        add("translation", part, errors.translation_m[:, k] / meters, text, ball_share)
    for j, kind in enumerate(category.joint_types):
        revolute = kind == "revolute"
        unit = np.degrees(state[:, j]) if revolute else state[:, j]
        median = np.median(unit)
        text = f"{median:.2f} deg" if revolute else f"{1000 * median:.1f} mm"
        ratio = errors.state[:, j] / unit
        add("state", category.parts[j + 1], ratio, text, interval_share)
    return levels, deviations


def ball_share(radius: float) -> float:
    """Share of a normal distribution in three dimensions within so many standard deviations."""
    density = np.sqrt(2 / np.pi) * radius * np.exp(-0.5 * radius**2)
    return erf(radius / np.sqrt(2)) - density


def interval_share(radius: float) -> float:
    """The same in one dimension."""
    return erf(radius / np.sqrt(2))
