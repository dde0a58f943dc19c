"""A whole training run of one category: generator, networks, loop, validation, export."""

from __future__ import annotations

import hashlib
import math
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from caper_jax import categories
from caper_jax._version import __version__
from caper_jax.articulation.category import Category
from caper_jax.config import (
    PRESETS,
    RefinerConfig,
    RunConfig,
    TrainingConfig,
    preset,
    to_dict,
)
from caper_jax.data.loader import Loader
from caper_jax.data.readers import open_dataset
from caper_jax.data.types import Batch
from caper_jax.errors import CaperError
from caper_jax.estimator import network_of
from caper_jax.models.files import (
    CARD_FILE,
    WEIGHTS_FILE,
    flatten,
    read_card,
    read_model,
    unflatten,
    write_card,
    write_model,
)
from caper_jax.synthetic.frames import Generator
from caper_jax.training import fit_refiner, parallel
from caper_jax.training.calibration import add_calibration
from caper_jax.training.loop import FitResult, fit
from caper_jax.training.objective import Objective
from caper_jax.training.run_directory import CONFIG_FILE, STARTED_FROM
from caper_jax.training.step import TrainState

_FITTED = ("params/refiner/", "params/plausibility/")  # on the estimates of the stages
SAMPLE = 512  # frames that give the trivial predictor of the model card


def preset_of(directory: str | Path, category: str) -> RunConfig:
    """The run of the preset that a model is of, with the network of that model.

    A network with an encoder of one's own is trained as the fast preset is.

    Raises:
      CaperError: no model directory, a damaged card, or an unknown category.
    """
    network = network_of(read_card(directory), Path(directory))
    # The first preset with that encoder: "fast", not "ablation".
    names = {other.network.encoder: name for name, other in reversed(PRESETS.items())}
    config = preset(names.get(network.encoder, "fast"), category)
    return replace(
        config, network=network, data=replace(config.data, num_points=network.num_points)
    )


def train(
    config: RunConfig,
    directory: str | Path,
    initial: str | Path | None = None,
    category: Category | None = None,
) -> FitResult:
    """Trains, validates and writes a model directory; resumes when the directory holds the run.

    Args:
      config: the run.
      directory: gets config.json, metrics.jsonl, checkpoints/ and, once the budget is used up,
        weights.npz and model.json. The model of a run that had ended before stays as it is.
      initial: model directory whose weights the run starts from (its card is kept in the new
        one); by default the weights are random. A model of another category gives its encoders.
      category: the category itself, where it is not registered; files keep its name, and its
        model loads by ``load(category, directory)``.

    Raises:
      CaperError: see ``training.loop.fit``; an ``init_weight_average`` of no model of this
        category.

    Example:
      config = preset("fast", "box")
      train(replace(config, training=replace(config.training, minutes=30.0)), "runs/box")
    """
    given = config.category if category is None else category
    category = categories.get(config.category) if category is None else category
    config = replace(config, category=category.name)  # FILE.py:NAME may be spelled in many ways
    objective = Objective(category, config.network, config.loss)
    start = start_from(objective.init(jax.random.key(config.training.seed)), config, initial)
    description = describe(config, start.card)
    run = partial(
        fit,
        directory,
        loss_fn=objective,
        variables=start.variables,
        mesh=_mesh(config.training.batch_size),
        description=description,
    )
    if config.loader is None:
        result, draw_sample = _fit_generated(run, config, category)
    else:
        result, draw_sample = _fit_dataset(run, config, given)
    first = jax.process_index() == 0
    if result.finished and first and not is_complete(directory, int(result.state.step)):
        write_run(config, given, directory, result.state, draw_sample(), start)
    # The others wait: one that ends takes the run with it after some minutes.
    parallel.agree([0.0])
    return result


def write_run(
    config: RunConfig,
    category: str | Category,
    directory: str | Path,
    state: TrainState,
    sample: Batch,
    start: Start,
) -> None:
    """Writes the model of a run whose budget is used up, and fits what belongs to it.

    Args:
      config: the run.
      category: its name or itself, as ``categories.get`` takes both.
      directory: of the run, with its config.json.
      state: the last training state.
      sample: frames like those of training, for the card's trivial predictor.
      start: what the run started from.
    """
    card = _card(config, state, sample)
    if start.card is not None:
        card |= _with_origin(card, start.card)
    trained = jax.device_get(state.variables)
    if config.init_weight_average:
        trained = averaged(start.weights, trained, config.init_weight_average)
    write_model(directory, trained, card)
    if config.loader is None:  # of the weights as they are stored, and once they are
        _finish(config, category, directory)
    write_card(directory, {**read_card(directory), "complete": _digest(directory)})


