"""Robustness: what stray points, few points, wrong units and wrong objects do to an estimate.

Clouds of generated frames of instances that training never saw are disturbed by known amounts. What
is disturbed is still the object, so that errors and stated regions mean something; of what is no
object of the category only the verdict counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from caper_jax.config import GeneratorConfig
from caper_jax.data.clouds import systematic_indices
from caper_jax.data.types import Batch
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation.metrics import pose_errors
from caper_jax.evaluation.report import FLIPPED_DEG
from caper_jax.models.uncertainty import COVERAGE, RADIUS_1D, RADIUS_3D
from caper_jax.reproduce.data import find_models
from caper_jax.reproduce.options import SPLIT, Options
from caper_jax.reproduce.report import Report, Table, number
from caper_jax.synthetic.frames import Generator, collect
from caper_jax.synthetic.instances import split_key
from caper_jax.training.fit_plausibility import side_by_side, single_parts, walls
from caper_jax.training.fit_uncertainty import BATCH, nearer_symmetry
from caper_jax.visualization.plots import Curves

FRAMES = 512
_INSTANCES = 200
_SHARES = (0.001, 0.003, 0.01, 0.03, 0.1)
_POINTS = (48, 64, 100, 200, 400)
_FACTORS = (0.1, 0.2, 0.5, 2.0, 5.0, 10.0)
_HEADER = (
    *("category", "disturbed by", "root rot median [deg]", f"> {FLIPPED_DEG:.0f} deg [%]"),
    *("rot inside [%]", "trans inside [%]", "state inside [%]", "implausible [%]"),
)
_VERDICT_HEADER = ("category", "what it is", "implausible [%]", "area under ROC")


def run(name: str, options: Options) -> Report:
    """Measures robustness, or the verdicts on wrong objects.

    Args:
      name: "robustness" or "plausibility".
      options: from the command line.

    Raises:
      CaperError: a named category without a model, or one that cannot be drawn.
    """
    return _robustness(options) if name == "robustness" else _plausibility(options)


def unseen_frames(
    estimator: Estimator,
    options: Options,
    distance: tuple[float, float] | None = None,
    frames: int | None = None,
    **changes: Any,
) -> Batch:
    """Generated frames of unseen instances, with the noise of one sensor and ``changes``.

    Args:
      estimator: gives category and number of points.
      options: seed, noise and number of frames.
      distance: of the cameras, in object diagonals; as the category has it by default.
      frames: how many, where not as the options say.
      changes: of the ``GeneratorConfig``.

    Raises:
      CaperError: a category without shapes.
    """
    category = estimator.category
    if distance is not None:
        view = replace(category.viewpoint, distance=distance)
        category = replace(category, viewpoint=view)
    if category.shape is None:
        raise CaperError(f"{category.name}: it draws no shapes, so there is nothing to generate")
    config = GeneratorConfig(instances=_INSTANCES, num_points=estimator.network.num_points)
    config = replace(options.generator(config), **changes)
    generator = Generator(category, config, SPLIT, options.seed)
    key = split_key(SPLIT, options.seed)
    title = f"generating {category.name}"
    return collect(generator.batch, key, frames or options.frames or FRAMES, BATCH, title)


def disturbances() -> Iterator[tuple[str, float, Callable[..., np.ndarray]]]:
    """(kind, amount, what draws the clouds) of all that are disturbed after they were generated."""
    for share in _SHARES:
        yield "specks", share, partial(with_specks, share=share)
    for share in _SHARES:
        yield "speckle", share, partial(with_speckle, share=share)
    for count in _POINTS:
        yield "points", count, partial(with_few, count=count)


def with_specks(
    points: Float[np.ndarray, "B N 3"], share: float, rng: np.random.Generator
) -> Float[np.ndarray, "B N 3"]:
    """Clouds in which such a share lies anywhere in a ball of 1.5 times the object's radius."""
    center = points.mean(1, keepdims=True)
    radius = np.linalg.norm(points - center, axis=-1).max(1)[:, None, None]
    direction = rng.normal(size=points.shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    anywhere = center + 1.5 * radius * rng.random((*points.shape[:2], 1)) ** (1 / 3) * direction
    chosen = rng.random((*points.shape[:2], 1)) < share
    return np.where(chosen, anywhere, points).astype(np.float32)


def with_speckle(
    points: Float[np.ndarray, "B N 3"], share: float, rng: np.random.Generator
) -> Float[np.ndarray, "B N 3"]:
    """Clouds in which such a share is moved along its rays, by a fifth of the radius on average."""
    radius = np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1).max(1)
    moved = 0.2 * radius[:, None] * rng.laplace(size=points.shape[:2])
    factor = np.maximum(1.0 + moved / np.linalg.norm(points, axis=-1), 0.2)
    chosen = rng.random(points.shape[:2]) < share
    return np.where(chosen[..., None], points * factor[..., None], points).astype(np.float32)


