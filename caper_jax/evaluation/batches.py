"""Errors of whole batches on the device: several models and several sets of test data at once.

``frame_errors`` is the pure core: estimate and errors in one function, to be jitted, vmapped over
stacked weights or called inside a larger program. ``evaluate_models`` runs it over generated
frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial, reduce
from operator import and_
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import NetworkConfig
from caper_jax.data.types import Batch
from caper_jax.errors import CaperError
from caper_jax.estimator import estimate
from caper_jax.evaluation.metrics import (
    PoseErrors,
    unchecked_errors_up_to_symmetry,
    unchecked_pose_errors,
)
from caper_jax.progress import progress
from caper_jax.synthetic.frames import FRAMES_AT_A_TIME, Generator
from caper_jax.synthetic.instances import InstanceBank, split_key


def frame_errors(
    variables: dict[str, Any],
    batch: Batch,
    category: Category,
    network: NetworkConfig,
    up_to_symmetry: bool = False,
) -> PoseErrors:
    """Errors of a model's estimates of a batch: pure, in float32.

    Args:
      variables: as ``estimator.estimate`` takes them; vmap over stacked ones evaluates several
        models on one batch.
      batch: points [B, N, 3] with N as the network takes it, and their true poses.
      category: static.
      network: static.
      up_to_symmetry: static; against the nearer of the truths that the category declares
        equivalent.

    Returns:
      PoseErrors [B, K] and [B, J]; an estimate that is not finite scores
      ``metrics.FAILURE_VALUES``.
    """
    pose = estimate(variables, batch.points, category, network).pose
    compute = unchecked_errors_up_to_symmetry if up_to_symmetry else unchecked_pose_errors
    return compute(pose, batch.pose, category, ~is_finite(pose))


def is_finite(pose: ArticulatedPose) -> Bool[Any, " B"]:
    """[B]: whether all numbers of each pose [B, ...] are finite; numpy or JAX's arrays."""
    leaves = jax.tree.leaves(pose)
    return reduce(and_, ((abs(leaf) < np.inf).reshape(len(leaf), -1).all(-1) for leaf in leaves))


def evaluate_models(
    generator: Generator,
    category: Category,
    network: NetworkConfig,
    variables: dict[str, Any],
    frames: int,
    seeds: Sequence[int] = (0,),
    up_to_symmetry: bool = False,
) -> PoseErrors:
    """Errors of M models of one network on S sets of generated frames, all under one vmap.

    Frames are drawn on the device, 25 of each seed at a time; those of a seed are the frames that
    ``caper generate`` writes for it, and every model sees the same ones. Calls with the same
    generator and network, and as many models and seeds, compile once.

    Args:
      generator: draws the frames, of its split and of its instances.
      category: what the models were trained for, as ``estimator.estimate`` takes it.
      network: of all models.
      variables: of the models, every leaf stacked on a leading axis M.
      frames: F, of each seed.
      seeds: of the frames, S of them.
      up_to_symmetry: see ``frame_errors``.

    Returns:
      PoseErrors of numpy arrays [M, S, F, K] and [M, S, F, J], float32.

    Raises:
      CaperError: no frames, no seeds, another category or number of points than the generator's,
        or variables that are not stacked alike.
    """
    _check(generator, category, network, variables, frames, seeds)
    keys = jnp.stack([split_key(generator.split, seed) for seed in seeds])
    run = partial(
        _errors_of_draw,
        generator=generator,
        category=category,
        network=network,
        up_to_symmetry=up_to_symmetry,
    )
    parts = []
    with progress("evaluating", total=frames) as bar:
        for start in range(0, frames, FRAMES_AT_A_TIME):
            count = min(FRAMES_AT_A_TIME, frames - start)
            errors = jax.device_get(run(variables, keys, start, generator.bank))
            parts.append(jax.tree.map(lambda array, n=count: array[:, :, :n], errors))
            bar.update(count)
    return jax.tree.map(lambda *arrays: np.concatenate(arrays, axis=2), *parts)


# Static generators count by identity: another call with the same one compiles nothing.
@partial(jax.jit, static_argnames=("generator", "category", "network", "up_to_symmetry"))
def _errors_of_draw(
    variables: dict[str, Any],
    keys: Any,
    start: Any,
    bank: InstanceBank,
    generator: Generator,
    category: Category,
    network: NetworkConfig,
    up_to_symmetry: bool,
) -> PoseErrors:
    """Errors [M, S, 25, ...] of the frames from number ``start`` on of every seed."""

    def draw(key):
        return generator.draw(jax.random.fold_in(key, start), FRAMES_AT_A_TIME, bank)

    batch = jax.vmap(draw)(keys)
    # Seeds are frames like all others: one long batch is faster than another vmap.
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)
    errors = jax.vmap(lambda one: frame_errors(one, flat, category, network, up_to_symmetry))(
        variables
    )
    return jax.tree.map(
        lambda leaf: leaf.reshape(len(leaf), len(keys), FRAMES_AT_A_TIME, *leaf.shape[2:]), errors
    )


def _check(generator, category, network, variables, frames, seeds) -> None:
    """Raises CaperError, see ``evaluate_models``."""
    if frames < 1 or not len(seeds):
        raise CaperError(f"nothing to evaluate: {frames} frames of {len(seeds)} seeds")
    if generator.category.name != category.name:
        raise CaperError(
            f"the generator draws {generator.category.name!r}, the models know {category.name!r}"
        )
    if generator.config.num_points != network.num_points:
        raise CaperError(
            f"the generator draws {generator.config.num_points} points per frame, the networks "
            f"see {network.num_points}: give it GeneratorConfig(num_points={network.num_points})"
        )
    counts = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(variables)}
    if len(counts) != 1 or counts == {()}:
        raise CaperError(
            "variables must be stacked on a leading axis, of one length in every leaf, got "
            f"{sorted(counts)}; stack with jax.tree.map(lambda *v: jnp.stack(v), *models)"
        )
