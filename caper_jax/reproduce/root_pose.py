"""Table 7 and figure 11: the root's pose after stage I, by its input and by its rotation head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.clouds import MIN_POINTS, sample_points
from caper_jax.data.types import Frame
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation.protocol import Evaluation, Predictor, evaluate, model_predictor
from caper_jax.evaluation.report import format_error, summarize
from caper_jax.lie import so3
from caper_jax.reproduce.ablations import describe_training, frames_of, train_seeds
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import paper
from caper_jax.reproduce.report import Report, Table, number
from caper_jax.visualization.plots import Scatter

# Kind -> its settings. The full model of both is trained once, under one label.
INPUTS = {"root": ("loss.root_input=root",), "whole": ()}
ROTATIONS = {"direct": ("network.rotation=quaternion",), "decoupled": ()}
_LABELS = {"whole": "full", "decoupled": "full"}
ANGLES = ("yaw", "pitch", "roll")
_TABLE7_HEADER = (
    *("category", "input", "seed", "rot paper [deg]", "ours"),
    *("trans paper [%]", "ours [%]"),
)
_FIGURE11_HEADER = (
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
      CaperError: unknown categories, settings or data; see ``ablations.train``.
      KeyboardInterrupt: training was stopped; the same call goes on from there.
    """
    options.budget()  # a contradiction in it is found before anything is drawn
    facts: list[str] = []
    result: dict[str, dict[str, list[dict[str, Any]]]] = {}
    curves: dict[str, Scatter] = {}
    rows: list[list[str]] = []
    kinds = INPUTS if name == "table7" else ROTATIONS
    for key, dataset, _ in frames_of(options, options.chosen(paper().root_input), facts):
        result[key] = {kind: [] for kind in kinds}
        panels = {}
        for kind, changes in kinds.items():
            for seed, full in train_seeds(key, _LABELS.get(kind, kind), changes, options):
                estimator = stage_one(full)
                predictor = root_predictor if kind == "root" else model_predictor
                num_points = estimator.network.num_points
                estimates = evaluate(
                    dataset, predictor(estimator), options.frames, num_points=num_points
                )
                run_result = {"seed": seed, "steps": full.card["steps"]}
                if name == "table7":
                    root = summarize(estimates, dataset, "model", None)["parts"][0]
                    run_result |= {k: root[k] for k in ("rotation_deg", "translation_relative")}
                    rows.append(_table7_row(key, kind, seed, root))
                else:
                    errors = _rotation_errors(estimates, dataset.category.directions)
                    means = {of: _mean_median(values) for of, values in errors.items()}
                    run_result |= {f"{of}_deg": value for of, value in means.items()}
                    texts = [format_error(value, 1.0, 2) for value in means.values()]
                    rows.append([key, kind, str(seed), *texts])
                    if seed == 0:
                        panels[kind] = errors["yaw"], errors["pitch"], errors["roll"]
                result[key][kind].append(run_result)
        if panels:
            yaw, pitch, roll = (f"{angle} [deg]" for angle in ANGLES)
            title = f"Errors of the root's rotation, {key}"
            curves[key] = Scatter(title, yaw, pitch, roll, panels)
    if name == "table7":
        diagonal = paper().diagonal_m["partnet"]["laptop"]
        title = "Table 7, the root's pose from the root alone or from the whole object (Sec 6.4)"
        table = Table("Errors of the root after stage I, mean / median", _TABLE7_HEADER, rows, 3)
        notes = [
            "root: stage I trained and tested on the points of the root part, by true labels",
            f"the paper's meters are divided by an assumed diagonal of {diagonal:g} m",
        ]
    else:
        title = "Figure 11, errors of the root's rotation: decoupled or regressed directly (Sec 7)"
        caption = "Errors of the root after stage I, mean / median of their absolute values"
        table = Table(caption, _FIGURE11_HEADER, rows, 3)
        notes = [
            "direct: stage I regresses a quaternion; decoupled: two directions with confidence",
            "yaw about the root's y, pitch about x, roll about z; first and second axis are the "
            "directions that the decoupled model regresses",
        ]
    return Report(
        title=title,
        tables=[table],
        facts=[
            "the paper measured on ArtImage, ours were measured on:",
            *facts,
            describe_training(options),
            *notes,
        ],
        result={"categories": result},
        curves=curves,
    )


def stage_one(estimator: Estimator) -> Estimator:
    """The same model without stage II's correction: its root pose is stage I's."""
    network = replace(estimator.network, refine_steps=0)
    return Estimator(estimator.category, network, estimator.variables, estimator.card)


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


def error_angles(
    estimate: ArticulatedPose, truth: ArticulatedPose
) -> Float[np.ndarray, "frames 3"]:
    """[F, 3] degrees: yaw about the root's y, then pitch about x, then roll about z.

    They take the estimated root to the true one: R_estimate Ry(yaw) Rx(pitch) Rz(roll) = R_truth.
    """
    error = _root_rotation_error(estimate, truth)
    yaw = np.arctan2(error[:, 0, 2], error[:, 2, 2])
    pitch = np.arcsin(np.clip(-error[:, 1, 2], -1, 1))
    roll = np.arctan2(error[:, 1, 0], error[:, 1, 1])
    return np.degrees(np.stack([yaw, pitch, roll], -1))


def axis_errors(
    estimates: Evaluation, directions: tuple[str, str]
) -> Float[np.ndarray, "frames 2"]:
    """[F, 2] degrees between the estimated and the true directions that stage I regresses."""
    error = _root_rotation_error(estimates.estimate, estimates.truth)
    cosines = [error[:, i, i] for i in ("xyz".index(axis) for axis in directions)]
    return np.degrees(np.arccos(np.clip(np.stack(cosines, -1), -1, 1)))


def _root_rotation_error(estimate: ArticulatedPose, truth: ArticulatedPose) -> np.ndarray:
    """[F, 3, 3] from the estimated root's axes to the true one's."""
    one, other = (np.asarray(pose.rotation[:, 0], np.float64) for pose in (estimate, truth))
    return one.swapaxes(-1, -2) @ other


def _table7_row(category: str, kind: str, seed: int, root: Mapping[str, Any]) -> list[str]:
    figures = paper().root_input[category][kind]
    relative = figures.translation_m / paper().diagonal_m["partnet"][category]
    return [
        *(category, kind, str(seed)),
        *(number(figures.rotation_deg, 1), format_error(root["rotation_deg"], 1.0, 2)),
        *(number(relative, 2, 100.0), format_error(root["translation_relative"], 100.0, 2)),
    ]


def _rotation_errors(estimates: Evaluation, directions: tuple[str, str]) -> dict[str, np.ndarray]:
    """Degrees [F] by what is off, in the columns of figure 11; of the frames that did not fail."""
    good = ~estimates.failed
    angles = error_angles(estimates.estimate, estimates.truth)[good]
    axes = axis_errors(estimates, directions)[good]
    roots = (pose.rotation[:, 0] for pose in (estimates.estimate, estimates.truth))
    whole = np.degrees(np.asarray(so3.geodesic_distance(*roots)))[good]
    columns = (*ANGLES, "first_axis", "second_axis", "rotation")
    return dict(zip(columns, (*angles.T, *axes.T, whole), strict=True))


def _mean_median(errors: np.ndarray) -> dict[str, float | None]:
    """Of the absolute values, as ``format_error`` takes them."""
    return {"mean": float(np.abs(errors).mean()), "median": float(np.median(np.abs(errors)))}
