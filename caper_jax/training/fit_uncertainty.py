"""Calibrates a model's uncertainty (``caper_jax.models.uncertainty``) on generated frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.articulation.symmetry import apply_symmetry, is_ambiguous
from caper_jax.config import GeneratorConfig
from caper_jax.data.types import Batch
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, estimate
from caper_jax.lie import so3
from caper_jax.models.uncertainty import COVERAGE, foreshortening, size_inputs
from caper_jax.progress import progress
from caper_jax.synthetic.frames import Generator
from caper_jax.synthetic.instances import split_key
from caper_jax.synthetic.sensor import CAMERAS
from caper_jax.training.objective import where_samples

FRAMES = 4096
SPLIT = "val"
BATCH = 32
_SMALLEST = 1e-5  # radians or units: below it an error has no logarithm worth fitting
_ITERATIONS = 200
_STREAM = 0xCA11B8A7  # of random numbers, besides those of the splits


def calibrate(
    estimator: Estimator, config: GeneratorConfig, frames: int = FRAMES, seed: int = 0
) -> dict[str, Any]:
    """The "calibration" section of a model card, JSON-ready.

    Args:
      estimator: the model.
      config: what a third of the frames look like; another has the sensors' noise alone, and the
        last what is worse than in training (``disturbed``). Of instances that training never saw,
        and of the cameras among its sensors: fitted on clean depth as well, regions would be too
        small on what a camera gives.
      frames: how many to fit on.
      seed: of shapes and frames.

    Raises:
      CaperError: too few frames.
    """
    check_frame_count(frames)
    cameras = tuple(name for name in config.noise if name in CAMERAS) or config.noise
    config = replace(config, noise=cameras)
    measure = jax.jit(partial(_measure, estimator=estimator))
    rows = [
        jax.device_get(measure(estimator.variables, batch))
        for batch in mixed_frames(estimator, mixture(config), SPLIT, frames, seed, "calibrating")
    ]
    columns = [np.concatenate(column)[:frames] for column in zip(*rows, strict=True)]
    evidence, seen, size_errors, *errors = columns
    low, high = np.quantile(evidence, [0.01, 0.99], axis=(0, 1))
    inside = np.clip(evidence, low, high)
    rotation, translation, state = (
        [
            quantile_regression(inside[:, -count + k], np.log(np.maximum(error[:, k], _SMALLEST)))
            for k in range(count)
        ]
        for error, count in zip(errors, (error.shape[1] for error in errors), strict=True)
    )
    inputs = np.asarray(size_inputs(jnp.asarray(inside), jnp.asarray(seen)))
    size = [
        [
            quantile_regression(inputs[:, k, a], np.log(np.maximum(errors, _SMALLEST)))
            for a, errors in enumerate(np.moveaxis(of_part, -1, 0))
        ]
        for k, of_part in enumerate(np.moveaxis(size_errors, 1, 0))
    ]
    section = {"rotation": rotation, "translation": translation, "state": state, "size": size}
    section |= {"low": low, "high": high}
    rounded = {name: np.round(np.asarray(value), 5).tolist() for name, value in section.items()}
    data = {"frames": frames, "split": SPLIT, "seed": seed, "noise": list(cameras)}
    return {**rounded, "coverage": COVERAGE, **data}


def check_frame_count(frames: int) -> None:
    """Raises CaperError where so many frames are too few to calibrate on."""
    if frames < 10 * BATCH:
        raise CaperError(f"calibration needs {10 * BATCH} frames or more, got {frames}")


def sensors_alone(config: GeneratorConfig) -> GeneratorConfig:
    """Frames that suffer from the noise of the sensors and from nothing else."""
    return GeneratorConfig(
        instances=config.instances,
        grid=config.grid,
        num_points=config.num_points,
        noise=config.noise,
    )


def disturbed(config: GeneratorConfig) -> GeneratorConfig:
    """Frames of the same right objects that are worse than those of training: strays of all kinds,
    masks too wide, things in front, and few points."""
    return replace(
        config,
        specks=0.1,
        speckle=0.1,
        flying=0.2,
        rim=0.2,
        hand=0.1,
        cable=0.1,
        few_points=0.5,
    )


def mixture(config: GeneratorConfig) -> tuple[GeneratorConfig, ...]:
    """What a model's word on its own estimates is fitted on: frames as given, and of both kinds."""
    return config, sensors_alone(config), disturbed(config)


