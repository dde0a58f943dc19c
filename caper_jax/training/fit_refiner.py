"""Fits the refiner (``models.refiner``) of a trained model.

Both stages stay as they are. They estimate poses on generated frames; what these are off by is
regressed on what the points say about the estimated boxes, with the L1 losses of Eqs 17 to 21.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import PRESETS, GeneratorConfig, NetworkConfig, RefinerConfig
from caper_jax.data.types import Batch
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load
from caper_jax.lie import se3
from caper_jax.models.files import write_model
from caper_jax.models.observation import observe
from caper_jax.models.pipeline import (
    articulated_pose,
    refinements,
    refiner_inputs,
    run_stages,
)
from caper_jax.models.refiner import BoxRefiner, RefinerOutput
from caper_jax.training.fit_uncertainty import mixed_frames, nearer_symmetry, sensors_alone
from caper_jax.training.small_fits import minimize

FRAMES = 40_000
_SPLIT = "train"
_BATCH = 512
_STEPS = 6000  # at least
_EPOCHS = 25  # over many frames
_PER_CALL = 100  # steps compiled into one call
_RATE = 2e-3
_DECAY = 1e-3
_DROPOUT = 0.1  # of features: frames are few
_MAX_ROTATION = np.radians(20.0)  # a root that is off by more lies in another box
_WEIGHTS = RefinerOutput(size=1.0, center=1.0, twist=4.0, pivot=2.0, state=2.0)


class UnreliableModel(CaperError):
    """A model whose estimates are too wrong for a refiner to correct."""


def fit_refiner(
    estimator: Estimator, config: GeneratorConfig, width: int, frames: int = FRAMES, seed: int = 0
) -> dict[str, Any]:
    """Weights of a ``BoxRefiner`` for a trained model.

    Args:
      estimator: the model; a refiner in it is not used.
      config: what half of the frames look like; the others have the sensors' noise alone. Of
        other shapes than those that a run with the same seed was trained on.
      width: of the network.
      frames: how many to fit on, besides a quarter of them for a first round.
      seed: of shapes, frames and weights.

    Raises:
      CaperError: too few frames; UnreliableModel, the root is badly rotated in nearly all of them.
    """
    check_frame_count(frames)
    network = replace(estimator.network, refiner=RefinerConfig())
    first = _regress(estimator, network, config, width, max(frames // 4, 2 * _BATCH), seed + 1)
    # Then on both what the stages estimate and what the first round makes of it.
    params = {**estimator.variables["params"], "refiner": first}
    estimator = Estimator(estimator.category, network, {**estimator.variables, "params": params})
    network = replace(network, refiner=RefinerConfig(width, iterations=1))
    return _regress(estimator, network, config, width, frames, seed + 2)


def check_frame_count(frames: int) -> None:
    """Raises CaperError where so many frames are too few to fit a refiner on."""
    if frames < 2 * _BATCH:
        raise CaperError(f"fitting a refiner needs {2 * _BATCH} frames or more, got {frames}")


def _regress(
    estimator: Estimator,
    network: NetworkConfig,
    config: GeneratorConfig,
    width: int,
    frames: int,
    seed: int,
) -> dict[str, Any]:
    """Weights regressed on the estimates of such a network, before and after its own refiner."""
    measure = jax.jit(partial(_measure, category=estimator.category, network=network))
    rows = []
    title = "estimating poses for the refiner"
    configs = (config, sensors_alone(config))
    for batch in mixed_frames(estimator, configs, _SPLIT, frames, seed, title):
        rows += jax.device_get(measure(estimator.variables, batch))
    features, off, learn = (
        jax.tree.map(lambda *parts: np.concatenate(parts), *column)
        for column in zip(*rows, strict=True)
    )
    if learn.mean() < 0.1:
        raise UnreliableModel(
            f"the root is off by more than {np.degrees(_MAX_ROTATION):.0f} deg in "
            f"{100 - 100 * learn.mean():.0f} % of {frames} frames: train the model longer before "
            "its refiner is fitted, or set network.refiner.width = 0"
        )
    features, off = jax.tree.map(lambda values: values[learn], (features, off))
    return _fit(features, off, width, estimator.category.num_parts, seed)


def add_refiner(
    directory: str | Path,
    category: str | Category,
    config: GeneratorConfig,
    width: int | None = None,
    frames: int = FRAMES,
    seed: int = 0,
) -> None:
    """Fits a refiner for the model in a directory and writes it there, in place of an older one.

    The calibration is dropped from the model's card: its errors are others now.

    Args:
      directory: of the model.
      category: its name, FILE.py:NAME, or the category itself.
      width: of the network; None for that of the older one, or of the fast preset's.
      config, frames, seed: see ``fit_refiner``.

    Raises:
      CaperError: see ``fit_refiner`` and ``estimator.load``; the model is left as it was.
    """
    estimator = load(category, directory, calibrated=False)
    card, variables = estimator.card, estimator.variables
    width = width or estimator.network.refiner.width or PRESETS["fast"].network.refiner.width
    fitted = fit_refiner(estimator, config, width, frames, seed)
    params = {**variables["params"], "refiner": fitted}
    network = card["run"]["network"]
    refiner = {**network.get("refiner", {}), "width": width}
    run = {**card["run"], "network": {**network, "refiner": refiner}}
    origin = {"frames": frames, "split": _SPLIT, "seed": seed}
    write_model(directory, {**variables, "params": params}, {**card, "run": run, "refiner": origin})


def _measure(variables, batch: Batch, category: Category, network: NetworkConfig):
    """(features [B, F], RefinerOutput that would be right, whether to learn it [B]) of every
    estimate: before and after each iteration of the network's refiner."""
    observed = observe(batch.points, category)
    cloud, view = observed.cloud, observed.view
    outputs = run_stages(variables, cloud, category, network)
    rows = []
    for estimate in refinements(variables, outputs, cloud, category, network):
        pose = articulated_pose(estimate, view, category)
        truth = nearer_symmetry(pose, batch.pose, category)
        off = difference(pose, truth, category)
        learn = jnp.linalg.norm(off.twist[:, :3], axis=-1) < _MAX_ROTATION
        rows.append((refiner_inputs(outputs, estimate, cloud, category), off, learn))
    return rows


