"""Table 7 and figure 11: what stage I finds, by what it sees and by how it says a rotation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from caper_jax import categories
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.clouds import MIN_POINTS, sample_points
from caper_jax.data.types import Dataset, Frame
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation.protocol import Evaluation, Predictor, evaluate, model_predictor
from caper_jax.evaluation.report import summarize
from caper_jax.evaluation.summaries import cell
from caper_jax.lie import so3
from caper_jax.reproduce import runs, trainings
from caper_jax.reproduce.frames import open_frames
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import PM_DIAGONAL_M, ROOT_INPUT
from caper_jax.reproduce.render import Report, Scatter, Table, number

_FRAMES = 1000
INPUTS = {"root": ("loss.root_input=root",), "whole": ()}
ROTATIONS = {"direct": ("network.rotation=quaternion",), "decoupled": ()}
ANGLES = ("yaw", "pitch", "roll")
TABLE7_HEADER = (
    *("category", "input", "seed", "rot paper [deg]", "ours"),
    *("trans paper [%]", "ours [%]"),
)
FIGURE11_HEADER = (
    *("category", "rotation", "seed"),
    *(f"{angle} [deg]" for angle in ANGLES),
    *("first axis [deg]", "second axis [deg]", "whole [deg]"),
)


def run(name: str, options: Options) -> Report:
    """Trains both kinds of a model per category and seed, and measures stage I alone.

    Args:
      name: "table7" or "figure11".
      options: see ``Options``; runs are kept under ``out`` and resumed.

    Raises:
      CaperError: unknown categories, settings or data; see ``trainings.trained``.
      KeyboardInterrupt: training was stopped; the same call goes on from there.
    """
    trainings.check_budget(options)
    facts: list[str] = []
    result: dict[str, dict[str, list[dict[str, Any]]]] = {}
    curves: dict[str, Scatter] = {}
    rows: list[list[str]] = []
    kinds = INPUTS if name == "table7" else ROTATIONS
    for key in options.chosen(ROOT_INPUT):
        source = open_frames(options, categories.get(key), _FRAMES)
        if source is None:
            facts.append(f"{key}: {runs.NO_DATA}")
            continue
        dataset, description = source
        facts.append(f"{key}: {description}")
        result[key] = {}
        panels = {}
        for kind, changes in kinds.items():
            result[key][kind] = []
            label = {"whole": "full", "decoupled": "full"}.get(kind, kind)
            for seed in range(options.seeds):
                estimator = stage_one(trainings.trained(key, label, changes, seed, options))
                found = measure(estimator, dataset, options.frames, kind == "root")
                row = {"seed": seed, "steps": estimator.card["steps"]}
                if name == "table7":
                    root = summarize(found, dataset, "model", None)["parts"][0]
                    row |= {k: root[k] for k in ("rotation_deg", "translation_relative")}
                    rows.append(_table7_row(key, kind, seed, root))
                else:
                    errors = _rotation_errors(found, dataset.category.directions)
                    row |= {f"{of}_deg": _mean_median(values) for of, values in errors.items()}
                    cells = [cell(row[f"{of}_deg"], 1.0, 2) for of in errors]
                    rows.append([key, kind, str(seed), *cells])
                    if seed == 0:
                        panels[kind] = errors["yaw"], errors["pitch"], errors["roll"]
                result[key][kind].append(row)
        if panels:
            yaw, pitch, roll = (f"{angle} [deg]" for angle in ANGLES)
            title = f"Errors of the root's rotation, {key}"
            curves[key] = Scatter(title, yaw, pitch, roll, panels)
    title, caption, header, notes = _TEXTS[name]
    return Report(
        title=title,
        tables=[Table(caption, header, rows, 3)],
        facts=[
            "the paper measured on ArtImage, ours were measured on:",
            *facts,
            f"{options.seeds} runs of each kind, {trainings.describe(options)}",
            *notes,
        ],
        result={"categories": result},
        curves=curves,
    )


def stage_one(estimator: Estimator) -> Estimator:
    """The same model without stage II's correction: its root pose is stage I's."""
    network = replace(estimator.network, refine_steps=0)
    return Estimator(estimator.category, network, estimator.variables, estimator.card)


def measure(
    estimator: Estimator, dataset: Dataset, limit: int | None, root_alone: bool
) -> Evaluation:
    """Estimates from the whole object, or from the points that the data label as the root's."""
    predictor = model_predictor(estimator)
    if root_alone:
        predictor = root_predictor(estimator)
    return evaluate(dataset, predictor, limit, num_points=estimator.network.num_points)


