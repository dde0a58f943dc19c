"""Estimates every frame of a dataset or of a generator, and measures how far off each is."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Bool, Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import Array, ArticulatedPose
from caper_jax.data.types import Dataset, Frame, pose_shapes
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, Prediction
from caper_jax.evaluation.batches import is_finite
from caper_jax.evaluation.loading import FrameBatch, frame_batches, stack
from caper_jax.evaluation.metrics import (
    PoseErrors,
    pose_errors,
    pose_errors_up_to_symmetry,
    unchecked_errors_up_to_symmetry,
    unchecked_pose_errors,
)
from caper_jax.lie import se3
from caper_jax.progress import progress
from caper_jax.synthetic.dataset import GeneratedDataset
from caper_jax.synthetic.frames import Generator
from caper_jax.training.parallel import DATA_AXIS, batch_sharding, data_mesh, replicated

BATCH_SIZE = 32
NUM_POINTS = 1024

# Poses [B, K, ...] for B frames and their clouds [B, N, 3], meters; or predictions with a ``pose``,
# which may also say whether they are ``plausible``.
Predictor = Callable[[Sequence[Frame], np.ndarray], ArticulatedPose | Prediction]


@flax.struct.dataclass
class Readings:
    """What an estimator says a frame may show, the answer first; see ``models.hypotheses``.

    Attributes:
      probability: that each of H readings is right.
      rotation_deg: errors of their parts, up to the category's declared symmetries.
    """

    probability: Float[Array, "F H"]
    rotation_deg: Float[Array, "F H K"]


@flax.struct.dataclass
class Estimates:
    """Estimates of F frames and their errors; numpy arrays, or JAX's within a program.

    Attributes:
      pose: arrays [F, K, ...]; NaN where ``failed``.
      failed: too few points, or an estimate that is not finite.
      plausible: what the predictor says of its estimates, False where ``failed``; None where it
        says nothing.
      errors: against the truth; ``metrics.FAILURE_VALUES`` where ``failed``.
      symmetric_errors: the same up to the category's declared symmetries; None where it has none.
      readings: of the estimator; None where it states no probabilities.
    """

    pose: ArticulatedPose
    failed: Bool[Array, " F"]
    plausible: Bool[Array, " F"] | None
    errors: PoseErrors
    symmetric_errors: PoseErrors | None
    readings: Readings | None = None


@dataclass(frozen=True)
class Evaluation:
    """Estimates of F frames, in the order of the dataset.

    Attributes:
      names: F names.
      estimate: arrays [F, K, ...]; NaN where ``failed``.
      truth: arrays [F, K, ...].
      failed, plausible, errors, symmetric_errors, readings: see ``Estimates``.
      visibility: [F, K] share of each part that nothing hides; NaN where the data do not say.
      seconds_per_frame: time of the predictor, after a first call that compiles; of an
        ``Estimator``, the errors' included.
    """

    names: list[str]
    estimate: ArticulatedPose
    truth: ArticulatedPose
    failed: Bool[np.ndarray, " frames"]
    plausible: Bool[np.ndarray, " frames"] | None
    errors: PoseErrors
    symmetric_errors: PoseErrors | None
    visibility: Float[np.ndarray, "frames parts"]
    seconds_per_frame: float
    readings: Readings | None = None


def evaluate(
    data: Dataset | Generator,
    estimator: Estimator | Predictor,
    frames: int | None = None,
    batch_size: int = BATCH_SIZE,
    num_points: int | None = None,
    seed: int = 0,
    devices: Sequence[jax.Device] | None = None,
    use_gravity: bool = False,
) -> Evaluation:
    """Estimates frames and measures the errors, in batches of one shape.

    An ``Estimator`` and the errors of what it says run as one program on the device, in float32,
    batches split over all devices; the errors of a predictor's poses are computed in float64 on
    the host. Meanwhile threads read and sample the next frames. Errors are kept per frame, so that
    no figure depends on batches or devices but for the rounding of the networks.

    Args:
      data: labeled frames, or what draws them.
      estimator: the model, or any predictor, e.g. ``truth_predictor``.
      frames: at most so many, from the first; of a generator, how many to draw.
      batch_size: frames per call; made a multiple of the number of devices. The last batch is
        filled up with copies, which do not count.
      num_points: points per cloud that a predictor sees, 1024 by default; an ``Estimator`` sees as
        many as its networks take.
      seed: of a generator's frames, which are those that ``caper generate`` writes for it.
      devices: that an ``Estimator`` runs on; all of this process by default.
      use_gravity: whether an ``Estimator`` is told which way things fall, where the data know it.

    Raises:
      CaperError: no frames, frames without (or with broken) ground truth, or of another category
        than the estimator's.
    """
    dataset = _frames_of(data, frames, seed)
    count = len(dataset) if frames is None else min(frames, len(dataset))
    if count <= 0:
        raise CaperError(f"nothing to evaluate: {len(dataset)} frames, {frames} wanted")
    category = dataset.category
    if isinstance(estimator, Estimator):
        if estimator.category.name != category.name:
            raise CaperError(
                f"the frames show {category.name!r}, the model estimates "
                f"{estimator.category.name!r}"
            )
        mesh = data_mesh(jax.local_devices() if devices is None else devices)
        batch_size = -(-batch_size // mesh.size) * mesh.size
        num_points = estimator.network.num_points
        step: Any = _EstimatorStep(estimator, category, mesh, use_gravity)
    else:
        step = _PredictorStep(estimator, category)
    # Where there are more batches to time, none is estimated twice.
    again = count <= batch_size or not isinstance(estimator, Estimator)
    parts: list[Estimates] = []
    names: list[str] = []
    truths: list[ArticulatedPose] = []
    visibility: list[np.ndarray] = []
    unknown = np.full(category.num_parts, np.nan)
    seconds = []
    with progress("evaluating", total=count) as bar:
        for batch in frame_batches(dataset, count, batch_size, num_points or NUM_POINTS):
            if not parts:
                found = jax.block_until_ready(step.predict(batch))  # compiles
            if parts or again:
                began = time.perf_counter()
                found = jax.block_until_ready(step.predict(batch))
                seconds.append(time.perf_counter() - began)
            estimates, truth = step.finish(batch, found), batch.truth
            if batch.count < batch_size:
                estimates, truth = jax.tree.map(lambda a, n=batch.count: a[:n], (estimates, truth))
            parts.append(estimates)
            truths.append(truth)
            shown = batch.frames[: batch.count]
            names += [frame.name for frame in shown]
            visibility += [unknown if f.visibility is None else f.visibility for f in shown]
            bar.update(batch.count)
    whole = jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)
    return Evaluation(
        names=names,
        estimate=whole.pose,
        truth=jax.tree.map(lambda *arrays: np.concatenate(arrays), *truths),
        failed=whole.failed,
        plausible=whole.plausible,
        errors=whole.errors,
        symmetric_errors=whole.symmetric_errors,
        visibility=np.stack(visibility),
        seconds_per_frame=sum(seconds) / (len(seconds) * batch_size),
        readings=whole.readings,
    )


def _frames_of(data: Dataset | Generator, frames: int | None, seed: int) -> Dataset:
    if not isinstance(data, Generator):
        return data
    if frames is None:
        raise CaperError("a generator never ends: say how many frames=")
    return GeneratedDataset(data, frames, seed)


class _EstimatorStep:
    """Estimates and errors as one program, each device on its own rows."""

    def __init__(
        self, estimator: Estimator, category: Category, mesh: Mesh, use_gravity: bool = False
    ) -> None:
        self._use_gravity = use_gravity
        self._variables = jax.device_put(estimator.variables, replicated(mesh))
        self._rows = batch_sharding(mesh)
        self._static = {"function": estimator.function, "category": category, "mesh": mesh}

    def predict(self, batch: FrameBatch) -> Estimates:
        truth = jax.tree.map(np.float32, batch.truth)
        gravity = batch.gravity if self._use_gravity else None
        arrays = jax.device_put((batch.points, gravity, truth, batch.shown), self._rows)
        return _estimated(self._variables, *arrays, **self._static)

    def finish(self, batch: FrameBatch, found: Estimates) -> Estimates:
        return jax.device_get(found)


def _estimated_rows(variables, points, gravity, truth, shown, function, category) -> Estimates:
    told = {} if gravity is None else {"gravity": gravity}
    prediction = function(variables, points, **told)
    failed = ~(shown & is_finite(prediction.pose))
    arguments = prediction.pose, truth, category, failed
    symmetric = unchecked_errors_up_to_symmetry(*arguments) if category.symmetries else None
    return Estimates(
        pose=_without(prediction.pose, failed),
        failed=failed,
        plausible=prediction.plausible & ~failed,
        errors=unchecked_pose_errors(*arguments),
        symmetric_errors=symmetric,
        readings=_readings(prediction, truth, category, failed),
    )


def _readings(prediction: Prediction, truth, category: Category, failed) -> Readings | None:
    stated = getattr(prediction, "hypotheses", None)
    if stated is None:
        return None

    def error(pose: ArticulatedPose) -> Any:
        return unchecked_errors_up_to_symmetry(pose, truth, category, failed).rotation_deg

    off = jax.vmap(error, in_axes=1, out_axes=1)(stated.pose)
    return Readings(jnp.where(failed[:, None], 0.0, stated.probability), off)


@partial(jax.jit, static_argnames=("function", "category", "mesh"))
def _estimated(variables, points, gravity, truth, shown, function, category, mesh) -> Estimates:
    rows = partial(_estimated_rows, function=function, category=category)
    if mesh.size == 1:
        return rows(variables, points, gravity, truth, shown)
    everywhere, split = PartitionSpec(), PartitionSpec(DATA_AXIS)
    # Frames do not see one another, so nothing crosses between devices.
    return jax.shard_map(
        rows,
        mesh=mesh,
        in_specs=(everywhere, split, split, split, split),
        out_specs=split,
        check_vma=False,
    )(variables, points, gravity, truth, shown)


class _PredictorStep:
    """Poses by any function, and their errors in float64."""

    def __init__(self, predictor: Predictor, category: Category) -> None:
        self._predictor = predictor
        self._category = category

    def predict(self, batch: FrameBatch) -> ArticulatedPose | Prediction:
        return self._predictor(batch.frames, batch.points)

    def finish(self, batch: FrameBatch, found: Any) -> Estimates:
        plausible = getattr(found, "plausible", None)
        pose = jax.tree.map(np.asarray, getattr(found, "pose", found))
        failed = ~(batch.shown & is_finite(pose))
        arguments = pose, batch.truth, self._category, failed
        symmetric = pose_errors_up_to_symmetry(*arguments) if self._category.symmetries else None
        return Estimates(
            pose=_without(pose, failed),
            failed=failed,
            plausible=None if plausible is None else np.asarray(plausible) & ~failed,
            errors=pose_errors(*arguments),
            symmetric_errors=symmetric,
        )


def _without(pose: ArticulatedPose, failed: Any) -> ArticulatedPose:
    """Poses [B, ...] with NaN where they failed [B]; numpy or JAX's arrays."""
    xp = np if isinstance(failed, np.ndarray) else jnp
    return jax.tree.map(
        lambda a: xp.where(failed.reshape((-1,) + (1,) * (a.ndim - 1)), np.nan, a), pose
    )


def model_predictor(estimator: Callable[[np.ndarray], Any]) -> Predictor:
    """The estimates of a trained model as a predictor, one call per batch.

    ``evaluate`` takes an ``Estimator`` as it is, which is faster; this is for what only calls it.
    """

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
