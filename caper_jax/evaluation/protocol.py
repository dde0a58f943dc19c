"""Runs a predictor over a dataset: what it is given, in which batches, and what counts."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32

from caper_jax.articulation.category import Category
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.clouds import sample_points, shows_object
from caper_jax.data.types import Dataset, Frame, pose_problems, pose_shapes
from caper_jax.errors import CaperError
from caper_jax.estimator import Prediction
from caper_jax.lie import se3
from caper_jax.progress import progress

BATCH_SIZE = 16
NUM_POINTS = 1024
Tree = TypeVar("Tree")

# Poses [B, K, ...] for B frames and their clouds [B, N, 3], meters; or predictions with a ``pose``,
# which may also say whether they are ``plausible``.
Predictor = Callable[[Sequence[Frame], np.ndarray], ArticulatedPose | Prediction]


@dataclass(frozen=True)
class Evaluation:
    """Estimates of F frames, in the order of the dataset.

    Attributes:
      names: F names.
      estimate: arrays [F, K, ...]; NaN where ``failed``.
      truth: arrays [F, K, ...].
      failed: [F] bool: too few points, or an estimate that is not finite.
      plausible: [F] bool: what the predictor says of its estimates, False where ``failed``; None
        where it says nothing.
      visibility: [F, K] share of each part that nothing hides; NaN where the data do not say.
      seconds_per_frame: time of the predictor alone, after a first call that compiles.
    """

    names: list[str]
    estimate: ArticulatedPose
    truth: ArticulatedPose
    failed: Bool[np.ndarray, " frames"]
    plausible: Bool[np.ndarray, " frames"] | None
    visibility: Float[np.ndarray, "frames parts"]
    seconds_per_frame: float


def evaluate(
    dataset: Dataset,
    predictor: Predictor,
    limit: int | None = None,
    batch_size: int = BATCH_SIZE,
    num_points: int = NUM_POINTS,
) -> Evaluation:
    """Estimates every frame, in batches of one fixed shape so that nothing compiles twice.

    Args:
      dataset: labeled frames.
      predictor: e.g. ``model_predictor(estimator)``.
      limit: at most so many frames, from the first.
      batch_size: frames per call; the last batch is filled up with copies.
      num_points: points per cloud.

    Raises:
      CaperError: no frames, or frames without (or with broken) ground truth.
    """
    count = len(dataset) if limit is None else min(limit, len(dataset))
    if count <= 0:
        raise CaperError(f"nothing to evaluate: {len(dataset)} frames, limit {limit}")
    names: list[str] = []
    estimates: list[ArticulatedPose] = []
    truths: list[ArticulatedPose] = []
    visibility: list[np.ndarray] = []
    verdicts: list[np.ndarray] = []
    unknown = np.full(dataset.category.num_parts, np.nan)
    seconds = 0.0
    with progress("evaluating", total=count) as bar:
        for start in range(0, count, batch_size):
            frames = [dataset[i] for i in range(start, min(start + batch_size, count))]
            padded = frames + [frames[-1]] * (batch_size - len(frames))
            clouds = np.stack([cloud_of(frame, num_points) for frame in padded])
            if start == 0:
                predictor(padded, clouds)  # compiles
            began = time.perf_counter()
            batch: Any = jax.block_until_ready(predictor(padded, clouds))
            seconds += time.perf_counter() - began
            if (plausible := getattr(batch, "plausible", None)) is not None:
                verdicts.append(np.asarray(plausible)[: len(frames)])
            batch = jax.tree.map(np.asarray, getattr(batch, "pose", batch))
            names += [frame.name for frame in frames]
            truths += [_truth(frame, dataset.category) for frame in frames]
            visibility += [unknown if f.visibility is None else f.visibility for f in frames]
            for i, frame in enumerate(frames):
                pose = jax.tree.map(lambda array, i=i: array[i], batch)
                estimates.append(_checked(pose, frame, dataset.category))
            bar.update(len(frames))
    estimate, truth = stack(estimates), stack(truths)
    failed = np.isnan(estimate.rotation).any((-1, -2, -3))
    batches = -(-count // batch_size)
    return Evaluation(
        names=names,
        estimate=estimate,
        truth=truth,
        failed=failed,
        plausible=np.concatenate(verdicts) & ~failed if verdicts else None,
        visibility=np.stack(visibility),
        seconds_per_frame=seconds / (batches * batch_size),
    )


def model_predictor(estimator: Callable[[np.ndarray], Any]) -> Predictor:
    """The estimates of a trained model (``caper_jax.estimator.load``)."""

    def predict(frames: Sequence[Frame], points: np.ndarray) -> ArticulatedPose | Prediction:
        return estimator(points)

    return predict


def truth_predictor(frames: Sequence[Frame], points: np.ndarray) -> ArticulatedPose:
    """The dataset's own ground truth, which must score perfectly: else the metrics are wrong."""
    return stack([frame.truth for frame in frames if frame.truth is not None])


