"""Batch norm's statistics of the weights that a run exports.

Ranger differentiates at its fast weights and exports its slow ones. The running means and variances
that training keeps are those of the fast weights' activations; here they are taken again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.progress import progress
from caper_jax.training import parallel
from caper_jax.training.optimizer import evaluation_weights, training_weights
from caper_jax.training.step import (
    LossFn,
    TrainState,
    all_finite,
    data_key,
    draw_batch,
    loss_key,
)

PyTree = Any

# With the usual momentum of 0.9 the statistics of the fast weights have then lost their say.
_STEPS = 100

# (collections, weights, seed of the run, step, data of the step) -> collections
StatisticsStep = Callable[[PyTree, PyTree, jax.Array, jax.Array, PyTree], PyTree]


def with_own_statistics(
    state: TrainState, statistics: StatisticsStep, batch_of: Callable[[int], PyTree]
) -> TrainState:
    """The state with the mutable collections of its evaluation weights.

    Runs those weights, in training mode, over the batches of the last 100 steps of the run, with
    the random keys of these steps: the result is a function of the state and of the data alone.

    Args:
      state: at the end of a run, or a stack of such states. Returned as it is where the weights to
        train and to evaluate are the same, or there are no collections.
      statistics: from ``compile_statistics``.
      batch_of: data of a step, as ``step.compile_step``'s ``run`` takes them.
    """
    weights = evaluation_weights(state.params)
    if weights is training_weights(state.params) or not jax.tree.leaves(state.model_state):
        return state
    model_state, last = state.model_state, int(np.ravel(state.step)[0])
    steps = range(max(last - _STEPS, 0), last)
    with progress("statistics of the exported weights", total=len(steps)) as bar:
        for step in steps:
            number = jnp.int32(step)
            model_state = statistics(model_state, weights, state.seed, number, batch_of(step))
            bar.update(1)
    return dataclasses.replace(state, model_state=model_state)


def updated_statistics(
    model_state: PyTree,
    weights: PyTree,
    seed: jax.Array,
    step: jax.Array,
    batch: PyTree,
    loss_fn: LossFn,
) -> PyTree:
    """Collections after a batch in training mode.

    As in training, a batch whose loss or collections are not finite leaves them as they were.

    Args:
      model_state: collections.
      weights: that are evaluated.
      seed, step: [] of the run; give the key of the loss.
      batch: of the step.
      loss_fn: see ``step.train_step``.
    """
    key = loss_key(seed, step)
    loss, (new, _) = loss_fn(weights, model_state, batch, key, jnp.ones(()))
    applied = all_finite((loss, new))
    return jax.tree.map(lambda n, o: jnp.where(applied, n, o), new, model_state)


def compile_statistics(
    loss_fn: LossFn,
    batch_fn: Callable[..., PyTree] | None = None,
    data_seed: int | None = None,
    mesh: jax.sharding.Mesh | None = None,
) -> StatisticsStep:
    """``updated_statistics`` of the batch of a step, jitted.

    Args:
      loss_fn, batch_fn, data_seed, mesh: see ``step.compile_step``; over a mesh too the statistics
        are those of the whole batch.
    """

    def one(model_state: PyTree, weights: PyTree, seed: jax.Array, step: jax.Array, data: PyTree):
        key = data_key(seed if data_seed is None else data_seed, step)
        batch = draw_batch(key, data, batch_fn, mesh)
        return updated_statistics(model_state, weights, seed, step, batch, loss_fn)

    return jax.jit(one, out_shardings=None if mesh is None else parallel.replicated(mesh))
