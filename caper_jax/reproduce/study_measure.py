"""Errors of the models of a study: all models of one network under one vmap."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import NetworkConfig, merge
from caper_jax.data.clouds import MIN_POINTS, sample_points
from caper_jax.data.types import Dataset, Frame
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, estimate, load
from caper_jax.evaluation.batches import is_finite
from caper_jax.evaluation.loading import cloud_of, stack
from caper_jax.evaluation.metrics import pose_errors
from caper_jax.evaluation.report import error_tables
from caper_jax.progress import progress
from caper_jax.reproduce import tracking
from caper_jax.reproduce.data import Videos
from caper_jax.reproduce.study import Run
from caper_jax.tracker import Tracker, config_for

PyTree = Any
_BATCH = 25  # frames at a time
ANGLES = ("yaw", "pitch", "roll")


@dataclass(frozen=True)
class Measured:
    """What was measured of one model.

    Attributes:
      run: the model.
      errors: {"parts", "joints"} as ``error_tables`` has them, and, of stage I alone, "root": {name
        of an angle: {"mean", "median"}} in degrees.
      angles: [F, 3] errors of the root's rotation as yaw, pitch and roll, degrees; None where the
        whole model or a tracker was measured.
    """

    run: Run
    errors: dict[str, Any]
    angles: np.ndarray | None = None


def measure_frames(
    runs: Sequence[Run],
    folders: Mapping[str, Path],
    dataset: Dataset,
    frames: int,
    root_alone: bool = False,
) -> list[Measured]:
    """Errors of single frames.

    Args:
      runs: of one category.
      folders: member -> its model directory.
      dataset: labeled frames of the category.
      frames: at most so many, from the first.
      root_alone: the root's pose by stage I alone; models trained on the root part see the points
        of that part, by true labels.

    Returns:
      One result per run, in order.

    Raises:
      CaperError: no frames, or frames without truth.
    """
    category = dataset.category
    shown = [dataset[index] for index in range(min(frames, len(dataset)))]
    if not shown or any(frame.truth is None for frame in shown):
        raise CaperError("a study is measured on frames with ground truth; there are none")
    truth = stack([frame.truth for frame in shown if frame.truth is not None])
    groups: dict[tuple[NetworkConfig, str], list[int]] = {}
    for index, run in enumerate(runs):
        root_input: str = run.training.loss.root_input if root_alone else "whole"
        groups.setdefault((run.network, root_input), []).append(index)
    found: dict[int, Measured] = {}
    for (network, root_input), members in groups.items():
        clouds = np.stack([_cloud(frame, network.num_points, root_input) for frame in shown])
        models = [load(category.name, folders[runs[index].member]) for index in members]
        variables = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(m.variables for m in models))
        poses = _estimate_all(variables, clouds, category, network)
        for place, index in enumerate(members):
            pose = jax.tree.map(lambda leaf, n=place: leaf[n], poses)
            found[index] = _errors(runs[index], pose, truth, category, root_alone)
    return [found[index] for index in range(len(runs))]


def measure_tracking(
    runs: Sequence[Run], folders: Mapping[str, Path], videos: Videos
) -> list[Measured]:
    """Errors of the tracker on videos, from a given first pose; as ``measure_frames``."""
    condition = tracking.Condition()
    results = []
    for run in runs:
        trained = load(run.category, folders[run.member])
        estimator = Estimator(trained.category, run.network, trained.variables, trained.card)
        config = merge(config_for(estimator), run.tracker)
        tracks = tracking.track_all(Tracker(estimator, config), videos, condition)
        results.append(Measured(run, tracking.summarize(tracks, videos, condition)))
    return results


def _estimate_all(
    variables: PyTree, clouds: np.ndarray, category: Category, network: NetworkConfig
) -> ArticulatedPose:
    """Poses [M, F, K, ...] by M models of one network, numpy arrays."""

    def one(variables: PyTree, points: jax.Array) -> ArticulatedPose:
        return estimate(variables, points, category, network).pose

    batch = jax.jit(jax.vmap(one, in_axes=(0, None)))
    count = len(clouds)
    padded = np.concatenate([clouds, np.repeat(clouds[-1:], -count % _BATCH, axis=0)])
    parts = []
    with progress("measuring", total=count) as bar:
        for start in range(0, count, _BATCH):
            parts.append(jax.device_get(batch(variables, padded[start : start + _BATCH])))
            bar.update(min(_BATCH, count - start))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1)[:, :count], *parts)


def _cloud(frame: Frame, num_points: int, root_input: str) -> np.ndarray:
    """What a model sees of a frame; the whole object also where too little of the root shows."""
    if root_input == "root":
        if frame.labels is None:
            raise CaperError(f"frame {frame.name!r} does not say which points are the root's")
        own = frame.points[frame.labels == 0]
        if len(own) >= MIN_POINTS:
            return sample_points(own, num_points).points
    return cloud_of(frame, num_points)


def _errors(
    run: Run, pose: ArticulatedPose, truth: ArticulatedPose, category: Category, root_alone: bool
) -> Measured:
    failed = ~is_finite(pose)
    tables = error_tables(pose_errors(pose, truth, category, failed), category)
    if not root_alone:
        return Measured(run, tables)
    errors: dict[str, Any] = {"parts": tables["parts"][:1], "joints": []}
    angles = error_angles(pose, truth)
    axes = axis_errors(pose, truth, category.directions)
    columns = (*ANGLES, "first axis", "second axis")
    values = np.concatenate([np.abs(angles), axes], axis=1)[~failed].T
    errors["root"] = {
        name: {"mean": float(column.mean()), "median": float(np.median(column))}
        for name, column in zip(columns, values, strict=True)
    }
    return Measured(run, errors, angles)


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
    estimate: ArticulatedPose, truth: ArticulatedPose, directions: Iterable[str]
) -> Float[np.ndarray, "frames 2"]:
    """[F, 2] degrees between the estimated and the true directions that stage I regresses."""
    error = _root_rotation_error(estimate, truth)
    cosines = [error[:, i, i] for i in ("xyz".index(axis) for axis in directions)]
    return np.degrees(np.arccos(np.clip(np.stack(cosines, -1), -1, 1)))


def _root_rotation_error(estimate: ArticulatedPose, truth: ArticulatedPose) -> np.ndarray:
    """[F, 3, 3] from the estimated root's axes to the true one's."""
    one, other = (np.asarray(pose.rotation[:, 0], np.float64) for pose in (estimate, truth))
    return one.swapaxes(-1, -2) @ other