@dataclass(frozen=True)
class Start:
    """What a run starts from: its variables; the card and the weights of another model, if any."""

    variables: Any
    card: dict[str, Any] | None = None
    weights: Any = None


def start_from(variables: Any, config: RunConfig, initial: str | Path | None) -> Start:
    """What a run starts from.

    Args:
      variables: random ones of the run's seed.
      config: the run.
      initial: model directory, or None.

    Raises:
      CaperError: a model of another network; an ``init_weight_average`` of no model of this
        category.
    """
    start, same = Start(variables), False
    if initial is not None:
        card, weights = read_model(initial)
        same = card.get("category") == config.category
        start = Start(initial_variables(variables, weights, initial, same), card, weights)
    if config.init_weight_average and not same:
        raise CaperError(
            f"init_weight_average = {config.init_weight_average} needs a model of "
            f"{config.category!r} to start from"
        )
    return start


def describe(config: RunConfig, card: dict[str, Any] | None) -> dict[str, Any]:
    """What config.json holds besides the training section; ``card`` of what the run starts from."""
    description = {name: part for name, part in to_dict(config).items() if name != "training"}
    return description if card is None else {**description, STARTED_FROM: card}


def is_complete(directory: str | Path, steps: int) -> bool:
    """Whether the directory has the model of its run after so many steps, and all it needs."""
    if not all((Path(directory) / name).is_file() for name in (CARD_FILE, WEIGHTS_FILE)):
        return False
    card = read_card(directory)
    run = card.get("complete"), card.get("steps")
    return run == (_digest(directory), steps)


def _digest(directory: str | Path) -> str:
    """Tells the run of a directory from others, by its configuration."""
    return hashlib.sha256((Path(directory) / CONFIG_FILE).read_bytes()).hexdigest()[:16]


def _finish(config: RunConfig, category: str | Category, directory: str | Path) -> None:
    """Adds to a model what is fitted on its own estimates: the refiner, then what tells
    whether they are plausible, then their uncertainty."""
    seed = config.training.seed
    refiner = config.network.refiner
    if refiner.width:
        arguments = (config.data, refiner.width, refiner.frames, seed)
        try:
            fit_refiner.add_refiner(directory, category, *arguments)
        except fit_refiner.UnreliableModel as error:  # a short run: usable as it is
            print(f"the refiner is not fitted: {error}", file=sys.stderr)
    if config.calibration_frames:
        add_calibration(directory, category, config.data, config.calibration_frames, seed)


def _fit_generated(
    run: Callable[..., FitResult], config: RunConfig, category: Category
) -> tuple[FitResult, Callable[[], Batch]]:
    """Trains on endless generated frames; also a function that draws some of them."""
    generator = Generator(category, config.data, split="train", seed=config.training.stream)
    batch_size = config.training.batch_size

    def batch_fn(key, bank):
        return generator.draw(key, batch_size, bank)

    result = run(config=config.training, batch_fn=batch_fn, data=generator.bank)
    return result, lambda: generator.batch(jax.random.key(config.training.stream), SAMPLE)


def _fit_dataset(
    run: Callable[..., FitResult], config: RunConfig, category: str | Category
) -> tuple[FitResult, Callable[[], Batch]]:
    """Trains on a dataset; also a function that reads some of its frames."""
    source = config.loader
    assert source is not None
    known: Any = category  # a name or the object itself, as ``categories.get`` takes both
    dataset = open_dataset(
        source.format,
        source.root,
        known,
        source.split,
        num_points=4 * config.network.num_points,  # every epoch picks others of them
    )
    arguments = (config.network.num_points, config.training.stream)
    with Loader(
        dataset,
        config.training.batch_size,
        *arguments,
        workers=source.workers,
        prefetch=source.prefetch,
        cache_gib=source.cache_gib,
    ) as loader:
        result = run(config=in_steps(config.training, len(dataset)), batches=loader)

    def draw_sample() -> Batch:
        size = min(SAMPLE, len(dataset))
        with Loader(dataset, size, *arguments, process=(0, 1), prefetch=0) as once:
            return once(0)

    return result, draw_sample


def in_steps(config: TrainingConfig, frames: int) -> TrainingConfig:
    """The same training, bounded by steps where it was by epochs of so many frames."""
    if config.epochs is None:
        return config
    steps = math.ceil(config.epochs * frames / config.batch_size)
    return replace(config, steps=steps, epochs=None)