def difference(pose: ArticulatedPose, truth: ArticulatedPose, category: Category) -> RefinerOutput:
    """What takes an estimate [B, ...] to the truth; ``models.refiner.apply_residual`` adds it.

    Pivots differ by what lies across the true axis: along it they may be anywhere.
    """
    unit = category.unit
    one, other = (se3.from_rt(p.rotation[:, 0], p.translation[:, 0] * unit) for p in (pose, truth))
    shift = (truth.joint_pivot - pose.joint_pivot) * unit
    along = (shift * truth.joint_axis).sum(-1, keepdims=True) * truth.joint_axis
    return RefinerOutput(
        size=jnp.log(truth.size / pose.size),
        center=(truth.box_center - pose.box_center) / pose.size,
        twist=se3.log(se3.compose(se3.inverse(one), other)),
        pivot=shift - along,
        state=(truth.joint_state - pose.joint_state) * category.state_units,
    )


def _fit(features: np.ndarray, off: RefinerOutput, width: int, num_parts: int, seed: int) -> Any:
    """Weights of the network, from features [S, F] and targets."""
    module = BoxRefiner(width, num_parts)
    keys = jax.random.split(jax.random.key(seed), 2)
    params = module.init(keys[0], features[:1])["params"]
    mean, deviation = features.mean(0), features.std(0)
    scale = 1.0 / (deviation + 0.02)  # what never varies stays small
    params |= {"mean": jnp.asarray(mean), "scale": jnp.asarray(scale)}
    calls = max(_STEPS, _EPOCHS * len(features) // _BATCH) // _PER_CALL

    def loss(free, data, key):
        draw, drop = jax.random.split(key)
        index = jax.random.randint(draw, (_BATCH,), 0, len(features))
        chosen, right = jax.tree.map(lambda values: values[index], data)
        kept = jax.random.bernoulli(drop, 1 - _DROPOUT, chosen.shape)
        chosen = jnp.where(kept, chosen, mean)
        output = module.apply({"params": params | free}, chosen)
        errors = jax.tree.map(lambda o, r: jnp.abs(o - r).mean(), output, right)
        return sum(jax.tree.leaves(jax.tree.map(jnp.multiply, _WEIGHTS, errors)))

    free = {name: value for name, value in params.items() if name not in ("mean", "scale")}
    free = minimize(
        loss,
        free,
        (features, off),
        keys[1],
        calls=calls,
        per_call=_PER_CALL,
        rate=_RATE,
        decay=_DECAY,
        title="fitting the refiner",
    )
    # Rounded to bfloat16, which costs nothing that can be measured: files become smaller.
    short = jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16).astype(jnp.float32), free)
    return jax.device_get(params | short)
