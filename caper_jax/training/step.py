"""The training state, the step as a plain function, and the compiled step of the loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt

from caper_jax.config import BatchNormExtent
from caper_jax.training import memory, parallel
from caper_jax.training.optimizer import (
    Optimizer,
    ScalarLike,
    evaluation_weights,
    training_weights,
)

PyTree = Any

# loss_fn(params, model_state, batch, key, progress) -> (loss, (new_model_state, metrics))
LossFn = Callable[
    [PyTree, PyTree, PyTree, jax.Array, jax.Array],
    tuple[jax.Array, tuple[PyTree, dict[str, jax.Array]]],
]
# (loss_fn, has_aux=True) -> function of the same arguments -> ((loss, aux), gradients)
GradientTransform = Callable[..., Callable[..., Any]]

_DATA_STREAM, _LOSS_STREAM = 0, 1


@flax.struct.dataclass
class TrainState:
    """All that a run needs to continue as if it had never stopped.

    Attributes:
      step: [] int32 steps attempted.
      params: weights as the optimizer keeps them (``LookaheadParams`` under Ranger).
      model_state: mutable collections of the network (``{"batch_stats": ...}``), {} if none.
      opt_state: optimizer state.
      skipped: [] int32 steps left out because the loss or a gradient was not finite.
      seed: [] uint32 from which every random key of the run follows.
      elapsed: [] float32 seconds of training, summed over resumes.

    A leading axis on all of them makes it a stack of states, as ``jax.vmap`` takes and gives it.
    """

    step: Int[Array, "*batch"]
    params: PyTree
    model_state: PyTree
    opt_state: PyTree
    skipped: Int[Array, "*batch"]
    seed: UInt[Array, "*batch"]
    elapsed: Float[Array, "*batch"]

    @classmethod
    def create(
        cls, variables: dict[str, PyTree], optimizer: Optimizer, seed: ScalarLike = 0
    ) -> TrainState:
        """The state before the first step.

        Args:
          variables: what the network's ``init`` returned: "params" and mutable collections.
          optimizer: the optimizer of the run.
          seed: [] seed of the run, 0 <= seed < 2**32; may be traced, e.g. under vmap.
        """
        # Copies: the step donates its buffers, and the caller's variables must survive it.
        variables = jax.tree.map(jnp.array, dict(variables))
        params, opt_state = optimizer.init(variables.pop("params"))
        return cls(
            step=jnp.zeros((), jnp.int32),
            params=params,
            model_state=variables,
            opt_state=opt_state,
            skipped=jnp.zeros((), jnp.int32),
            seed=jnp.asarray(seed, jnp.uint32),
            elapsed=jnp.zeros((), jnp.float32),
        )

    @property
    def variables(self) -> dict[str, PyTree]:
        """Variables to evaluate and to export: the slow weights and the mutable collections."""
        return {"params": evaluation_weights(self.params), **self.model_state}


def data_key(seed: ScalarLike, step: ScalarLike) -> jax.Array:
    """Key of a step's batch: a function of seed and step only, so that resumes see the same."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), step), _DATA_STREAM)


def loss_key(seed: ScalarLike, step: ScalarLike) -> jax.Array:
    """Key of a step's loss, likewise."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), step), _LOSS_STREAM)


def train_step(
    state: TrainState,
    batch: PyTree,
    progress: ScalarLike = 0.0,
    factor: ScalarLike = 1.0,
    *,
    loss_fn: LossFn,
    optimizer: Optimizer,
    value_and_grad: GradientTransform = jax.value_and_grad,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One step on one batch: a pure function, to be jitted, vmapped, scanned or nested at will.

    A step whose loss or gradient is not finite leaves weights, optimizer and model state as they
    were, counts in ``skipped`` and reports ``applied`` = 0. Random numbers of the loss follow from
    ``state.seed`` and ``state.step``.

    Args:
      state: the state; under vmap of several seeds, rates or loss weights a stack of states.
      batch: what ``loss_fn`` takes.
      progress: fraction of the run that is done, passed to ``loss_fn``.
      factor: of the learning rate in this step, see ``optimizer.flat_and_anneal``.
      loss_fn: ``(params, model_state, batch, key, progress) -> (loss, (new_model_state,
        metrics))``, e.g. an ``Objective``; metrics are scalars by name.
      optimizer: the optimizer; its numbers may be traced.
      value_and_grad: ``memory.value_and_grad`` holds less memory at once.

    Returns:
      (new state, metrics), among them "loss", "gradient_norm" (before clipping) and "applied".

    Example:
      step = jax.jit(partial(train_step, loss_fn=objective, optimizer=optimizer))
      state, metrics = step(state, batch)
    """
    key = loss_key(state.seed, state.step)
    (loss, (model_state, metrics)), gradients = value_and_grad(loss_fn, has_aux=True)(
        training_weights(state.params), state.model_state, batch, key, progress
    )
    norm = jnp.sqrt(sum(jnp.sum(jnp.square(g)) for g in jax.tree.leaves(gradients)))
    # The norm is finite only if every gradient is; the model state may break on its own.
    applied = jnp.isfinite(loss) & jnp.isfinite(norm) & all_finite(model_state)
    params, opt_state = optimizer.update(gradients, state.opt_state, state.params, factor)

    def keep(new: PyTree, old: PyTree) -> PyTree:
        return jax.tree.map(lambda n, o: jnp.where(applied, n, o), new, old)

    new = dataclasses.replace(
        state,
        step=state.step + 1,
        params=keep(params, state.params),
        model_state=keep(model_state, state.model_state),
        opt_state=keep(opt_state, state.opt_state),
        skipped=state.skipped + jnp.where(applied, 0, 1),
    )
    return new, {**metrics, "loss": loss, "gradient_norm": norm, "applied": applied}


