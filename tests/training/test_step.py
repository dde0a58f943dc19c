"""``train_step`` is a plain function: jit, vmap, scan and nesting, and what a bad step leaves."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from _helpers.objectives import BOX, DEEP, THIN, frames
from _helpers.tiny import network, random_variables

from caper_jax.config import LossConfig, LossWeights
from caper_jax.training.objective import Objective
from caper_jax.training.optimizer import Optimizer
from caper_jax.training.step import TrainState, data_key, loss_key, train_step

SEEDS = jnp.arange(3, dtype=jnp.uint32)


def loss_fn(params, model_state, batch, key, progress, weight=1.0):
    noise = 0.01 * jax.random.normal(key, batch["x"].shape)
    error = jnp.tanh((batch["x"] + noise) @ params["kernel"] + params["bias"]) - batch["y"]
    mean = 0.9 * model_state["batch_stats"]["mean"] + 0.1 * batch["x"].mean(0)
    return weight * jnp.mean(error**2), ({"batch_stats": {"mean": mean}}, {"progress": progress})


def create(seed, optimizer=None):
    """A state whose weights follow from the seed, which may be traced."""
    params = {"kernel": jax.random.normal(jax.random.key(seed), (3, 3)), "bias": jnp.zeros(3)}
    variables = {"params": params, "batch_stats": {"mean": jnp.zeros(3)}}
    return TrainState.create(variables, optimizer or Optimizer(), seed)


def batch(seed=0):
    inputs = jax.random.normal(jax.random.key(seed), (8, 3))
    return {"x": inputs, "y": jnp.sin(inputs)}


PLAIN = partial(train_step, loss_fn=loss_fn, optimizer=Optimizer("ranger", 0.1))
STEP = jax.jit(PLAIN)  # the other transformations are compared with it


def assert_close(got, wanted):
    jax.tree.map(partial(np.testing.assert_allclose, rtol=2e-5, atol=1e-6), got, wanted)


def stacked(results):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *results)


def test_jit():
    state = create(0)
    after, metrics = STEP(state, batch(), 0.3)
    key = loss_key(state.seed, state.step)
    loss, _ = loss_fn(state.params.fast, state.model_state, batch(), key, 0.3)
    np.testing.assert_allclose(metrics["loss"], loss, rtol=1e-5)
    assert metrics["progress"] == np.float32(0.3) and after.step == 1
    assert np.abs(after.params.fast["kernel"] - state.params.fast["kernel"]).max() > 1e-3


def test_vmap_over_states_and_batches():
    states = stacked([create(seed) for seed in range(3)])
    batches = stacked([batch(seed) for seed in range(3)])
    got = jax.jit(jax.vmap(PLAIN))(states, batches)
    assert_close(got, stacked([STEP(create(seed), batch(seed)) for seed in range(3)]))


def test_vmap_over_seeds():
    """Weights and noise of a run follow from a seed that is traced."""
    got = jax.jit(jax.vmap(lambda seed: PLAIN(create(seed), batch())))(SEEDS)
    assert_close(got, stacked([STEP(create(seed), batch()) for seed in range(3)]))
    assert len({float(loss) for loss in got[1]["loss"]}) == 3


def test_vmap_over_learning_rates():
    @jax.jit
    def one(optimizer):
        return train_step(create(0, optimizer), batch(), loss_fn=loss_fn, optimizer=optimizer)

    rates, decays = jnp.array([0.01, 0.1]), jnp.array([0.0, 0.3])
    got = jax.vmap(one)(Optimizer("adamw", rates, jnp.full(2, 5.0), decays))
    pairs = zip((0.01, 0.1), (0.0, 0.3), strict=True)
    assert_close(got, stacked([one(Optimizer("adamw", r, 5.0, d)) for r, d in pairs]))


def test_scan_over_steps():
    factors, batches = jnp.array([1.0, 0.5, 0.25]), stacked([batch(n) for n in range(3)])
    got = jax.lax.scan(
        lambda state, given: PLAIN(state, given[0], 0.0, given[1]), create(0), (batches, factors)
    )
    state, metrics = create(0), []
    for number, factor in enumerate(factors):
        state, one = STEP(state, batch(number), 0.0, factor)
        metrics.append(one)
    assert_close(got, (state, stacked(metrics)))


def test_nesting_in_a_function_of_ones_own():
    """With a loop of steps in it, and a derivative through them by the learning rate."""

    @jax.jit
    def final_loss(rate):
        optimizer = Optimizer("adamw", rate)
        step = jax.jit(partial(train_step, loss_fn=loss_fn, optimizer=optimizer))
        state = create(0, optimizer)
        for _ in range(2):
            state, _ = step(state, batch())
        return step(state, batch())[1]["loss"]

    slope = jax.grad(final_loss)(0.05)
    expected = (final_loss(0.06) - final_loss(0.04)) / 0.02
    np.testing.assert_allclose(slope, expected, rtol=0.05)


def test_variants_of_the_objective_train_side_by_side():
    """Seeds, loss weights and learning rates at once."""
    sizes, cloud = network(pool_first=True), frames(BOX, [THIN, DEEP])
    variables = random_variables(BOX, sizes)

    def one(seed, twist, rate):
        weights = LossWeights(twist=twist)
        objective = Objective(BOX, sizes, LossConfig(weights=weights, root_noise_deg=twist))
        optimizer = Optimizer("adamw", rate)
        state = TrainState.create(variables, optimizer, seed)
        return train_step(state, cloud, loss_fn=objective, optimizer=optimizer)

    seeds, twists, rates = SEEDS[:2], jnp.array([1.0, 5.0]), jnp.array([1e-3, 1e-2])
    states, metrics = jax.jit(jax.vmap(one))(seeds, twists, rates)
    alone = jax.jit(one)
    for number in range(2):
        state, single = alone(seeds[number], twists[number], rates[number])
        np.testing.assert_allclose(metrics["loss"][number], single["loss"], rtol=1e-3)
        for got, wanted in zip(
            jax.tree.leaves(states.model_state), jax.tree.leaves(state.model_state), strict=True
        ):
            np.testing.assert_allclose(got[number], wanted, rtol=5e-3, atol=5e-3)
    assert metrics["loss"][0] != metrics["loss"][1] and metrics["applied"].all()


def test_a_step_without_a_finite_gradient_changes_nothing_but_the_counters():
    """The gradient of sqrt at 0 is not finite while the loss is; NaN data breaks both."""

    def rooted(params, model_state, batch, key, progress):
        loss, rest = loss_fn(params, model_state, batch, key, progress)
        return loss + jnp.sqrt(batch["root"] * (1 + jnp.sum(params["bias"]))), rest

    step = jax.jit(partial(train_step, loss_fn=rooted, optimizer=Optimizer(learning_rate=0.1)))
    good = {**batch(), "root": jnp.float32(1)}
    state, metrics = step(create(0), good)
    assert metrics["applied"] and state.skipped == 0
    for name, value in (("root", 0.0), ("x", jnp.nan), ("y", jnp.inf)):
        after, metrics = step(state, {**good, name: good[name] * 0 + value})
        assert not metrics["applied"] and np.isfinite(metrics["loss"]) == (name == "root")
        assert not np.isfinite(metrics["gradient_norm"])
        assert (after.step, after.skipped) == (state.step + 1, state.skipped + 1)
        for part in ("params", "opt_state", "model_state"):
            jax.tree.map(np.testing.assert_array_equal, getattr(after, part), getattr(state, part))
        state = after
    state, metrics = step(state, good)
    assert metrics["applied"] and (state.step, state.skipped) == (5, 3)


def test_keys_follow_from_seed_and_step_alone():
    keys = {
        jax.random.key_data(key).tobytes()
        for seed in (0, 1)
        for step in range(5)
        for key in (data_key(seed, step), loss_key(seed, step))
    }
    assert len(keys) == 20  # no two streams, steps or seeds share one
    again = loss_key(jnp.uint32(1), jnp.int32(4))
    assert jax.random.key_data(again).tobytes() in keys
