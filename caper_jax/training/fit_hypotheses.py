"""Fits the probabilities of readings (``models.hypotheses``) on generated frames."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.scipy.optimize import minimize as minimize_smooth
from jaxtyping import Array, Bool, Float

from caper_jax.articulation.category import Category
from caper_jax.config import GeneratorConfig
from caper_jax.data.types import Batch
from caper_jax.estimator import Estimator, load
from caper_jax.lie import so3
from caper_jax.models import hypotheses
from caper_jax.models.files import write_card, write_fitted
from caper_jax.models.hypotheses import MOST, RIGHT_DEG, ReadingScorer, log_probabilities
from caper_jax.models.observation import observe
from caper_jax.models.pipeline import articulated_pose, refinements, run_stages
from caper_jax.models.plausibility import box_fit
from caper_jax.training.fit_uncertainty import (
    SPLIT,
    mixed_frames,
    mixture,
    nearer_symmetry,
)
from caper_jax.training.small_fits import minimize

FRAMES = 6144
_STEPS, _PER_CALL = 4000, 500
_DRAWN = 512  # frames per step
_RATE, _DECAY = 2e-3, 0.1
_NOISE = 0.15  # added to features, in their standard deviations: frames are few
_TEMPERATURE = ("sharpness", "shift")  # fitted last
_SEED = 11  # of shapes, besides the one that is given: those of the classifier are others


def fit_hypotheses(
    estimator: Estimator, config: GeneratorConfig, frames: int = FRAMES, seed: int = 0
) -> dict[str, Any]:
    """Weights of the scorer for a trained model, and how well they say what they should.

    Args:
      estimator: the model; a scorer that it has already is left out.
      config: what frames look like, see ``fit_uncertainty.calibrate``.
      frames: to fit on; a quarter as many of other instances give the temperatures.
      seed: of shapes and frames.
    """
    params = ReadingScorer().init(
        jax.random.key(seed),
        np.zeros((1, hypotheses.num_features(estimator.category.num_parts)), np.float32),
        np.zeros(1, np.int32),
    )["params"]
    kinds = mixture(config)
    data = _measured(estimator, params, kinds, "train", frames, seed + _SEED)
    unseen = _measured(estimator, params, kinds, SPLIT, frames // 4, seed + _SEED)
    fitted = fit_scorer(params, data, seed)
    return with_temperatures(fitted, unseen)


def add_hypotheses(
    directory: str | Path,
    category: str | Category,
    config: GeneratorConfig,
    frames: int = FRAMES,
    seed: int = 0,
) -> None:
    """Fits the probabilities of readings of the model in a directory, and writes them there.

    Args:
      directory: of the model.
      category: its name, FILE.py:NAME, or the category itself.
      config, frames, seed: see ``fit_hypotheses``.

    Raises:
      CaperError: see ``estimator.load``. The model is left as it was.
    """
    estimator = load(category, directory)
    fitted = fit_hypotheses(estimator, config, frames, seed)
    write_fitted(directory, "hypotheses", fitted)
    write_card(directory, {**estimator.card, "hypotheses": {"frames": frames, "seed": seed}})


def _measured(estimator, params, kinds, split: str, frames: int, seed: int) -> dict[str, Any]:
    """Features [S, H, F], classes [S, H], copies [S, H] and rightness [S, H] of readings."""
    measure = jax.jit(partial(_measure, estimator=estimator))
    rows = [
        jax.device_get(measure(estimator.variables, params, batch))
        for batch in mixed_frames(estimator, kinds, split, frames, seed, "reading clouds")
    ]
    columns = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    usable = np.isfinite(columns["features"]).all((1, 2))
    return {name: column[usable] for name, column in columns.items()}


def _measure(variables, params, batch: Batch, estimator: Estimator) -> dict[str, Array]:
    category, network = estimator.category, estimator.network
    observed = observe(batch.points, category)
    outputs = run_stages(variables, observed.cloud, category, network)
    refined = refinements(variables, outputs, observed.cloud, category, network)[-1]
    fit = box_fit(refined, outputs.segmentation, outputs.evidence, observed, category)
    answer = hypotheses.first_reading(outputs, refined, fit)
    classes = hypotheses.other_classes(outputs, params, MOST - 1, None, category)
    others = hypotheses.other_readings(variables, observed, outputs, classes, category, network)
    readings = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), answer, others)

    def is_right(estimate) -> Bool[Array, "B"]:
        return right(articulated_pose(estimate, observed.view, category), batch, category)

    found = {
        "features": readings.features,
        "rotation_class": readings.rotation_class,
        "repeated": hypotheses.repeated(readings.estimate),
        "right": jax.vmap(is_right)(readings.estimate),
    }
    return {name: jnp.moveaxis(values, 0, 1) for name, values in found.items()}


def right(pose, batch: Batch, category: Category) -> Bool[Array, "B"]:
    """Whether a reading is right: all rotations within ``RIGHT_DEG``, up to declared symmetry."""
    truth = nearer_symmetry(pose, batch.pose, category)
    angle = so3.geodesic_distance(pose.rotation, truth.rotation)
    return (angle < np.radians(RIGHT_DEG)).all(-1)


def fit_scorer(params: dict[str, Any], data: dict[str, Any], seed: int) -> dict[str, Any]:
    """Weights from readings: cross entropy among them, and of the answer by itself."""
    features = data["features"]
    spread = features.std((0, 1))
    fixed = {name: params[name] for name in _TEMPERATURE}
    fixed |= {
        "mean": jnp.asarray(features.mean((0, 1))),
        "scale": jnp.asarray(1.0 / (spread + 0.02)),
    }
    free = {name: value for name, value in params.items() if name not in fixed}

    def loss(free, data, key):
        draw, shake = jax.random.split(key)
        index = jax.random.randint(draw, (_DRAWN,), 0, len(data["right"]))
        drawn = jax.tree.map(lambda values: values[index], data)
        noise = _NOISE * spread * jax.random.normal(shake, drawn["features"].shape)
        params = free | fixed
        score, alone = _scores(params, {**drawn, "features": drawn["features"] + noise})
        return _comparison(params, score, drawn) + _by_itself(alone, drawn)

    free = minimize(
        loss,
        free,
        data,
        jax.random.key(seed + 1),
        calls=_STEPS // _PER_CALL,
        per_call=_PER_CALL,
        rate=_RATE,
        decay=_DECAY,
        title="fitting probabilities",
    )
    return jax.device_get(free | fixed)


def with_temperatures(params: dict[str, Any], data: dict[str, Any]) -> dict[str, Any]:
    """The weights, with temperatures at which probabilities are right on unseen instances."""
    score, alone = _scores(params, data)

    def loss(values):
        trial = {**params, "sharpness": jnp.exp(values[:2]), "none": params["none"] + values[3]}
        first = _comparison(trial, trial["sharpness"][0] * score, data)
        return first + _by_itself(trial["sharpness"][1] * alone + values[2], data)

    found = minimize_smooth(loss, jnp.zeros(4), method="BFGS").x
    return {
        **params,
        "sharpness": np.exp(np.asarray(found[:2])),
        "shift": np.asarray(found[2]),
        "none": np.asarray(params["none"] + found[3]),
    }


def _scores(params: dict[str, Any], data: dict[str, Any]) -> tuple[Array, Array]:
    """(score, log odds by itself) [S, H] of readings."""
    result: Any = ReadingScorer().apply(
        {"params": params}, data["features"], data["rotation_class"]
    )
    return result


def _comparison(params: dict[str, Any], score: Array, data: dict[str, Any]) -> Float[Array, ""]:
    """Cross entropy of the right one among the readings and none of them."""
    choices = log_probabilities(params, score.T, data["repeated"].T)
    is_right = (data["right"] & ~data["repeated"]).T
    target = jnp.concatenate([is_right, ~is_right.any(0, keepdims=True)])
    # Where two are right, either will do.
    return -jax.nn.logsumexp(jnp.where(target, choices, -jnp.inf), axis=0).mean()


def _by_itself(alone: Array, data: dict[str, Any]) -> Float[Array, ""]:
    """Cross entropy of the answer's being right."""
    is_right = data["right"][:, 0].astype(alone.dtype)
    return optax.sigmoid_binary_cross_entropy(alone[:, 0], is_right).mean()
