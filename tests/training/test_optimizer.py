"""Ranger, AdamW and the schedule, against independent implementations in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from caper_jax.errors import CaperError
from caper_jax.training.optimizer import (
    Optimizer,
    adamw,
    centralize_gradients,
    evaluation_weights,
    flat_and_anneal,
    ranger,
    training_weights,
)

STEPS = 20


def problem(seed: int = 0):
    """Weights of mixed rank and one gradient tree per step, some of norm above the clip."""
    rng = np.random.default_rng(seed)
    shapes = {"kernel": (4, 3), "filter": (2, 3, 5), "bias": (3,), "scale": ()}
    params = {k: rng.normal(size=s) for k, s in shapes.items()}
    sizes = np.where(np.arange(STEPS) % 4 == 3, 9.0, 0.3)
    gradients = [{k: c * rng.normal(size=s) for k, s in shapes.items()} for c in sizes]
    factors = np.linspace(0.2, 1.0, STEPS)
    return params, gradients, factors


def clip(gradient, bound):
    norm = np.sqrt(sum((g**2).sum() for g in gradient.values()))
    return {k: g * min(1.0, bound / norm) for k, g in gradient.items()}


def ranger_reference(params, gradients, rates):
    """Loops over the published algorithms: RAdam (Alg. 2), GC (Eq. 1), Lookahead (Alg. 1)."""
    b1, b2, eps, k, alpha = 0.95, 0.999, 1e-5, 6, 0.5
    fast = {n: p.copy() for n, p in params.items()}
    slow = {n: p.copy() for n, p in params.items()}
    m = {n: np.zeros_like(p) for n, p in params.items()}
    v = {n: np.zeros_like(p) for n, p in params.items()}
    rho_inf = 2 / (1 - b2) - 1
    for t, (gradient, rate) in enumerate(zip(gradients, rates, strict=True), start=1):
        rho = rho_inf - 2 * t * b2**t / (1 - b2**t)
        for n, g in clip(gradient, 5.0).items():
            if g.ndim > 1:
                g = g.copy()
                for output in range(g.shape[-1]):
                    g[..., output] -= g[..., output].mean()
            m[n] = b1 * m[n] + (1 - b1) * g
            v[n] = b2 * v[n] + (1 - b2) * g**2
            step = m[n] / (1 - b1**t)
            if rho > 5:
                r = ((rho - 4) * (rho - 2) * rho_inf) / ((rho_inf - 4) * (rho_inf - 2) * rho)
                step = np.sqrt(r) * step / (np.sqrt(v[n] / (1 - b2**t)) + eps)
            fast[n] = fast[n] - rate * step
            if t % k == 0:
                slow[n] = slow[n] + alpha * (fast[n] - slow[n])
                fast[n] = slow[n].copy()
    return fast, slow


def adamw_reference(params, gradients, rates, decay):
    b1, b2, eps = 0.9, 0.999, 1e-8
    p = {n: x.copy() for n, x in params.items()}
    m = {n: np.zeros_like(x) for n, x in params.items()}
    v = {n: np.zeros_like(x) for n, x in params.items()}
    for t, (gradient, rate) in enumerate(zip(gradients, rates, strict=True), start=1):
        for n, g in clip(gradient, 5.0).items():
            m[n] = b1 * m[n] + (1 - b1) * g
            v[n] = b2 * v[n] + (1 - b2) * g**2
            step = m[n] / (1 - b1**t) / (np.sqrt(v[n] / (1 - b2**t)) + eps)
            p[n] = p[n] - rate * (step + (decay * p[n] if p[n].ndim > 1 else 0))
    return p


def run(optimizer, params, gradients, factors):
    """All steps in one scan, as traced factors."""

    def step(carry, given):
        return optimizer.update(given[0], carry[1], carry[0], given[1]), None

    @jax.jit
    def go(params):
        stacked = jax.tree.map(lambda *g: jnp.stack([jnp.asarray(x) for x in g]), *gradients)
        return jax.lax.scan(step, optimizer.init(params), (stacked, jnp.asarray(factors)))[0][0]

    return go(jax.tree.map(jnp.asarray, params))


def assert_close(got, wanted, tolerance):
    for name in wanted:
        np.testing.assert_allclose(got[name], wanted[name], rtol=0, atol=tolerance, err_msg=name)


def test_ranger_equals_the_published_algorithm():
    params, gradients, factors = problem()
    fast, slow = ranger_reference(params, gradients, 0.05 * factors)
    with jax.enable_x64(True):
        got = run(Optimizer("ranger", learning_rate=0.05), params, gradients, factors)
    assert_close(training_weights(got), fast, 1e-10)
    assert_close(evaluation_weights(got), slow, 1e-10)
    # 20 steps end between two synchronizations: the two sets of weights must differ.
    assert not np.allclose(fast["kernel"], slow["kernel"], atol=1e-3)


def test_ranger_in_float32_stays_near_the_published_algorithm():
    params, gradients, factors = problem(1)
    fast, slow = ranger_reference(params, gradients, 0.05 * factors)
    got = run(Optimizer("ranger", learning_rate=0.05), params, gradients, factors)
    assert got.fast["kernel"].dtype == jnp.float32
    assert_close(training_weights(got), fast, 1e-3)
    assert_close(evaluation_weights(got), slow, 1e-3)


def test_adamw_equals_the_published_algorithm():
    params, gradients, factors = problem(2)
    optimizer = Optimizer("adamw", learning_rate=0.05, weight_decay=0.1)
    with jax.enable_x64(True):
        got = run(optimizer, params, gradients, factors)
    assert_close(got, adamw_reference(params, gradients, 0.05 * factors, 0.1), 1e-10)


def test_gradients_are_centered_over_all_axes_but_the_output():
    rng = np.random.default_rng(3)
    gradient = {"kernel": rng.normal(size=(5, 4, 3)) + 7, "bias": rng.normal(size=3) + 7}
    transformation = centralize_gradients()
    got, _ = transformation.update(gradient, transformation.init(gradient))
    np.testing.assert_allclose(np.mean(got["kernel"], axis=(0, 1)), 0, atol=1e-5)
    assert np.abs(np.mean(got["kernel"], axis=(1, 2))).max() > 1e-2
    np.testing.assert_array_equal(got["bias"], gradient["bias"])


def test_fast_and_slow_weights_are_separate_buffers():
    """Guards against donating one buffer twice, as ``LookaheadParams.init_synced`` would."""
    optimizer = Optimizer("ranger")
    params, state = optimizer.init({"w": jnp.ones(3)})
    step = jax.jit(
        lambda p, s: optimizer.update({"w": jnp.ones(3)}, s, p, 1.0), donate_argnums=(0, 1)
    )
    params, _ = step(params, state)
    assert isinstance(params, optax.LookaheadParams)
    np.testing.assert_array_equal(evaluation_weights(params)["w"], np.ones(3))


def test_a_zero_rate_leaves_the_weights_alone():
    params, gradients, _ = problem()
    start, gradient = jax.tree.map(lambda x: np.asarray(x, np.float32), (params, gradients[0]))
    for transformation, weights in (
        (ranger(0.0), optax.LookaheadParams(fast=start, slow=start)),
        (adamw(0.0, weight_decay=0.5), start),
    ):
        updates, _ = transformation.update(gradient, transformation.init(weights), weights)
        assert all(not np.any(u) for u in jax.tree.leaves(updates))


def test_schedule_warms_up_stays_flat_and_anneals_to_zero():
    assert flat_and_anneal(0.0, 0, 1000) == pytest.approx(0.001)
    assert flat_and_anneal(0.1, 500, 1000) == pytest.approx(0.5005)
    assert flat_and_anneal(0.3, 1000, 1000) == 1.0
    assert flat_and_anneal(0.72, 5000, 1000) == 1.0
    assert flat_and_anneal(0.86, 5000, 1000) == pytest.approx(0.5)
    assert flat_and_anneal(1.0, 9000, 1000) == pytest.approx(0.0, abs=1e-12)
    assert flat_and_anneal(1.3, 9000, 1000) == pytest.approx(0.0, abs=1e-12)
    assert flat_and_anneal(0.0, 0, 0) == 1.0
    falling = flat_and_anneal(np.linspace(0.72, 1.0, 50), np.arange(50) + 5000, 0)
    assert np.all(np.diff(falling) < 0)


def test_an_unknown_optimizer_is_named():
    with pytest.raises(CaperError, match="did you mean 'ranger'"):
        Optimizer("rangr").init({"w": jnp.ones(3)})
