"""Sweeps: errors against one condition at a time, everything else as in the clean frames.

Clouds of generated frames of instances that training never saw; each sweep changes one thing about
them by known amounts. Errors count up to the category's declared symmetries.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.types import Frame
from caper_jax.errors import unknown_name
from caper_jax.estimator import Estimator
from caper_jax.evaluation.protocol import Evaluation, evaluate
from caper_jax.evaluation.report import FLIPPED_DEG, STATE_UNITS
from caper_jax.reproduce.conditions import SWEEPS, Sweep
from caper_jax.reproduce.data import find_models
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.report import Report, Table, number
from caper_jax.reproduce.robustness import FRAMES, unseen_frames
from caper_jax.visualization.plots import Curves, Panels

_HEADER = (
    *("category", "sweep", "at", "root rot median [deg]", "90 %", f"> {FLIPPED_DEG:.0f} deg [%]"),
    *("root trans median [mm]", "90 %", "state median", "90 %", "implausible [%]"),
)


def run(name: str, options: Options) -> Report:
    """Measures the chosen sweeps for every chosen category.

    Args:
      name: "sweep".
      options: "sweep" are names of ``SWEEPS``; none stands for all.

    Raises:
      CaperError: unknown sweep, a category without a model, or one that cannot be drawn.
    """
    chosen = chosen_sweeps(options.sweep)
    rows: list[list[str]] = []
    result: dict[str, Any] = {}
    curves = {}
    for category, estimator in find_models(options).items():
        draw = cache(partial(unseen_frames, estimator, options))
        result[category] = {}
        for key in chosen:
            sweep = SWEEPS[key]
            levels = [
                {"at": round(at, 2), **measured(estimator, points, truth)}
                for at, points, truth in sweep.levels(draw, options)
            ]
            result[category][key] = levels
            rows += [_row(category, key, level, estimator.category) for level in levels]
            curves[f"{category}_{key}"] = _panels(sweep, levels, estimator.category)
    return Report(
        title="Sweeps: errors against one condition at a time",
        tables=[Table("Errors of estimates", _HEADER, rows, 2)],
        facts=[
            f"{options.frames or FRAMES} generated frames per amount, of instances that training "
            "never saw; errors up to the category's declared symmetries",
            *(f"{key}: {SWEEPS[key].fact}" for key in chosen),
        ],
        result={"axes": {key: SWEEPS[key].axis for key in chosen}, "categories": result},
        curves=curves,
    )


def chosen_sweeps(given: Sequence[str]) -> list[str]:
    """Names of ``--sweep``, which may be repeated or hold commas; all where none is given.

    Raises:
      CaperError: an unknown one.
    """
    names = [name for text in given for name in text.split(",") if name]
    for name in names:
        if name not in SWEEPS:
            raise unknown_name("sweep", name, SWEEPS)
    return list(dict.fromkeys(names)) or list(SWEEPS)


def measured(estimator: Estimator, points: np.ndarray, truth: ArticulatedPose) -> dict[str, Any]:
    """Figures of one amount, JSON-ready: medians and 90th percentiles of the errors, and shares.

    Args:
      estimator: the model.
      points: [F, M, 3] meters, camera frame.
      truth: arrays [F, K, ...].
    """
    found = evaluate(Clouds(estimator.category, points, truth), estimator)
    errors = found.symmetric_errors or found.errors
    root = errors.rotation_deg[:, 0]
    return {
        "frames": len(root),
        "root_rotation_deg": _spread(root),
        "root_translation_m": _spread(errors.translation_m[:, 0]),
        "state": {
            STATE_UNITS[kind]: _spread(errors.state[:, chosen])
            for kind, chosen in _joints(estimator.category).items()
        },
        "flipped": float((root > FLIPPED_DEG).mean()),
        "implausible": _implausible(found),
    }


class Clouds:
    """Clouds and their truth as a dataset."""

    format, split, mask_source, checked = "generated", "test", "simulated", True

    def __init__(self, category: Category, points: np.ndarray, truth: ArticulatedPose) -> None:
        self.category = category
        self.names: Sequence[str] = [f"{index:06d}" for index in range(len(points))]
        self._points, self._truth = points, truth

    def videos(self) -> dict[str, list[int]]:
        return {}

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        truth = jax.tree.map(lambda array: array[index], self._truth)
        return Frame(name=self.names[index], points=self._points[index], truth=truth)


def _joints(category: Category) -> dict[str, list[int]]:
    """Type of joint -> the joints of that type."""
    joints: dict[str, list[int]] = {}
    for j, kind in enumerate(category.joint_types):
        joints.setdefault(kind, []).append(j)
    return joints


def _spread(values: np.ndarray) -> dict[str, float]:
    median, most = np.quantile(np.asarray(values, np.float64), [0.5, 0.9])
    return {"median": float(median), "p90": float(most)}


def _implausible(found: Evaluation) -> float:
    assert found.plausible is not None  # every Estimator says so
    return float(1.0 - found.plausible.mean())


def _row(category: str, key: str, level: dict[str, Any], definition: Category) -> list[str]:
    rotation, translation = level["root_rotation_deg"], level["root_translation_m"]
    states = [
        (spread, 1000.0 if unit == "meters" else 1.0, "mm" if unit == "meters" else "deg")
        for unit, spread in level["state"].items()
    ]
    return [
        *(category, key, f"{level['at']:g}"),
        *(number(rotation[one], 2) for one in ("median", "p90")),
        number(level["flipped"], 1, 100.0),
        *(number(translation[one], 1, 1000.0) for one in ("median", "p90")),
        *(
            ", ".join(f"{number(spread[one], 1, factor)} {unit}" for spread, factor, unit in states)
            for one in ("median", "p90")
        ),
        number(level["implausible"], 1, 100.0),
    ]


def _panels(sweep: Sweep, levels: list[dict[str, Any]], category: Category) -> Panels:
    """Errors of root and states on logarithmic axes, and the shares of turned and doubted ones."""
    at = np.array([level["at"] for level in levels])

    def lines(values: list[dict[str, float]], factor: float = 1.0, of: str = ""):
        return {
            f"{of}{label}": (at, factor * np.array([value[one] for value in values]))
            for one, label in (("median", "median"), ("p90", "90th percentile"))
        }

    states: dict[str, Any] = {}
    for unit in levels[0]["state"]:
        factor, short = (1000.0, "mm") if unit == "meters" else (1.0, "deg")
        values = [level["state"][unit] for level in levels]
        states |= lines(values, factor, f"{short}: " if len(levels[0]["state"]) > 1 else "")
        state_label = f"states [{short}]"
    if len(levels[0]["state"]) > 1:
        state_label = "states"
    shares = {
        label: (at, 100 * np.array([level[one] for level in levels]))
        for one, label in (
            ("flipped", f"root off by more than {FLIPPED_DEG:.0f} deg"),
            ("implausible", "implausible by its own word"),
        )
    }
    panel = partial(Curves, "", sweep.axis, log_x=sweep.log, marked=True)
    rotation = [level["root_rotation_deg"] for level in levels]
    translation = [level["root_translation_m"] for level in levels]
    return Panels(
        f"{category.name}: errors against {sweep.title}",
        [
            panel("root rotation [deg]", lines(rotation), log_y=True),
            panel("root translation [mm]", lines(translation, 1000.0), log_y=True),
            panel(state_label, states, log_y=True),
            panel("share of frames [%]", shares),
        ],
    )
