"""What an evaluation leaves behind: metrics.json, predictions.npz and a table for people."""

from __future__ import annotations

import io
import json
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.types import Dataset
from caper_jax.evaluation.breakdown import by_occlusion, by_opening, format_bins
from caper_jax.evaluation.metrics import (
    FAILURE_VALUES,
    JOINT_METRICS,
    PART_METRICS,
    PoseErrors,
    pose_errors,
    pose_errors_up_to_symmetry,
)
from caper_jax.evaluation.protocol import Evaluation
from caper_jax.evaluation.summaries import TURNED_DEG, align, cell, summary, turned
from caper_jax.files import write_atomically

METRICS_FILE = "metrics.json"
PREDICTIONS_FILE = "predictions.npz"
_STATE_UNITS = {"revolute": "degrees", "prismatic": "meters"}


def summarize(
    evaluation: Evaluation, dataset: Dataset, predictor: str, weights: str | None
) -> dict[str, Any]:
    """The content of metrics.json: counts, and mean and median of every error.

    Failed frames are in every mean and median, with the values that "failure_value" names.
    "by_opening" holds the errors of frames in which the object is closed, ajar or open, where the
    category knows such a thing, and, where the data say how much of each part is visible,
    "by_occlusion" those of the parts within each bin of paper Table 8. For a category with declared
    symmetries, "up_to_symmetry" holds the errors against the better reading of the truth; all the
    others never do.

    Args:
      evaluation: from ``protocol.evaluate``.
      dataset: where the frames came from.
      predictor: "model", "truth" or "mean".
      weights: the model, for people; None when none was used.
    """
    category = dataset.category
    arguments = (evaluation.estimate, evaluation.truth, category, evaluation.failed)
    errors = pose_errors(*arguments)
    report = {
        "category": category.name,
        "format": dataset.format,
        "split": dataset.split,
        "frames": len(evaluation.names),
        "failures": int(evaluation.failed.sum()),
        "mask_source": dataset.mask_source,
        **error_tables(errors, category),
        "seconds_per_frame": evaluation.seconds_per_frame,
        "predictor": predictor,
        "weights": weights,
        "failure_value": FAILURE_VALUES,
    }
    if category.closed:
        state = np.asarray(evaluation.truth.joint_state)
        report["by_opening"] = by_opening(errors, state, category)
    if not np.isnan(evaluation.visibility).all():
        report["by_occlusion"] = by_occlusion(errors, evaluation.visibility, category)
    if category.symmetries:
        report["up_to_symmetry"] = {
            "reasons": [symmetry.reason for symmetry in category.symmetries],
            **error_tables(pose_errors_up_to_symmetry(*arguments), category),
        }
    return report


def error_tables(errors: PoseErrors, category: Category) -> dict[str, list[dict[str, Any]]]:
    """Mean and median of every error, per part and joint, JSON-ready.

    Also "turned" of a part, the share of frames in which it is off by more than 30 deg.
    """
    parts = [
        {
            "name": name,
            **{key: summary(getattr(errors, key)[:, k]) for key in PART_METRICS},
            "turned": turned(errors.rotation_deg[:, k]),
        }
        for k, name in enumerate(category.parts)
    ]
    joints = [
        {
            "type": kind,
            **{key: summary(getattr(errors, key)[:, j]) for key in JOINT_METRICS},
            "state_unit": _STATE_UNITS[kind],
        }
        for j, kind in enumerate(category.joint_types)
    ]
    return {"parts": parts, "joints": joints}


def write_report(folder: str | Path, evaluation: Evaluation, report: dict[str, Any]) -> None:
    """Writes metrics.json and predictions.npz, each whole or not at all.

    predictions.npz holds, for F frames in order, ``frame`` (names), ``failed`` [F] and the
    estimates ``R`` [F, K, 3, 3], ``t``, ``size``, ``box_center`` [F, K, 3] (meters),
    ``joint_axis``, ``joint_pivot`` [F, J, 3], ``joint_state`` [F, J] (radians or meters), NaN where
    failed, and the ground truth under the same names with ``truth_`` before; ``visibility`` [F, K]
    is NaN where unknown. Every error in metrics.json can be computed from it.

    Args:
      folder: exists.
      evaluation: the estimates.
      report: from ``summarize``.
    """
    arrays: dict[str, np.ndarray] = {
        "frame": np.array(evaluation.names),
        "failed": evaluation.failed,
        "visibility": evaluation.visibility,
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
        *format_tables(report),
    ]
    if "by_opening" in report:
        lines += ["", "by how far the most open joint is open, of its limits:"]
        lines += format_bins(report["by_opening"], "opened")
    if "by_occlusion" in report:
        lines += ["", "by the share of the part that is occluded:"]
        lines += format_bins(report["by_occlusion"], "occluded")
    if "up_to_symmetry" in report:
        symmetric = report["up_to_symmetry"]
        lines += ["", f"up to symmetry ({'; '.join(symmetric['reasons'])}):"]
        lines += format_tables(symmetric)
    return "\n".join(lines)


def format_tables(tables: dict[str, Any]) -> list[str]:
    """Lines of the tables of parts and joints that ``error_tables`` gives, mean / median."""
    rows = [["part", "rotation [deg]", "translation [mm]", "IoU full", "IoU size"]]
    for part in tables["parts"]:
        rows.append(
            [
                part["name"],
                cell(part["rotation_deg"], 1, 2),
                cell(part["translation_m"], 1000, 1),
                cell(part["iou_full"], 1, 3),
                cell(part["iou_size"], 1, 3),
            ]
        )
    shares = ", ".join(f"{part['name']} {100 * part['turned']:.1f} %" for part in tables["parts"])
    # A column more, and the table would be too wide.
    lines = [*align(rows), *textwrap.wrap(f"over {TURNED_DEG:.0f} deg: {shares}", 80), ""]
    rows = [["joint", "axis [deg]", "pivot [mm]", "state"]]
    for joint, part in zip(tables["joints"], tables["parts"][1:], strict=True):
        meters = joint["state_unit"] == "meters"
        rows.append(
            [
                f"{part['name']} ({joint['type']})",
                cell(joint["axis_deg"], 1, 2),
                cell(joint["pivot_m"], 1000, 1),
                cell(joint["state"], 1000 if meters else 1, 2) + (" mm" if meters else " deg"),
            ]
        )
    return lines + align(rows)
