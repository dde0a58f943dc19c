"""The training state and the compiled step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.config import BatchNormExtent
from caper_jax.training import parallel
from caper_jax.training.optimizer import Optimizer, evaluation_weights, training_weights

PyTree = Any

# loss_fn(params, model_state, batch, key, progress) -> (loss, (new_model_state, metrics))
LossFn = Callable[
    [PyTree, PyTree, PyTree, jax.Array, jax.Array],
    tuple[jax.Array, tuple[PyTree, dict[str, jax.Array]]],
]


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
    """

    step: jax.Array
    params: PyTree
    model_state: PyTree
    opt_state: PyTree
    skipped: jax.Array
    seed: jax.Array
    elapsed: jax.Array

    @classmethod
    def create(cls, variables: dict[str, PyTree], optimizer: Optimizer, seed: int) -> TrainState:
        """The state before the first step.

        Args:
          variables: what the network's ``init`` returned: "params" and mutable collections.
          optimizer: the optimizer of the run.
          seed: seed of the run, 0 <= seed < 2**32.
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
            seed=jnp.asarray(np.uint32(seed)),
            elapsed=jnp.zeros((), jnp.float32),
        )

    @property
    def variables(self) -> dict[str, PyTree]:
        """Variables to evaluate and to export: the slow weights and the mutable collections."""
        return {"params": evaluation_weights(self.params), **self.model_state}


def step_keys(seed: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(data key, loss key) of a step: a function of seed and step only, so resumes see the same."""
    key = jax.random.fold_in(jax.random.key(seed), step)
    return jax.random.fold_in(key, _DATA_STREAM), jax.random.fold_in(key, _LOSS_STREAM)


def make_step(
    loss_fn: LossFn,
    optimizer: Optimizer,
    *,
    batch_fn: Callable[..., PyTree] | None = None,
    mesh: jax.sharding.Mesh | None = None,
    batch_norm: BatchNormExtent = "global",
) -> Callable[..., tuple[TrainState, dict[str, jax.Array]]]:
    """Compile the training step.

    Several steps may share one dispatch: ``progress`` and ``factor`` are [n] and the step is
    scanned n times. A step whose loss or gradient is not finite leaves weights, optimizer and
    model state as they were, counts in ``skipped`` and reports ``applied`` = 0.

    Args:
      loss_fn: ``(params, model_state, batch, key, progress) -> (loss, (new_model_state,
        metrics))``; metrics are scalars by name.
      optimizer: the optimizer.
      batch_fn: ``(key) -> batch`` traced into the step, or ``(key, data) -> batch`` where the
        caller passes ``data``; every leaf leads with the batch axis. None: the caller passes a
        batch, used by each of the n steps.
      mesh: split the batch over this mesh's "data" axis; weights are replicated.
      batch_norm: "global": over a mesh too the step is that of the whole batch on one device.
        "local": losses, with the means in them, are those of each device's rows, averaged.

    Returns:
      ``run(state, progress, factor, data)``: the state is donated; ``data`` is the batch where
      there is no ``batch_fn``, else what ``batch_fn`` takes besides the key (None for nothing).
      Returns the new state and the metrics of each step: [n] arrays, among them "loss",
      "gradient_norm" (before clipping) and "applied".
    """

    gradient = jax.value_and_grad(loss_fn, has_aux=True)
    if mesh is not None and batch_norm == "local":
        gradient = parallel.each_device(gradient, mesh)

    def one(state: TrainState, progress: jax.Array, factor: jax.Array, data: PyTree):
        data_key, loss_key = step_keys(state.seed, state.step)
        if batch_fn is None:
            batch = data
        else:
            batch = batch_fn(data_key) if data is None else batch_fn(data_key, data)
        if mesh is not None:
            batch = parallel.constrain_batch(batch, mesh)

        weights = training_weights(state.params)
        (loss, (model_state, metrics)), gradients = gradient(
            weights, state.model_state, batch, loss_key, progress
        )
        norm = jnp.sqrt(sum(jnp.sum(jnp.square(g)) for g in jax.tree.leaves(gradients)))
        # The norm is finite only if every gradient is; the model state may break on its own.
        applied = jnp.isfinite(loss) & jnp.isfinite(norm) & _all_finite(model_state)

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

    def run(state: TrainState, progress: jax.Array, factor: jax.Array, data: PyTree = None):
        if progress.shape[0] == 1:  # no loop: XLA for CPU runs less of a loop's body in parallel
            state, metrics = one(state, progress[0], factor[0], data)
            return state, jax.tree.map(lambda x: x[None], metrics)
        return jax.lax.scan(lambda s, x: one(s, x[0], x[1], data), state, (progress, factor))

    device = jax.local_devices()[0] if mesh is None else mesh.devices.flat[0]
    options = _compiler_options(device.platform)
    if mesh is None:
        return jax.jit(run, donate_argnums=0, compiler_options=options)
    everywhere = parallel.replicated(mesh)
    given = everywhere if batch_fn is not None else parallel.batch_sharding(mesh)
    return jax.jit(
        run,
        donate_argnums=0,
        compiler_options=options,
        in_shardings=(everywhere, everywhere, everywhere, given),
        out_shardings=everywhere,
    )


_LEAST_MEMORY = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}


def _compiler_options(platform: str) -> dict[str, str] | None:
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


def _all_finite(tree: PyTree) -> jax.Array:
    """[] bool: every floating-point leaf is finite."""
    flags = [
        jnp.all(jnp.isfinite(x))
        for x in jax.tree.leaves(tree)
        if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)
    ]
    return jnp.all(jnp.stack(flags)) if flags else jnp.asarray(True)
