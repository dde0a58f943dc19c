"""What an evaluation leaves behind: metrics.json, predictions.npz and a table for people."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.schema import Dataset
from caper_jax.evaluation.metrics import (
    FAILURE_VALUES,
    JOINT_METRICS,
    PART_METRICS,
    PoseErrors,
    pose_errors,
    pose_errors_up_to_symmetry,
)
from caper_jax.evaluation.protocol import Evaluation
from caper_jax.files import write_atomically

METRICS_FILE = "metrics.json"
PREDICTIONS_FILE = "predictions.npz"
_STATE_UNITS = {"revolute": "degrees", "prismatic": "metres"}


def summarise(
    evaluation: Evaluation, dataset: Dataset, predictor: str, weights: str | None
) -> dict[str, Any]:
    """The content of metrics.json: counts, and mean and median of every error.

    Failed frames are in every mean and median, with the values that "failure_value" names. For a
    category with declared equivalences, "up_to_symmetry" holds the same errors against the better
    reading of the truth; "parts" and "joints" never do.

    Args:
      evaluation: from ``protocol.evaluate``.
      dataset: where the frames came from.
      predictor: "model", "truth" or "mean".
      weights: the model, for people; None when none was used.
    """
    category = dataset.category
    arguments = (evaluation.estimate, evaluation.truth, category, evaluation.failed)
    report = {
        "category": category.name,
        "format": dataset.format,
        "split": dataset.split,
        "frames": len(evaluation.names),
        "failures": int(evaluation.failed.sum()),
        "mask_source": dataset.mask_source,
        **_tables(pose_errors(*arguments), category),
        "seconds_per_frame": evaluation.seconds_per_frame,
        "predictor": predictor,
        "weights": weights,
        "failure_value": FAILURE_VALUES,
    }
    if category.equivalences:
        report["up_to_symmetry"] = {
            "reasons": [equivalence.reason for equivalence in category.equivalences],
            **_tables(pose_errors_up_to_symmetry(*arguments), category),
        }
    return report


def _tables(errors: PoseErrors, category: Category) -> dict[str, list[dict[str, Any]]]:
    parts = [
        {"name": name, **{key: _summary(getattr(errors, key)[:, k]) for key in PART_METRICS}}
        for k, name in enumerate(category.parts)
    ]
    joints = [
        {
            "type": kind,
            **{key: _summary(getattr(errors, key)[:, j]) for key in JOINT_METRICS},
            "state_unit": _STATE_UNITS[kind],
        }
        for j, kind in enumerate(category.joint_types)
    ]
    return {"parts": parts, "joints": joints}


def _summary(values: np.ndarray) -> dict[str, float | None]:
    """Mean and median; None where the error has no meaning (pivots of prismatic joints)."""
    if np.isnan(values).all():
        return {"mean": None, "median": None}
    # Nine digits: the truth's IoU is 1, not one rounding of float64 below it.
    return {
        "mean": float(f"{np.mean(values):.9g}"),
        "median": float(f"{np.median(values):.9g}"),
    }


def write_report(folder: str | Path, evaluation: Evaluation, report: dict[str, Any]) -> None:
    """Writes metrics.json and predictions.npz, each whole or not at all.

    predictions.npz holds, for F frames in order, ``frame`` (names), ``failed`` [F] and the
    estimates ``R`` [F, K, 3, 3], ``t``, ``size``, ``box_center`` [F, K, 3] (metres),
    ``joint_axis``, ``joint_pivot`` [F, J, 3], ``joint_state`` [F, J] (radians or metres), NaN where
    failed, and the ground truth under the same names with ``truth_`` before: every error in
    metrics.json can be computed from it.

    Args:
      folder: exists.
      evaluation: the estimates.
      report: from ``summarise``.
    """
    arrays: dict[str, np.ndarray] = {
        "frame": np.array(evaluation.names),
        "failed": evaluation.failed,
    }
    for prefix, pose in (("", evaluation.estimate), ("truth_", evaluation.truth)):
        for name, key in (
            ("R", "rotation"),
            ("t", "translation"),
            ("size", "size"),
            ("box_center", "box_center"),
            ("joint_axis", "joint_axis"),
            ("joint_pivot", "joint_pivot"),
            ("joint_state", "joint_state"),
        ):
            arrays[prefix + name] = np.asarray(getattr(pose, key))
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    folder = Path(folder)
    write_atomically(folder / PREDICTIONS_FILE, buffer.getvalue())
    text = json.dumps(report, indent=2, allow_nan=False)
    write_atomically(folder / METRICS_FILE, text.encode() + b"\n")


def format_report(report: dict[str, Any]) -> str:
    """The report as plain text, at most 80 columns: medians and means of parts and joints."""
    lines = [
        f"{report['category']}, {report['format']} ({report['split']}): {report['frames']} frames, "
        f"{report['failures']} failed; predictor: {report['predictor']}",
        f"object masks: {report['mask_source']}; "
        f"{1000 * report['seconds_per_frame']:.1f} ms per frame",
        "each cell: mean / median",
        "",
        *_format_tables(report),
    ]
    if "up_to_symmetry" in report:
        symmetric = report["up_to_symmetry"]
        lines += ["", f"up to symmetry ({'; '.join(symmetric['reasons'])}):"]
        lines += _format_tables(symmetric)
    return "\n".join(lines)


def _format_tables(tables: dict[str, Any]) -> list[str]:
    rows = [["part", "rotation [deg]", "translation [mm]", "IoU full", "IoU size"]]
    for part in tables["parts"]:
        rows.append(
            [
                part["name"],
                _cell(part["rotation_deg"], 1, 2),
                _cell(part["translation_m"], 1000, 1),
                _cell(part["iou_full"], 1, 3),
                _cell(part["iou_size"], 1, 3),
            ]
        )
    lines = [*align(rows), ""]
    rows = [["joint", "axis [deg]", "pivot [mm]", "state"]]
    for joint, part in zip(tables["joints"], tables["parts"][1:], strict=True):
        metres = joint["state_unit"] == "metres"
        rows.append(
            [
                f"{part['name']} ({joint['type']})",
                _cell(joint["axis_deg"], 1, 2),
                _cell(joint["pivot_m"], 1000, 1),
                _cell(joint["state"], 1000 if metres else 1, 2) + (" mm" if metres else " deg"),
            ]
        )
    return lines + align(rows)


def _cell(summary: dict[str, float | None], factor: float, digits: int) -> str:
    mean, median = summary["mean"], summary["median"]
    if mean is None or median is None:
        return "-"
    return f"{factor * mean:.{digits}f} / {factor * median:.{digits}f}"


def align(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines; the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *others in rows:
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *cells]))
    return lines