def root_predictor(estimator: Estimator) -> Predictor:
    """A model that sees the root part alone; the whole object where too little of it shows.

    Raises:
      CaperError: at a frame without labels.
    """

    def predict(frames: Sequence[Frame], points: np.ndarray) -> ArticulatedPose:
        clouds = []
        for frame, whole in zip(frames, points, strict=True):
            if frame.labels is None:
                raise CaperError(f"frame {frame.name!r} does not say which points are the root's")
            own = frame.points[frame.labels == 0]
            enough = len(own) >= MIN_POINTS
            clouds.append(sample_points(own, points.shape[1]).points if enough else whole)
        return estimator(np.stack(clouds)).pose

    return predict


def error_angles(estimate: ArticulatedPose, truth: ArticulatedPose) -> np.ndarray:
    """[F, 3] degrees: yaw about the root's y, then pitch about x, then roll about z.

    They take the estimated root to the true one: R_estimate Ry(yaw) Rx(pitch) Rz(roll) = R_truth.
    """
    off = _off(estimate, truth)
    yaw = np.arctan2(off[:, 0, 2], off[:, 2, 2])
    pitch = np.arcsin(np.clip(-off[:, 1, 2], -1, 1))
    roll = np.arctan2(off[:, 1, 0], off[:, 1, 1])
    return np.degrees(np.stack([yaw, pitch, roll], -1))


def axis_errors(found: Evaluation, directions: tuple[str, str]) -> np.ndarray:
    """[F, 2] degrees between the estimated and the true directions that stage I regresses."""
    off = _off(found.estimate, found.truth)
    cosines = [off[:, i, i] for i in ("xyz".index(axis) for axis in directions)]
    return np.degrees(np.arccos(np.clip(np.stack(cosines, -1), -1, 1)))


def _off(estimate: ArticulatedPose, truth: ArticulatedPose) -> np.ndarray:
    one, other = (np.asarray(pose.rotation[:, 0], np.float64) for pose in (estimate, truth))
    return one.swapaxes(-1, -2) @ other


def _table7_row(category: str, kind: str, seed: int, root: dict[str, Any]) -> list[str]:
    turn, shift = ROOT_INPUT[category][kind]
    return [
        *(category, kind, str(seed), number(turn, 1), cell(root["rotation_deg"], 1.0, 2)),
        number(100 * shift / PM_DIAGONAL_M, 2),
        cell(root["translation_relative"], 100.0, 2),
    ]


def _rotation_errors(found: Evaluation, directions: tuple[str, str]) -> dict[str, np.ndarray]:
    """Degrees [F] by what is off, in the columns of figure 11; of the frames that did not fail."""
    good = ~found.failed
    angles = error_angles(found.estimate, found.truth)[good]
    axes = axis_errors(found, directions)[good]
    whole = so3.geodesic_distance(found.estimate.rotation[:, 0], found.truth.rotation[:, 0])
    return {
        **dict(zip((*ANGLES, "first_axis", "second_axis"), (*angles.T, *axes.T), strict=True)),
        "rotation": np.degrees(np.asarray(whole))[good],
    }


def _mean_median(errors: np.ndarray) -> dict[str, float | None]:
    """Of the amounts, as ``cell`` takes them."""
    return {"mean": float(np.abs(errors).mean()), "median": float(np.median(np.abs(errors)))}


_TEXTS = {
    "table7": (
        "Table 7, the root's pose from the root alone or from the whole object (Sec 6.4)",
        "Errors of the root after stage I, mean / median",
        TABLE7_HEADER,
        (
            "root: stage I trained and tested on the points of the root part, by true labels",
            f"the paper's meters are divided by an assumed diagonal of {PM_DIAGONAL_M:g} m",
        ),
    ),
    "figure11": (
        "Figure 11, errors of the root's rotation: decoupled or regressed directly (Sec 7)",
        "Errors of the root after stage I, mean / median of their amounts",
        FIGURE11_HEADER,
        (
            "direct: stage I regresses a quaternion; decoupled: two directions with confidence",
            "yaw about the root's y, pitch about x, roll about z; first and second axis are the "
            "directions that the decoupled model regresses",
        ),
    ),
}