def with_few(
    points: Float[np.ndarray, "B N 3"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "B N 3"]:
    """Clouds of so many of the points, repeated to fill them."""
    number = points.shape[1]
    chosen = [np.sort(rng.choice(number, count, replace=False)) for _ in points]
    index = np.stack(chosen)[:, systematic_indices(count, number)]
    return np.take_along_axis(points, index[..., None], axis=1)


def _robustness(options: Options) -> Report:
    rows: list[list[str]] = []
    result: dict[str, Any] = {}
    curves = {}
    for name, estimator in find_models(options).items():
        if estimator.calibration is None:
            raise CaperError(f"{name}: no calibration in the model card; run caper calibrate")
        batch = unseen_frames(estimator, options)
        rng = np.random.default_rng(options.seed)
        found = {("clean", 0.0): _measured(estimator, batch, batch.points)}
        for kind, amount, draw in disturbances():
            found[kind, amount] = _measured(
                estimator, batch, draw(np.asarray(batch.points), rng=rng)
            )
        rim = unseen_frames(estimator, options, rim=1.0)
        found["mask rim", 1.0] = _measured(estimator, rim, rim.points)
        result[name] = {f"{kind} {amount:g}": row for (kind, amount), row in found.items()}
        rows += [[name, _label(*key), *_texts(row)] for key, row in found.items()]
        curves[name] = Curves(
            f"stray points: {name}",
            "share of the points [%]",
            f"root off by more than {FLIPPED_DEG:.0f} deg [%]",
            {
                kind: (
                    np.array([0.0, *(100 * share for share in _SHARES)]),
                    100
                    * np.array(
                        [
                            found["clean", 0.0]["turned"],
                            *(found[kind, s]["turned"] for s in _SHARES),
                        ]
                    ),
                )
                for kind in ("specks", "speckle")
            },
        )
    caption = "Estimates of disturbed clouds"
    frames = options.frames or FRAMES
    return Report(
        title="Robustness: stray points, loose masks, few points",
        tables=[Table(caption, _HEADER, rows, 2)],
        facts=[
            f"{frames} generated frames per category, of instances that training never saw",
            "specks: points anywhere in a ball of 1.5 times the object's radius; speckle: points "
            "moved along their rays, by a fifth of the radius on average; points: so many that "
            "differ; mask rim: too wide by 1.5 to 8 % of the object's width, on table and wall",
            f"inside: share of truths in the regions stated to hold {100 * COVERAGE:.0f} %, all "
            "parts and joints together",
        ],
        result={"categories": result},
        curves=curves,
    )


def _label(kind: str, amount: float) -> str:
    if kind in ("clean", "mask rim"):
        return kind
    return f"{amount:g} points" if kind == "points" else f"{100 * amount:g} % {kind}"


def _texts(row: dict[str, float]) -> list[str]:
    shares = ("turned", "rotation_inside", "translation_inside", "state_inside", "implausible")
    return [number(row["root_deg"], 2), *(number(row[key], 1, 100.0) for key in shares)]


def predict(estimator: Estimator, clouds: np.ndarray) -> Any:
    """``Prediction`` of clouds [B, N, 3] as numpy arrays, in batches of one size."""
    count = len(clouds)
    padded = np.resize(clouds, (-(-count // BATCH) * BATCH, *clouds.shape[1:]))
    parts = [
        jax.device_get(estimator._jitted(estimator.variables, padded[start : start + BATCH]))
        for start in range(0, len(padded), BATCH)
    ]
    return jax.tree.map(lambda *arrays: np.concatenate(arrays)[:count], *parts)


def _measured(estimator: Estimator, batch: Batch, clouds: np.ndarray) -> dict[str, float]:
    """Errors of the root, and shares of truths inside the stated regions."""
    category = estimator.category
    found = predict(estimator, clouds)
    truth = jax.tree.map(np.asarray, nearer_symmetry(found.pose, batch.pose, category))
    errors = pose_errors(found.pose, truth, category)
    root = errors.rotation_deg[:, 0]
    state = np.abs(found.pose.joint_state - truth.joint_state)
    return {
        "root_deg": float(np.median(root)),
        "turned": float((root > FLIPPED_DEG).mean()),
        "rotation_inside": float(
            (errors.rotation_deg <= np.degrees(found.rotation_std) * RADIUS_3D).mean()
        ),
        "translation_inside": float(
            (errors.translation_m <= found.translation_std * RADIUS_3D).mean()
        ),
        "state_inside": float((state <= found.state_std * RADIUS_1D).mean()),
        "implausible": float(1.0 - found.plausible.mean()),
    }


def _plausibility(options: Options) -> Report:
    rows: list[list[str]] = []
    result: dict[str, Any] = {}
    models = find_models(options)
    known = find_models(replace(options, category=()))
    frames = {name: unseen_frames(model, options) for name, model in known.items()}
    for name, estimator in models.items():
        if "plausibility" not in estimator.variables["params"]:
            raise CaperError(f"{name}: the model has no classifier; run caper calibrate")
        rng = np.random.default_rng(options.seed)
        right = predict(estimator, frames[name].points).plausibility
        entry = {"right": {"implausible": float((right < 0.5).mean())}}
        for kind, clouds in _wrong(name, frames, estimator, rng):
            if not len(clouds):
                continue
            found = predict(estimator, clouds).plausibility
            entry[kind] = {
                "implausible": float((found < 0.5).mean()),
                "area": _area_under_roc(right, found),
            }
        result[name] = entry
        for kind, values in entry.items():
            area = number(values["area"], 3) if "area" in values else "-"
            rows.append([name, kind, number(values["implausible"], 1, 100.0), area])
    return Report(
        title="Plausibility: right objects and wrong ones",
        tables=[
            Table("Estimates that the model itself does not believe", _VERDICT_HEADER, rows, 2)
        ],
        facts=[
            f"{options.frames or FRAMES} generated frames per category, of instances that training "
            "never saw; as many or half as many of each kind of wrong ones",
            "the threshold calls 1 % of right objects of other frames implausible",
        ],
        result={"categories": result},
    )


def _wrong(
    name: str, frames: dict[str, Batch], estimator: Estimator, rng: np.random.Generator
) -> Iterator[tuple[str, np.ndarray]]:
    """(what they are, clouds) that are no whole object of the category in meters."""
    right = np.asarray(frames[name].points)
    half = max(len(right) // 2, 1)
    for factor in _FACTORS:
        yield f"{factor:g} times as large", np.float32(factor) * right[:half]
    others = [np.asarray(batch.points) for other, batch in frames.items() if other != name]
    if others:
        each = -(-len(right) // len(others))
        some = np.concatenate([clouds[:each] for clouds in others])
        yield "another category", some
        yield "two, one of another category", side_by_side(right[:half], some, rng)
    category = estimator.category
    boxes = np.asarray(category.mean_size), np.asarray(category.mean_center)
    low, high = (boxes[1] - boxes[0] / 2).min(0), (boxes[1] + boxes[0] / 2).max(0)
    diagonal = float(np.linalg.norm(high - low))
    yield "a wall", walls(half, right.shape[1], diagonal, rng)
    yield "two of the category", side_by_side(right[:half], right[half:], rng)
    labels = np.asarray(frames[name].labels)
    yield "a single part", single_parts(right, labels, category.num_parts, half, rng)


def _area_under_roc(right: np.ndarray, wrong: np.ndarray) -> float:
    """Chance that a right object scores higher than a wrong one; ties count half."""
    from scipy.stats import mannwhitneyu

    return float(mannwhitneyu(right, wrong).statistic / (len(right) * len(wrong)))