def _mesh(batch_size: int) -> jax.sharding.Mesh | None:
    """All devices; in a single process as many as divide the batch, None for one."""
    devices = jax.devices()
    if jax.process_count() == 1:
        devices = devices[: math.gcd(batch_size, len(devices))]
    return parallel.data_mesh(devices) if len(devices) > 1 else None


def initial_variables(
    template: Any, stored: Any, directory: str | Path, same_category: bool
) -> Any:
    """Stored weights in the place of random ones; CaperError where they do not fit.

    A model of another category gives its encoders only: outputs of its heads would begin with that
    category's conventions, and from an axis that points the other way no gradient leads back. A
    model without a rotation classifier gets a new one. What was fitted on its estimates is left
    behind.
    """
    wanted, given = flatten(template), flatten(stored)
    given = {name: leaf for name, leaf in given.items() if not name.startswith(_FITTED)}
    new = {name for name in wanted if "/turn/" in name} - given.keys()
    taken = [n for n in wanted if (same_category and n not in new) or "/encoder/" in n]
    fits = all(name in given and np.shape(given[name]) == np.shape(wanted[name]) for name in taken)
    if not fits or (same_category and given.keys() != wanted.keys() - new):
        raise CaperError(
            f"{directory}: its weights are of another network than this run's; leave out the "
            "preset and the network settings, and the run has its"
        )
    return unflatten(wanted | {name: jnp.asarray(given[name], jnp.float32) for name in taken})


def averaged(start: Any, trained: Any, share: float) -> Any:
    """Weights of which ``share`` is what a run started from; those that are new stay as trained."""
    known, mixed = flatten(start), flatten(trained)
    for name in mixed.keys() & known.keys():
        mixed[name] = share * known[name].astype(np.float32) + (1 - share) * mixed[name]
    return unflatten(mixed)


def mean_pose(batch: Batch) -> dict[str, Any]:
    """The trivial predictor: means of the training distribution, JSON-ready.

    Returns:
      rotation [3][3] (chordal mean of the root's rotation), offset [3] (mean of root origin minus
      cloud mean, camera frame, meters), size, box_center, joint_axis, joint_pivot, joint_state.
    """
    pose = jax.tree.map(np.asarray, batch.pose)
    left, _, right = np.linalg.svd(pose.rotation[:, 0].astype(np.float64).mean(axis=0))
    sign = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    offset = pose.translation[:, 0] - np.asarray(batch.points).mean(axis=1)
    axis = pose.joint_axis.mean(axis=0)
    return {
        "rotation": (left @ sign @ right).tolist(),
        "offset": offset.mean(axis=0).tolist(),
        "size": pose.size.mean(axis=0).tolist(),
        "box_center": pose.box_center.mean(axis=0).tolist(),
        "joint_axis": (axis / np.linalg.norm(axis, axis=-1, keepdims=True)).tolist(),
        "joint_pivot": pose.joint_pivot.mean(axis=0).tolist(),
        "joint_state": pose.joint_state.mean(axis=0).tolist(),
    }


def _card(config: RunConfig, state: TrainState, sample: Batch) -> dict[str, Any]:
    """The card of both stages: what was trained on what, where, and for how long."""
    stages = replace(config, network=replace(config.network, refiner=RefinerConfig()))
    return {
        "category": config.category,
        "version": __version__,
        "run": to_dict(stages),
        "steps": int(state.step),
        "samples": int(state.step) * config.training.batch_size,
        "skipped_steps": int(state.skipped),
        "training_seconds": round(float(state.elapsed)),
        "hardware": _hardware(),
        "mean_pose": mean_pose(sample),
    }


def _with_origin(card: dict[str, Any], origin: dict[str, Any]) -> dict[str, Any]:
    """What the card of a model says about the one it started from, and of both together."""
    kept = ("category", "version", "commit", "steps", "samples", "training_seconds", "hardware")
    totals = {
        f"{key}_in_all": card[key] + origin.get(f"{key}_in_all", origin.get(key, 0))
        for key in ("samples", "training_seconds")
    }
    return {"started_from": {key: origin[key] for key in kept if key in origin}, **totals}


def _hardware() -> str:
    device = jax.devices()[0]
    kind = platform.processor() or platform.machine() if device.platform == "cpu" else ""
    return f"{jax.device_count()} x {device.device_kind} {kind}".strip()
