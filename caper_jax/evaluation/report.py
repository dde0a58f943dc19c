"""What an evaluation leaves behind: metrics.json, predictions.npz and a table as text."""

from __future__ import annotations

import io
import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from tabulate import tabulate

from caper_jax.articulation.category import Category
from caper_jax.data.types import Dataset
from caper_jax.evaluation.metrics import (
    FAILURE_VALUES,
    JOINT_METRICS,
    PART_METRICS,
    PoseErrors,
)
from caper_jax.evaluation.protocol import Evaluation, Readings
from caper_jax.files import write_atomically
from caper_jax.models.hypotheses import RIGHT_DEG

METRICS_FILE = "metrics.json"
PREDICTIONS_FILE = "predictions.npz"
# Beyond this a rotation is taken to be flipped (another face taken for the front), not inaccurate.
FLIPPED_DEG = 30.0
STATE_UNITS = {"revolute": "degrees", "prismatic": "meters"}
CONFIDENT = 0.9  # probability beyond which an answer counts as stated with confidence
# Bins of paper Table 8: the share of a part that is occluded, low to high. (The paper defines its
# level as the visible share, yet calls 80-100 % highly occluded and reports it as the worst.)
_OCCLUSION = ((0.0, 0.4), (0.4, 0.8), (0.8, 1.0))
# Closed objects look alike from several viewpoints: of a dishwasher's 90 deg, 4.5 are the first.
_OPENING = ((0.0, 0.05), (0.05, 0.25), (0.25, 1.0))
_SHORT = {"rotation": "R", "translation": "t"}  # names of fields in predictions.npz


