"""What an evaluation leaves behind: metrics.json, predictions.npz and a table for people."""

from __future__ import annotations

import io
import json
import textwrap
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
# Bins of paper Table 8: the share of a part that is occluded, low to high. (The paper defines its
# level as the visible share, yet calls 80-100 % highly occluded and finds it worst.)
_OCCLUSION = ((0.0, 0.4), (0.4, 0.8), (0.8, 1.0))
_STATE_UNITS = {"revolute": "degrees", "prismatic": "metres"}
# Beyond this a part is turned, taken for another side of itself, rather than inaccurate.
TURNED_DEG = 30.0


def summarise(
    evaluation: Evaluation, dataset: Dataset, predictor: str, weights: str | None
) -> dict[str, Any]:
    """The content of metrics.json: counts, and mean and median of every error.

    Failed frames are in every mean and median, with the values that "failure_value" names. Where
    the data say how much of each part is visible, "by_occlusion" holds the errors of the parts
    within each bin of paper Table 8. For a category with declared equivalences, "up_to_symmetry"
    holds the same errors against the better reading of the truth; "parts" and "joints" never do.

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
    if not np.isnan(evaluation.visibility).all():
        # Rounded: files keep float32, whose 0.6 is a little more than 0.6.
        occlusion = np.round(1.0 - evaluation.visibility, 6)
        report["by_occlusion"] = _by_occlusion(errors, occlusion, category)
    if category.equivalences:
        report["up_to_symmetry"] = {
            "reasons": [equivalence.reason for equivalence in category.equivalences],
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
            "turned": float(np.mean(errors.rotation_deg[:, k] > TURNED_DEG)),
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


def _by_occlusion(
    errors: PoseErrors, occlusion: np.ndarray, category: Category
) -> list[dict[str, Any]]:
    """Errors of the parts by how much of them is hidden; a part without frames in a bin has none.

    Args:
      errors: of F frames.
      occlusion: [F, K] hidden share of each part, NaN where unknown.
      category: names the parts.
    """
    bins = []
    for low, high in _OCCLUSION:
        inside = (occlusion >= low) & ((occlusion < high) | (high == 1.0))
        parts = []
        for k, name in enumerate(category.parts):
            chosen = inside[:, k]
            part: dict[str, Any] = {"name": name, "frames": int(chosen.sum())}
            if chosen.any():
                part |= {key: summary(getattr(errors, key)[chosen, k]) for key in PART_METRICS}
            parts.append(part)
        bins.append({"occluded": [low, high], "parts": parts})
    return bins


def summary(values: np.ndarray) -> dict[str, float | None]:
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
    failed, and the ground truth under the same names with ``truth_`` before; ``visibility`` [F, K]
    is NaN where unknown. Every error in metrics.json can be computed from it.

    Args:
      folder: exists.
      evaluation: the estimates.
      report: from ``summarise``.
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
    if "by_occlusion" in report:
        lines += ["", "by the share of the part that is occluded:"]
        lines += _format_occlusion(report["by_occlusion"])
    if "up_to_symmetry" in report:
        symmetric = report["up_to_symmetry"]
        lines += ["", f"up to symmetry ({'; '.join(symmetric['reasons'])}):"]
        lines += format_tables(symmetric)
    return "\n".join(lines)


def _format_occlusion(bins: list[dict[str, Any]]) -> list[str]:
    rows = [["part", "occluded", "frames", "rotation [deg]", "translation [mm]"]]
    for number in range(len(bins[0]["parts"])):
        for content in bins:
            low, high = content["occluded"]
            part = content["parts"][number]
            cells = ["-", "-"]
            if part["frames"]:
                cells = [_cell(part["rotation_deg"], 1, 2), _cell(part["translation_m"], 1000, 1)]
            share = f"{100 * low:.0f}-{100 * high:.0f} %"
            rows.append([part["name"], share, str(part["frames"]), *cells])
    return align(rows)


def format_tables(tables: dict[str, Any]) -> list[str]:
    """Lines of the tables of parts and joints that ``error_tables`` gives, mean / median."""
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
    turned = ", ".join(f"{part['name']} {100 * part['turned']:.1f} %" for part in tables["parts"])
    # A column more, and the table would be too wide.
    lines = [*align(rows), *textwrap.wrap(f"over {TURNED_DEG:.0f} deg: {turned}", 80), ""]
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
