"""Running means of exported weights, against the recursion in numpy float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.config import TrainingConfig
from caper_jax.training import parallel
from caper_jax.training.checkpoints import Checkpoints
from caper_jax.training.loop import fit
from caper_jax.training.optimizer import Optimizer
from caper_jax.training.statistics import compile_statistics, with_own_statistics
from caper_jax.training.step import TrainState, data_key, loss_key

BATCH, MOMENTUM, LAST = 8, 0.9, 100


def batch_fn(key):
    return {"x": jax.random.normal(key, (BATCH, 3))}


def loss_fn(params, model_state, batch, key, progress):
    """Batch norm of one layer, after noise that stands for dropout."""
    noise = 0.1 * jax.random.normal(key, batch["x"].shape)
    hidden = (batch["x"] + noise) @ params["kernel"]
    now = {"mean": hidden.mean(0), "var": hidden.var(0)}
    kept = jax.tree.map(
        lambda old, new: MOMENTUM * old + (1 - MOMENTUM) * new, model_state["batch_stats"], now
    )
    normed = (hidden - now["mean"]) / jnp.sqrt(now["var"] + 1e-5)
    return jnp.mean((normed - jnp.sin(batch["x"])) ** 2), ({"batch_stats": kept}, {})


def variables():
    kernel = np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)
    stats = {"mean": np.zeros(3, np.float32), "var": np.ones(3, np.float32)}
    return {"params": {"kernel": kernel}, "batch_stats": stats}


def recursion(kernel, start, steps, seed, skipped=()):
    """Statistics after running a kernel over the batches of some steps."""
    found = {name: np.asarray(value, np.float64) for name, value in start.items()}
    for step in steps:
        if step in skipped:
            continue
        batch = np.asarray(batch_fn(data_key(seed, step))["x"], np.float64)
        key = loss_key(seed, step)
        noise = 0.1 * np.asarray(jax.random.normal(key, batch.shape), np.float64)
        hidden = (batch + noise) @ np.asarray(kernel, np.float64)
        for name, now in (("mean", hidden.mean(0)), ("var", hidden.var(0))):
            found[name] = MOMENTUM * found[name] + (1 - MOMENTUM) * now
    return found


def finished(step, seed=3):
    """A state whose fast weights are far from the slow ones."""
    state = TrainState.create(variables(), Optimizer("ranger"), seed)
    params = state.params._replace(fast=jax.tree.map(lambda x: 5 * x, state.params.fast))
    return state.replace(step=jnp.int32(step), params=params)


@pytest.mark.parametrize("step", [7, 130])
def test_slow_weights_run_over_the_last_steps(step):
    state = finished(step)
    steps = range(max(step - LAST, 0), step)
    own = with_own_statistics(state, compile_statistics(loss_fn, batch_fn), lambda _: None)
    expected = recursion(state.params.slow["kernel"], variables()["batch_stats"], steps, 3)
    got = own.model_state["batch_stats"]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), got, expected)
    assert own.params is state.params and own.step == step

    over_devices = parallel.place(state, parallel.replicated(parallel.data_mesh()))
    run = compile_statistics(loss_fn, batch_fn, mesh=parallel.data_mesh())
    spread = with_own_statistics(over_devices, run, lambda _: None)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
        spread.model_state,
        own.model_state,
    )


def test_a_batch_that_is_not_finite_is_passed_over():
    def batches(step):
        batch = batch_fn(data_key(3, step))
        return {"x": batch["x"].at[0, 0].set(jnp.nan)} if step == 2 else batch

    state = finished(5)
    own = with_own_statistics(state, compile_statistics(loss_fn), batches)
    kernel, start = state.params.slow["kernel"], variables()["batch_stats"]
    expected = recursion(kernel, start, range(5), 3, skipped=(2,))
    got = own.model_state["batch_stats"]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), got, expected)


def test_one_set_of_weights_or_no_statistics_leave_the_state_alone():
    plain = TrainState.create(variables(), Optimizer("adamw"), 0).replace(step=jnp.int32(5))
    without = finished(5).replace(model_state={})
    for state in (plain, without):
        run = compile_statistics(loss_fn, batch_fn)
        assert with_own_statistics(state, run, lambda _: None) is state


def test_a_run_hands_back_the_statistics_of_what_it_exports(tmp_path):
    """The same whenever it is asked; the checkpoint keeps those that training goes on with."""
    config = TrainingConfig(
        batch_size=BATCH, learning_rate=0.05, warmup=0, steps=20, log_steps=10, seed=1
    )
    runs = [fit(tmp_path, config, loss_fn, variables(), batch_fn=batch_fn) for _ in range(2)]
    first, again = (run.state for run in runs)
    with Checkpoints(tmp_path / "checkpoints") as checkpoints:
        kept, _ = checkpoints.restore(first)
    start = kept.model_state["batch_stats"]
    expected = recursion(first.variables["params"]["kernel"], start, range(20), 1)
    got = first.variables["batch_stats"]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), got, expected)
    jax.tree.map(np.testing.assert_array_equal, again.variables, first.variables)
    assert np.abs(got["mean"] - start["mean"]).max() > 1e-3