def mixed_frames(
    estimator: Estimator,
    configs: Sequence[GeneratorConfig],
    split: str,
    frames: int,
    seed: int,
    title: str,
) -> Iterator[Batch]:
    """Batches of generated frames of an estimator's category, by turns as each of ``configs`` has
    them, with as many points as it takes.

    Cameras, states and sensors are drawn apart from those of training, and from the frames that a
    split and a seed name: what is fitted on these frames can be tested on the others.

    Args:
      estimator: whose category it is.
      configs: what the frames suffer from.
      split: of the instances.
      frames: at least so many.
      seed: of shapes and frames.
      title: of the progress display.
    """
    generators = [
        Generator(
            estimator.category,
            replace(
                config,
                instances=min(config.instances, frames),
                num_points=estimator.network.num_points,
            ),
            split,
            seed,
        )
        for config in configs
    ]
    key = jax.random.fold_in(split_key(split, seed), _STREAM)
    with progress(title, total=frames) as bar:
        for start in range(0, frames, BATCH):
            generator = generators[start // BATCH % len(generators)]
            yield generator.batch(jax.random.fold_in(key, start), BATCH)
            bar.update(min(BATCH, frames - start))


def quantile_regression(
    inputs: Float[np.ndarray, "samples features"],
    target: Float[np.ndarray, " samples"],
    level: float = COVERAGE,
) -> Float[np.ndarray, " coefficients"]:
    """Coefficients [F + 1], the constant last, of the linear ``level`` quantile.

    Minimizes the pinball loss by majorization: each step replaces |r| by a parabola that touches
    it where the residual r is, and solves the weighted least squares that follow.

    Args:
      inputs: [S, F].
      target: [S].
      level: share of the targets that lie below.
    """
    design = np.column_stack([inputs, np.ones(len(target))]).astype(np.float64)
    # A hair of ridge: evidence that never varies leaves its coefficient at zero.
    ridge = 1e-6 * len(target) * np.eye(design.shape[1])
    solution = np.linalg.solve(design.T @ design + ridge, design.T @ target)
    for _ in range(_ITERATIONS):
        weight = 1.0 / (np.abs(target - design @ solution) + 1e-4)
        weighted = design * weight[:, None]
        right = weighted.T @ target + (2.0 * level - 1.0) * design.sum(0)
        solution = np.linalg.solve(weighted.T @ design + ridge, right)
    return solution


def _measure(variables, batch: Batch, estimator: Estimator):
    """(evidence [B, K, E], foreshortening [B, K, 3], errors of size [B, K, 3], rotation [B, K],
    translation [B, K], state [B, J])."""
    category = estimator.category
    prediction = estimate(variables, batch.points, category, estimator.network)
    pose, truth = prediction.pose, nearer_symmetry(prediction.pose, batch.pose, category)
    shift = (pose.translation - truth.translation) * category.unit
    state = jnp.abs(pose.joint_state - truth.joint_state) * category.state_units
    angle = so3.geodesic_distance(pose.rotation, truth.rotation)
    seen = foreshortening(pose.rotation, pose.translation)
    size = jnp.abs(pose.size - truth.size) * category.unit
    return prediction.evidence, seen, size, angle, jnp.linalg.norm(shift, axis=-1), state


def nearer_symmetry(
    pose: ArticulatedPose, truth: ArticulatedPose, category: Category
) -> ArticulatedPose:
    """The truth [B, ...]; of objects that a category declares ambiguous that which is nearer.

    Nobody can know which of equal halves bears which name: an estimate need not doubt itself there.
    """
    for symmetry in category.symmetries:
        other = apply_symmetry(truth, symmetry, category)
        angles = [
            so3.geodesic_distance(pose.rotation[:, 0], one.rotation[:, 0]) for one in (other, truth)
        ]
        nearer = is_ambiguous(truth.size, symmetry) & (angles[0] < angles[1])
        truth = where_samples(nearer, other, truth)
    return truth