def mean_predictor(category: Category, mean_pose: Mapping[str, Any], source: str) -> Predictor:
    """The trivial estimate that any model must beat: the mean of the training set, everywhere.

    The root stands at the mean of the cloud plus a mean offset, with the mean rotation, sizes and
    joints; the other parts follow by forward kinematics.

    Args:
      category: gives the shapes and the tree of parts.
      mean_pose: "rotation" [3, 3] and "offset" [3] of the root (camera frame, meters from the mean
        of the cloud), "size" and "box_center" [K, 3], "joint_axis" and "joint_pivot" [J, 3],
        "joint_state" [J].
      source: the file to name in errors.

    Raises:
      CaperError: a value is missing or has another shape.
    """
    shapes = pose_shapes(category.num_parts)
    shapes.update(rotation=(3, 3), offset=(3,))
    del shapes["translation"]
    values = {}
    for key, shape in shapes.items():
        values[key] = np.asarray(mean_pose.get(key, np.nan), np.float32)
        if values[key].shape != shape or not np.isfinite(values[key]).all():
            raise CaperError(f"{source}: mean_pose {key} must be finite numbers {shape}")

    @jax.jit
    def place(middle: jax.Array) -> ArticulatedPose:
        repeated = {
            key: jnp.broadcast_to(value, (len(middle), *value.shape))
            for key, value in values.items()
        }
        root = se3.from_rt(repeated.pop("rotation"), middle + repeated.pop("offset"))
        joints = (repeated["joint_axis"], repeated["joint_pivot"], repeated["joint_state"])
        parts = forward_kinematics(root, *joints, category.joint_types, category.parents)
        rotation, translation = parts[..., :3, :3], parts[..., :3, 3]
        return ArticulatedPose(rotation=rotation, translation=translation, **repeated)

    def predict(frames: Sequence[Frame], points: np.ndarray) -> ArticulatedPose:
        return place(points.mean(1))

    return predict


def cloud_of(frame: Frame, num_points: int) -> Float32[np.ndarray, "points 3"]:
    """[N, 3] points that a predictor sees; some cloud where the frame shows too little to use."""
    if not shows_object(np.asarray(frame.points, np.float32)):
        return np.linspace((-0.1, -0.1, 0.9), (0.1, 0.1, 1.1), num_points, dtype=np.float32)
    return sample_points(frame.points, num_points, where=frame.name).points


def _truth(frame: Frame, category: Category) -> ArticulatedPose:
    if frame.truth is None:
        raise CaperError(f"frame {frame.name!r} has no ground truth to evaluate against")
    problems = pose_problems(frame.truth, category)
    if problems:
        raise CaperError(f"ground truth of frame {frame.name!r}: {'; '.join(problems)}")
    return frame.truth


def _checked(pose: ArticulatedPose, frame: Frame, category: Category) -> ArticulatedPose:
    """The estimate, or NaN everywhere if it failed."""
    finite = all(np.isfinite(array).all() for array in jax.tree.leaves(pose))
    if finite and shows_object(np.asarray(frame.points, np.float32)):
        return pose
    shapes = pose_shapes(category.num_parts)
    return ArticulatedPose(**{key: np.full(shape, np.nan) for key, shape in shapes.items()})


def stack(trees: Sequence[Tree]) -> Tree:
    """Poses or results of frames as one, with a leading axis of frames; numpy arrays."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)