def summarize(
    evaluation: Evaluation, dataset: Dataset, predictor: str, weights: str | None
) -> dict[str, Any]:
    """The content of metrics.json: counts, and mean and median of every error.

    "implausible" is the share of frames whose estimate the model itself does not believe, and
    "plausible_only" holds the errors of the others; all others hold those of every frame. Failed
    frames are in every mean and median, with the values that "failure_value" names.
    "by_opening" holds the errors of frames in which the object is closed, ajar or open, where the
    category knows such a thing, and, where the data say how much of each part is visible,
    "by_occlusion" those of the parts within each bin of paper Table 8. For a category with declared
    symmetries, "up_to_symmetry" holds the errors against the better of the equivalent truths; all
    the others never do.

    Args:
      evaluation: from ``protocol.evaluate``.
      dataset: where the frames came from.
      predictor: "model", "truth" or "mean".
      weights: names the model; None when none was used.
    """
    category = dataset.category
    errors = evaluation.errors
    report: dict[str, Any] = {
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
    if evaluation.plausible is not None:
        report["implausible"] = float(1.0 - evaluation.plausible.mean())
        if evaluation.plausible.any():
            report["plausible_only"] = error_tables(_of(errors, evaluation.plausible), category)
    if evaluation.readings is not None:
        report["readings"] = reading_summary(evaluation.readings, category)
    if category.closed:
        state = np.asarray(evaluation.truth.joint_state)
        report["by_opening"] = errors_by_opening(errors, state, category)
    if not np.isnan(evaluation.visibility).all():
        report["by_occlusion"] = errors_by_occlusion(errors, evaluation.visibility, category)
    if evaluation.symmetric_errors is not None:
        report["up_to_symmetry"] = {
            "reasons": [symmetry.reason for symmetry in category.symmetries],
            **error_tables(evaluation.symmetric_errors, category),
        }
    return report


def error_tables(errors: PoseErrors, category: Category) -> dict[str, list[dict[str, Any]]]:
    """Mean and median of every error, per part and joint, JSON-ready.

    Also "flipped" of a part: the share of frames whose rotation is off by more than 30 deg.
    """
    every = np.ones(len(errors.rotation_deg), bool)
    parts = [
        {"name": name, **_part_errors(errors, part, every)}
        for part, name in enumerate(category.parts)
    ]
    joints = [
        {
            "type": kind,
            **{key: summary(getattr(errors, key)[:, j]) for key in JOINT_METRICS},
            "state_unit": STATE_UNITS[kind],
        }
        for j, kind in enumerate(category.joint_types)
    ]
    return {"parts": parts, "joints": joints}


def reading_summary(readings: Readings, category: Category) -> dict[str, Any]:
    """How often probabilities of readings keep their word, JSON-ready.

    A reading is right where every part's rotation is within 30 deg of the truth, up to declared
    symmetry. "right" is the share of frames whose answer is, "among_readings" those of which any
    reading is; "confident" those whose answer has more than 90 %, "confident_and_wrong" those of
    them that are wrong all the same, as a share of all frames. "calibration_error" is the expected
    one: the mean difference of probability and share of right answers within tenths.
    "best_reading_deg" are errors of the reading that is nearest to the truth.
    """
    probability = np.asarray(readings.probability, np.float64)
    first, worst = probability[:, 0], np.asarray(readings.rotation_deg).max(-1)
    is_right = worst <= RIGHT_DEG
    confident = first > CONFIDENT
    nearest = np.take_along_axis(
        np.asarray(readings.rotation_deg), worst.argmin(1)[:, None, None], axis=1
    )[:, 0]
    tenths = np.minimum((10 * first).astype(int), 9)
    bins = []
    for tenth in range(10):
        within = tenths == tenth
        if within.any():
            stated, found = float(first[within].mean()), float(is_right[within, 0].mean())
            bins.append({"frames": int(within.sum()), "stated": stated, "right": found})
    error = sum(entry["frames"] * abs(entry["stated"] - entry["right"]) for entry in bins)
    return {
        "number": probability.shape[1],
        "right": float(is_right[:, 0].mean()),
        "among_readings": float(is_right.any(1).mean()),
        "confident": float(confident.mean()),
        "confident_and_wrong": float((confident & ~is_right[:, 0]).mean()),
        "calibration_error": error / len(first),
        "calibration": bins,
        "best_reading_deg": [
            {"name": name, **summary(nearest[:, k])} for k, name in enumerate(category.parts)
        ],
    }


def _of(errors: PoseErrors, frames: np.ndarray) -> PoseErrors:
    """The errors of the chosen frames [F] bool."""
    return PoseErrors(**{name: values[frames] for name, values in vars(errors).items()})


def errors_by_occlusion(
    errors: PoseErrors, visibility: Float[np.ndarray, "frames parts"], category: Category
) -> list[dict[str, Any]]:
    """Errors of the parts by how much of them is hidden, JSON-ready.

    Args:
      errors: of F frames.
      visibility: [F, K] visible share of each part, NaN where unknown.
      category: names the parts.

    Returns:
      One entry per bin: "occluded" (its ends) and "parts", each with its name, the number of
      frames within the bin and, if there are any, its errors in them.
    """
    return _bins(errors, 1.0 - visibility, _OCCLUSION, "occluded", category)


def errors_by_opening(
    errors: PoseErrors, state: Float[np.ndarray, "frames joints"], category: Category
) -> list[dict[str, Any]]:
    """Errors of the parts by how far the most open joint is open, as ``errors_by_occlusion``.

    Args:
      errors: of F frames.
      state: [F, J] true joint states, radians or meters.
      category: knows the joints' limits, between which the opening is a share, and which of them is
        closed; states beyond count as the limit.
    """
    low, high = np.array([joint.limits for joint in category.joints]).T
    opening = np.clip((state - low) / (high - low), 0.0, 1.0)
    opening = 1.0 - opening if category.closed == "high" else opening
    opening = opening.max(axis=1, keepdims=True)
    opening = np.broadcast_to(opening, errors.rotation_deg.shape)
    return _bins(errors, opening, _OPENING, "opened", category)


def _bins(
    errors: PoseErrors,
    shares: np.ndarray,
    bins: Sequence[tuple[float, float]],
    key: str,
    category: Category,
) -> list[dict[str, Any]]:
    # Rounded: files keep float32, whose 0.6 is a little more than 0.6.
    shares = np.round(shares, 6)
    result = []
    for low, high in bins:
        within = (shares >= low) & ((shares < high) | (high == 1.0))
        parts = []
        for part, name in enumerate(category.parts):
            frames = within[:, part]
            entry = {"name": name, "frames": int(frames.sum())}
            parts.append(entry | (_part_errors(errors, part, frames) if frames.any() else {}))
        result.append({key: [low, high], "parts": parts})
    return result


def _part_errors(errors: PoseErrors, part: int, frames: np.ndarray) -> dict[str, Any]:
    """Summaries of one part's errors in the chosen frames [F] bool."""
    table: dict[str, Any] = {
        key: summary(getattr(errors, key)[frames, part]) for key in PART_METRICS
    }
    table["flipped"] = float(np.mean(errors.rotation_deg[frames, part] > FLIPPED_DEG))
    return table


def summary(values: Float[np.ndarray, " frames"]) -> dict[str, float | None]:
    """Mean and median; None where the error has no meaning (pivots of prismatic joints)."""
    if np.isnan(values).all():
        return {"mean": None, "median": None}
    # Nine digits: the truth's IoU is 1, not one rounding of float64 below it.
    values = np.asarray(values, np.float64)  # sums of float32 would depend on their order
    return {
        "mean": float(f"{np.mean(values):.9g}"),
        "median": float(f"{np.median(values):.9g}"),
    }


def write_report(folder: str | Path, evaluation: Evaluation, report: dict[str, Any]) -> None:
    """Writes metrics.json and predictions.npz, each whole or not at all.

    predictions.npz holds, for F frames in order, ``frame`` (names), ``failed`` [F], ``plausible``
    [F] where the predictor says so, and the estimates ``R`` [F, K, 3, 3], ``t`` [F, K, 3] (part to
    camera, meters), ``size``, ``box_center`` [F, K, 3] (rest frame of the part, meters),
    ``joint_axis``, ``joint_pivot`` [F, J, 3] (rest frame of the root), ``joint_state`` [F, J]
    (radians or meters), NaN where failed, and the ground truth under the same names with
    ``truth_`` before; ``visibility`` [F, K] is NaN where unknown; of a model that states readings,
    their ``probability`` [F, H] and ``reading_rotation_deg`` [F, H, K], the errors of their parts
    up to symmetry. Every error in metrics.json can be computed from it.

    Args:
      folder: exists.
      evaluation: the estimates.
      report: from ``summarize``.
    """
    arrays: dict[str, np.ndarray] = {
        "frame": np.array(evaluation.names),
        "failed": evaluation.failed,
        **({} if evaluation.plausible is None else {"plausible": evaluation.plausible}),
        "visibility": evaluation.visibility,
    }
    if evaluation.readings is not None:
        arrays["probability"] = np.asarray(evaluation.readings.probability)
        arrays["reading_rotation_deg"] = np.asarray(evaluation.readings.rotation_deg)
    for prefix, pose in (("", evaluation.estimate), ("truth_", evaluation.truth)):
        for key, values in vars(pose).items():
            arrays[prefix + _SHORT.get(key, key)] = np.asarray(values)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    folder = Path(folder)
    write_atomically(folder / PREDICTIONS_FILE, buffer.getvalue())
    text = json.dumps(report, indent=2, allow_nan=False)
    write_atomically(folder / METRICS_FILE, text.encode() + b"\n")


def format_report(report: dict[str, Any]) -> str:
    """The report as plain text, at most 80 columns: means and medians of parts and joints."""
    lines = [
        f"{report['category']}, {report['format']} ({report['split']}): {report['frames']} frames, "
        f"{report['failures']} failed; predictor: {report['predictor']}",
        f"object masks: {report['mask_source']}; "
        f"{1000 * report['seconds_per_frame']:.1f} ms per frame",
        "errors: mean / median",
        "",
        *format_tables(report),
    ]
    if "implausible" in report:
        lines += ["", *_format_plausible(report)]
    if "readings" in report:
        lines += ["", *_format_readings(report["readings"])]
    if "by_opening" in report:
        lines += ["", "by how far the most open joint is open, of its limits:"]
        lines += _format_bins(report["by_opening"], "opened")
    if "by_occlusion" in report:
        lines += ["", "by the share of the part that is occluded:"]
        lines += _format_bins(report["by_occlusion"], "occluded")
    if "up_to_symmetry" in report:
        symmetric = report["up_to_symmetry"]
        lines += ["", f"up to symmetry ({'; '.join(symmetric['reasons'])}):"]
        lines += format_tables(symmetric)
    return "\n".join(lines)


def _format_plausible(report: dict[str, Any]) -> list[str]:
    """How many estimates the model does not believe, and errors with and without them."""
    share = f"implausible by its own word: {100 * report['implausible']:.1f} % of frames"
    if "plausible_only" not in report or not report["implausible"]:
        return [share]
    rows = []
    for part, other in zip(report["parts"], report["plausible_only"]["parts"], strict=True):
        errors = [
            format_error(one[key], factor, digits)
            for key, factor, digits in (("rotation_deg", 1, 2), ("translation_m", 1000, 1))
            for one in (part, other)
        ]
        rows.append([part["name"], *errors])
    header = ["part", "rotation [deg]", "without", "translation [mm]", "without"]
    return [f"{share}; errors with and without them:", *text_table(header, rows)]


def _format_readings(readings: dict[str, Any]) -> list[str]:
    """What probabilities are worth, in lines of at most 80 columns."""
    text = (
        f"answers right within {RIGHT_DEG:.0f} deg: {100 * readings['right']:.1f} %; stated with "
        f"over {100 * CONFIDENT:.0f} %: {100 * readings['confident']:.1f} %; wrong all the same: "
        f"{100 * readings['confident_and_wrong']:.2f} % of all frames; calibration error "
        f"{readings['calibration_error']:.3f}"
    )
    lines = textwrap.wrap(text, 80)
    if readings["number"] > 1:
        errors = ", ".join(
            f"{part['name']} {format_error(part, 1, 2)} deg"
            for part in readings["best_reading_deg"]
        )
        text = (
            f"right one among {readings['number']} readings: "
            f"{100 * readings['among_readings']:.1f} %; rotation of the nearest reading: {errors}"
        )
        lines += textwrap.wrap(text, 80)
    return lines


def format_tables(tables: dict[str, Any]) -> list[str]:
    """Lines of the tables of parts and joints that ``error_tables`` gives, mean / median."""
    rows = [
        [
            part["name"],
            format_error(part["rotation_deg"], 1, 2),
            format_error(part["translation_m"], 1000, 1),
            format_error(part["iou_full"], 1, 3),
            format_error(part["iou_size"], 1, 3),
        ]
        for part in tables["parts"]
    ]
    lines = text_table(["part", "rotation [deg]", "translation [mm]", "IoU full", "IoU size"], rows)
    shares = ", ".join(f"{part['name']} {100 * part['flipped']:.1f} %" for part in tables["parts"])
    # A column more, and the table would be too wide.
    lines += textwrap.wrap(f"flipped (over {FLIPPED_DEG:.0f} deg): {shares}", 80)
    rows = [
        [f"{part['name']} ({joint['type']})", *format_joint(joint)]
        for joint, part in zip(tables["joints"], tables["parts"][1:], strict=True)
    ]
    return [*lines, "", *text_table(["joint", "axis [deg]", "pivot [mm]", "state"], rows)]


def _format_bins(bins: list[dict[str, Any]], key: str) -> list[str]:
    rows = [
        [
            part["name"],
            format_share(entry[key]),
            str(part["frames"]),
            format_error(part["rotation_deg"], 1, 2),
            format_error(part["translation_m"], 1000, 1),
        ]
        for parts in zip(*(entry["parts"] for entry in bins), strict=True)
        for entry, part in zip(bins, parts, strict=True)
        if part["frames"]
    ]
    return text_table(["part", key, "frames", "rotation [deg]", "translation [mm]"], rows)


def format_error(summary: dict[str, float | None], factor: float, digits: int) -> str:
    """``mean / median`` in another unit; "-" where the error has no meaning."""
    mean, median = summary["mean"], summary["median"]
    if mean is None or median is None:
        return "-"
    return f"{factor * mean:.{digits}f} / {factor * median:.{digits}f}"


def format_joint(joint: dict[str, Any]) -> list[str]:
    """``mean / median`` of a joint of ``error_tables``: axis [deg], pivot [mm], state with unit."""
    factor, unit = (1000.0, "mm") if joint["state_unit"] == "meters" else (1.0, "deg")
    return [
        format_error(joint["axis_deg"], 1.0, 2),
        format_error(joint["pivot_m"], 1000.0, 1),
        f"{format_error(joint['state'], factor, 2)} {unit}",
    ]


def format_share(ends: Sequence[float]) -> str:
    """Both ends of a bin, in percent."""
    return f"{100 * ends[0]:.0f}-{100 * ends[1]:.0f} %"


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table without rules; the first column to the left, the others to the right."""
    text = tabulate(
        rows,
        header,
        tablefmt="plain",
        colalign=("left", *["right"] * (len(header) - 1)) if rows else None,
        disable_numparse=True,
        preserve_whitespace=True,  # indented names stand below what they belong to
    )
    return text.splitlines()