def draw_batch(
    key: jax.Array,
    data: PyTree,
    batch_fn: Callable[..., PyTree] | None,
    mesh: jax.sharding.Mesh | None,
) -> PyTree:
    """Inside jit: the batch of a step, see ``compile_step``; ``key`` is its data key."""
    batch = data
    if batch_fn is not None:
        batch = batch_fn(key) if data is None else batch_fn(key, data)
    return batch if mesh is None else parallel.constrain_batch(batch, mesh)


def compile_step(
    loss_fn: LossFn,
    optimizer: Optimizer,
    *,
    batch_fn: Callable[..., PyTree] | None = None,
    data_seed: int | None = None,
    mesh: jax.sharding.Mesh | None = None,
    batch_norm: BatchNormExtent = "global",
    save_memory: bool = True,
) -> Callable[..., tuple[TrainState, dict[str, jax.Array]]]:
    """The loop's dispatch: one or several ``train_step`` compiled into one call.

    Args:
      loss_fn: see ``train_step``.
      optimizer: the optimizer.
      batch_fn: ``(key) -> batch`` traced into the step, or ``(key, data) -> batch`` where the
        caller passes ``data``; every leaf leads with the batch axis. None: the caller passes a
        batch, used by each of the n steps.
      data_seed: the keys of ``batch_fn`` follow from it; None for the seed of the state.
      mesh: split the batch over this mesh's "data" axis; weights are replicated.
      batch_norm: "global": over a mesh too the step is that of the whole batch on one device.
        "local": losses, with the means in them, are those of each device's rows, averaged.
      save_memory: gradients by ``memory.value_and_grad``.

    Returns:
      ``run(state, progress, factor, data)``: the state is donated; ``progress`` and ``factor`` are
      [n], of n steps; ``data`` is the batch where there is no ``batch_fn``, else what ``batch_fn``
      takes besides the key (None for nothing). Returns the new state and the metrics [n] of each
      step.
    """

    def gradient(loss_fn: LossFn, has_aux: bool = True) -> Callable[..., Any]:
        transform = memory.value_and_grad if save_memory else jax.value_and_grad
        function = transform(loss_fn, has_aux=has_aux)
        if mesh is None or batch_norm == "global":
            return function
        return parallel.each_device(function, mesh)

    def one(state: TrainState, progress: jax.Array, factor: jax.Array, data: PyTree):
        key = data_key(state.seed if data_seed is None else data_seed, state.step)
        batch = draw_batch(key, data, batch_fn, mesh)
        return train_step(
            state,
            batch,
            progress,
            factor,
            loss_fn=loss_fn,
            optimizer=optimizer,
            value_and_grad=gradient,
        )

    device = jax.local_devices()[0] if mesh is None else mesh.devices.flat[0]
    options: dict[str, Any] = {"compiler_options": compiler_options(device.platform)}
    if mesh is not None:
        everywhere = parallel.replicated(mesh)
        given = everywhere if batch_fn is not None else parallel.batch_sharding(mesh)
        options["in_shardings"] = (everywhere, everywhere, everywhere, given)
        options["out_shardings"] = everywhere
    return jax.jit(in_turn(one), donate_argnums=0, **options)


def in_turn(one: Callable[..., tuple[PyTree, PyTree]]) -> Callable[..., tuple[PyTree, PyTree]]:
    """``run(state, progress, factor, data)`` of n steps, from one: see ``compile_step``."""

    def run(state: PyTree, progress: jax.Array, factor: jax.Array, data: PyTree = None):
        if progress.shape[0] == 1:  # no loop: XLA for CPU runs less of a loop's body in parallel
            state, metrics = one(state, progress[0], factor[0], data)
            return state, jax.tree.map(lambda x: x[None], metrics)
        return jax.lax.scan(lambda s, x: one(s, x[0], x[1], data), state, (progress, factor))

    return run


_LEAST_MEMORY = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}


def compiler_options(platform: str) -> dict[str, str] | None:
    """On a CPU: an order of operations that holds little at once.

    XLA's default there runs ahead in all branches to have work for many cores; on two it takes
    longer (a step of the paper preset by an eighth) and up to half as much memory again.
    """
    if platform != "cpu":
        return None
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options=_LEAST_MEMORY)()
    except jax.errors.JaxRuntimeError:  # a version of XLA that does not know it
        return None
    return _LEAST_MEMORY


def all_finite(tree: PyTree) -> jax.Array:
    """[] bool: every floating-point leaf is finite."""
    flags = [
        jnp.all(jnp.isfinite(x))
        for x in jax.tree.leaves(tree)
        if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)
    ]
    return jnp.all(jnp.stack(flags)) if flags else jnp.asarray(True)
