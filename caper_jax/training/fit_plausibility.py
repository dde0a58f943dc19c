"""Fits the classifier of ``models.plausibility``: right objects against everything else.

Right ones are generated frames, some of them worse than training had. Wrong ones are the same
objects in other units, the objects of the other categories, walls, two objects under one mask, and
single parts. Instances of another split give the threshold.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.config import GeneratorConfig
from caper_jax.data.clouds import MIN_POINTS, systematic_indices
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.models.files import write_card, write_fitted
from caper_jax.models.observation import observe
from caper_jax.models.pipeline import refinements, run_stages
from caper_jax.models.plausibility import (
    OTHER,
    PART,
    PLAUSIBLE,
    SEVERAL,
    SIZE,
    PlausibilityClassifier,
    box_fit,
)
from caper_jax.progress import progress
from caper_jax.synthetic.frames import Generator
from caper_jax.training.fit_uncertainty import (
    BATCH,
    SPLIT,
    mixed_frames,
    mixture,
    sensors_alone,
)
from caper_jax.training.small_fits import minimize

FRAMES = 12_288  # of right objects, and about as many wrong ones
_FEWEST = 12 * BATCH
FALSE_ALARMS = 0.01  # of right objects that are called wrong
_OTHER_SIZES = ((0.08, 0.5), (2.0, 12.0))
_STEPS = 8000
_DRAWN = 1024  # frames per step
_RATE = 3e-3
_DECAY = 0.1
_NOISE = 0.1  # added to features, which are few
_PER_CALL = 500
_RARE = 1e-3  # share of objects of unseen frames that are smaller, and larger, than ...
_MARGIN = 0.15  # ... what a cloud may be, less a margin of the logarithm
# How much each class counts against right objects, which count as much as all together: halves of
# an object look like objects whose other half is hidden.
_WEIGHTS = {SIZE: 1.0, OTHER: 2.0, SEVERAL: 2.0, PART: 0.25}


def fit_plausibility(
    estimator: Estimator, config: GeneratorConfig, frames: int = FRAMES, seed: int = 0
) -> dict[str, Any]:
    """Weights of the classifier for a trained model.

    Args:
      estimator: the model.
      config: what right frames look like, see ``fit_uncertainty.calibrate``.
      frames: of right objects to fit on; half as many give the threshold.
      seed: of shapes and frames.
    """
    rng = np.random.default_rng(seed)
    measure = jax.jit(partial(_measure, estimator=estimator))

    def measured(clouds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(clouds)
        padded = np.resize(clouds, (-(-count // BATCH) * BATCH, *clouds.shape[1:]))
        rows = [
            jax.device_get(measure(estimator.variables, padded[start : start + BATCH]))
            for start in range(0, len(padded), BATCH)
        ]
        features, sizes = (np.concatenate(column)[:count] for column in zip(*rows, strict=True))
        return features, sizes

    kinds = mixture(config)
    batches = list(mixed_frames(estimator, kinds, "train", frames, seed, "judging right objects"))
    right = np.concatenate([batch.points for batch in batches])
    clean = np.concatenate([batch.points for batch in batches[1::3]])
    labels = np.concatenate([batch.labels for batch in batches[1::3]])
    features, _ = measured(right)
    samples = [(features, np.full(len(features), PLAUSIBLE))]
    wrong = wrong_clouds(estimator, clean, labels, config, frames, rng)
    with progress("judging wrong objects", total=frames) as bar:
        for kind, clouds in wrong:
            bad, _ = measured(clouds)
            samples.append((bad, np.full(len(bad), kind)))
            bar.update(len(bad))
    unseen = [
        measured(np.asarray(batch.points))
        for batch in mixed_frames(
            estimator, kinds[:2], SPLIT, frames // 2, seed + 1, "judging unseen objects"
        )
    ]
    unseen_features, unseen_sizes = (np.concatenate(column) for column in zip(*unseen, strict=True))
    features, classes = (np.concatenate(column) for column in zip(*samples, strict=True))
    usable = np.isfinite(features).all(-1)  # what is not a number is implausible anyway
    features, classes = features[usable], classes[usable]
    params = _fit(features, classes, seed)
    low, usual, high = np.quantile(unseen_sizes, [_RARE, 0.5, 1.0 - _RARE])
    bounds = [low - _MARGIN, usual, high + _MARGIN]
    logits: Any = PlausibilityClassifier().apply({"params": params}, unseen_features)
    score = logits[:, 0] - jax.nn.logsumexp(logits[:, 1:], axis=-1)
    threshold = np.quantile(np.asarray(score), FALSE_ALARMS)
    found = {"threshold": np.float32(threshold), "log_size": np.asarray(bounds, np.float32)}
    return {**jax.device_get(params), **found}


def add_plausibility(
    directory: str | Path,
    category: str | Category,
    config: GeneratorConfig,
    frames: int = FRAMES,
    seed: int = 0,
) -> None:
    """Fits the classifier of the model in a directory and writes it there, in place of an older.

    The calibration is dropped from the model's card: it rests on the classifier.

    Args:
      directory: of the model.
      category: its name, FILE.py:NAME, or the category itself.
      config, frames, seed: see ``fit_plausibility``.

    Raises:
      CaperError: too few frames; or see ``estimator.load``. The model is left as it was.
    """
    check_frame_count(frames)
    estimator = load(category, directory, calibrated=False)
    fitted = fit_plausibility(estimator, config, frames, seed)
    write_fitted(directory, "plausibility", fitted)
    origin = {"frames": frames, "seed": seed, "false_alarms": FALSE_ALARMS}
    write_card(directory, {**estimator.card, "plausibility": origin})


def check_frame_count(frames: int) -> None:
    """Raises CaperError where so many frames are too few to fit a classifier on."""
    if frames < _FEWEST:
        raise CaperError(f"judging plausibility needs {_FEWEST} frames or more, got {frames}")


def _measure(variables, points, estimator: Estimator):
    """(features [B, F], logarithms of sizes [B]) of clouds."""
    category, network = estimator.category, estimator.network
    observed = observe(points, category)
    outputs = run_stages(variables, observed.cloud, category, network)
    estimate = refinements(variables, outputs, observed.cloud, category, network)[-1]
    fit = box_fit(estimate, outputs.segmentation, outputs.evidence, observed, category)
    return fit.features, fit.log_size


def wrong_clouds(
    estimator: Estimator,
    right: Float[np.ndarray, "B N 3"],
    labels: np.ndarray,
    config: GeneratorConfig,
    frames: int,
    rng: np.random.Generator,
) -> Iterator[tuple[int, Float[np.ndarray, "M N 3"]]]:
    """Clouds that are no object of a category, with the class of what they are.

    Args:
      estimator: whose category it is.
      right: clouds that are, meters, camera frame.
      labels: [B, N] their parts.
      config: sensors that other objects are seen by.
      frames: about how many.
      rng: draws them.
    """
    category, count = estimator.category, frames // 8
    diagonal = float(
        rest_diagonal(np.asarray(category.mean_size), np.asarray(category.mean_center))
    )
    others = other_objects(estimator, config, 2 * count, int(rng.integers(1 << 30)))
    for low, high in _OTHER_SIZES:
        factor = np.exp(rng.uniform(np.log(low), np.log(high), (count, 1, 1)))
        yield SIZE, _pick(right, count, rng) * factor.astype(np.float32)
    yield OTHER, others
    usual = np.median(_radii(right))
    resized = usual / _radii(others[:count]) * np.exp(rng.normal(0.0, 0.25, count))
    yield OTHER, others[:count] * resized[:, None, None].astype(np.float32)
    yield OTHER, walls(2 * count, right.shape[1], diagonal, rng)
    yield SEVERAL, side_by_side(_pick(right, count, rng), right, rng)
    yield SEVERAL, side_by_side(_pick(right, count, rng), others, rng)
    alone = single_parts(right, labels, category.num_parts, count, rng)
    if len(alone):
        yield PART, alone


def other_objects(
    estimator: Estimator, config: GeneratorConfig, count: int, seed: int
) -> Float[np.ndarray, "B N 3"]:
    """Clouds of the other categories that are known, as many of each."""
    names = [name for name in categories.names() if name != estimator.category.name]
    each = -(-count // len(names))
    config = replace(sensors_alone(config), num_points=estimator.network.num_points)
    clouds = []
    for number, name in enumerate(names):
        generator = Generator(
            categories.get(name), replace(config, instances=min(each, 200)), "train", seed
        )
        key = jax.random.key(seed + number)
        size = min(each, BATCH)
        drawn = [
            np.asarray(generator.batch(jax.random.fold_in(key, start), size).points)
            for start in range(0, each, size)
        ]
        clouds.append(np.concatenate(drawn)[:each])
    return np.concatenate(clouds)[:count]


def walls(
    count: int, number: int, diagonal: float, rng: np.random.Generator
) -> Float[np.ndarray, "B N 3"]:
    """Clouds [count, number, 3] of flat surfaces of many outlines, 0.4 to 2.5 diagonals wide."""
    clouds = []
    for _ in range(count):
        flat = rng.uniform(-0.5, 0.5, (8 * number, 2))
        shape = rng.random()
        if shape < 0.35:  # an ellipse
            flat = flat[np.square(flat).sum(-1) < 0.25]
        elif shape < 0.6:  # a corner cut off along a line
            normal = rng.normal(size=2)
            kept = flat @ (normal / np.linalg.norm(normal)) < rng.uniform(-0.1, 0.4)
            flat = flat[kept]
        side, aspect = diagonal * np.exp(rng.uniform(np.log(0.4), np.log(2.5))), rng.uniform(0.5, 2)
        flat = np.resize(flat, (number, 2)) * side * [np.sqrt(aspect), 1 / np.sqrt(aspect)]
        depth = diagonal * rng.uniform(1.5, 6.0)
        turn, slope = rng.uniform(0, 2 * np.pi), np.tan(np.radians(rng.uniform(0, 70)))
        rays = flat / depth  # where they meet the plane, z (1 + slope . ray) is depth
        rise = slope * rays @ [np.cos(turn), np.sin(turn)]
        z = depth / np.clip(1.0 + rise, 0.3, 3.0) + rng.normal(0.0, 0.002 * depth, number)
        clouds.append(np.column_stack([rays * z[:, None], z]))
    return np.asarray(clouds, np.float32)


def side_by_side(
    first: Float[np.ndarray, "B N 3"], second: Float[np.ndarray, "M N 3"], rng: np.random.Generator
) -> Float[np.ndarray, "B N 3"]:
    """Each of ``first`` with one of ``second`` beside it, in as many points as one of them."""
    number = first.shape[1]
    clouds = []
    for cloud in first:
        other = second[rng.integers(len(second))]
        centers = cloud.mean(0), other.mean(0)
        radii = _radii(np.stack([cloud, other]), 0.9)
        toward = rng.normal(size=3) * [1.0, 0.5, 0.5]
        toward *= radii.sum() * rng.uniform(0.5, 1.0) / np.linalg.norm(toward)
        share = np.clip(radii[1] ** 2 / np.square(radii).sum(), 0.2, 0.8)
        of_other = int(share * number)
        other = other[rng.choice(number, of_other, replace=False)] - centers[1]
        own = cloud[rng.choice(number, number - of_other, replace=False)]
        clouds.append(np.concatenate([own, other + centers[0] + toward]))
    return np.asarray(clouds, np.float32)


def single_parts(
    clouds: Float[np.ndarray, "B N 3"],
    labels: np.ndarray,
    num_parts: int,
    count: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "M N 3"]:
    """The points of one part alone, of clouds in which others are seen as well; at most count."""
    number = clouds.shape[1]
    alone = []
    for cloud, label in zip(clouds, labels, strict=True):
        own = cloud[label == rng.integers(num_parts)]
        if MIN_POINTS <= len(own) < 0.9 * number:
            alone.append(own[systematic_indices(len(own), number)])
        if len(alone) == count:
            break
    return np.asarray(alone, np.float32).reshape(-1, number, 3)


def _radii(clouds: np.ndarray, share: float = 0.5) -> np.ndarray:
    """[B] distance from the median point that such a share of the points is within."""
    away = np.linalg.norm(clouds - np.median(clouds, axis=1, keepdims=True), axis=-1)
    return np.quantile(away, share, axis=1)


def _pick(clouds: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    return clouds[rng.integers(len(clouds), size=count)]


def _fit(features: np.ndarray, classes: np.ndarray, seed: int) -> Any:
    """Weights of the network, from features [S, F] and classes [S]."""
    module = PlausibilityClassifier()
    keys = jax.random.split(jax.random.key(seed), 2)
    params = module.init(keys[0], features[:1])["params"]
    right = features[classes == PLAUSIBLE]
    fixed = {
        "mean": jnp.asarray(right.mean(0)),
        "scale": jnp.asarray(1.0 / (right.std(0) + 0.02)),
        "threshold": params["threshold"],
        "log_size": params["log_size"],
    }
    free = {name: value for name, value in params.items() if name not in fixed}
    weights = {**_WEIGHTS, PLAUSIBLE: sum(_WEIGHTS.values())}
    chance = np.array([weights[kind] / (classes == kind).sum() for kind in classes.tolist()])
    edges = jnp.asarray(np.cumsum(chance / chance.sum()), jnp.float32)
    deviation = _NOISE / fixed["scale"]

    def loss(free, data, key):
        draw, shake = jax.random.split(key)
        index = jnp.searchsorted(edges, jax.random.uniform(draw, (_DRAWN,)))
        index = jnp.minimum(index, len(edges) - 1)
        drawn, kinds = jax.tree.map(lambda values: values[index], data)
        drawn += deviation * jax.random.normal(shake, drawn.shape)
        logits: Any = module.apply({"params": free | fixed}, drawn)
        return optax.softmax_cross_entropy_with_integer_labels(logits, kinds).mean()

    free = minimize(
        loss,
        free,
        (features, classes.astype(np.int32)),
        keys[1],
        calls=_STEPS // _PER_CALL,
        per_call=_PER_CALL,
        rate=_RATE,
        decay=_DECAY,
        title="fitting the classifier",
    )
    return free | fixed
