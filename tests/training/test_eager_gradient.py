"""Losses whose gradients come one after the other: the same numbers, less memory."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.models.layers import after, weights_first
from caper_jax.training.eager_gradient import value_with_eager_gradient


def layers(params, inputs):
    hidden = inputs
    for kernel in params:
        hidden = jnp.tanh(hidden @ kernel)
    return (hidden**2).sum(), hidden.mean(0)


def plain(params, inputs):
    one, mean = layers(params["one"], inputs)
    return one + layers(params["two"], inputs + mean)[0]


def staged(params, inputs):
    one, mean, done = value_with_eager_gradient(layers)(params["one"], inputs)
    return one + layers(params["two"], after(done, inputs + jax.lax.stop_gradient(mean)))[0]


def case(rows=8, width=6, depth=3):
    rng = np.random.default_rng(0)
    kernels = rng.normal(0, width**-0.5, (2, depth, width, width)).astype(np.float32)
    params = {
        name: list(map(jnp.asarray, one)) for name, one in zip(("one", "two"), kernels, strict=True)
    }
    return params, jnp.asarray(rng.normal(size=(rows, width)), jnp.float32)


def test_value_and_gradient_are_those_of_the_plain_sum():
    """Up to the path through what the first hands to the second, which is cut in both."""
    params, inputs = case()
    mean = layers(params["one"], inputs)[1]

    def cut(params):
        return layers(params["one"], inputs)[0] + layers(params["two"], inputs + mean)[0]

    value, slopes = jax.jit(jax.value_and_grad(staged))(params, inputs)
    assert value == pytest.approx(float(plain(params, inputs)), rel=1e-6)
    assert value == pytest.approx(float(staged(params, inputs)), rel=1e-6)  # no gradient asked for
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
        slopes,
        jax.grad(cut)(params),
    )


def test_the_gradient_follows_a_factor_in_front_of_the_loss():
    params, inputs = case()
    loss = value_with_eager_gradient(layers)
    slopes = jax.grad(lambda p: 3.0 * loss(p, inputs)[0])(params["one"])
    expected = jax.grad(lambda p: layers(p, inputs)[0])(params["one"])
    for slope, other in zip(slopes, expected, strict=True):
        np.testing.assert_allclose(slope, 3 * other, rtol=1e-5)


def test_a_first_gradient_that_is_not_finite_spoils_what_waits_for_it():
    params, inputs = case()
    broken = {**params, "one": [params["one"][0].at[0, 0].set(jnp.nan), *params["one"][1:]]}
    slopes = jax.grad(staged)(broken, inputs)
    assert np.isnan(slopes["two"][0]).any()
    assert np.isnan(after(jnp.inf, jnp.ones(3))).all()


def test_one_stage_is_forgotten_before_the_next_begins():
    params, inputs = case(rows=4096, width=64, depth=6)

    def megabytes(function, params):
        compiled = jax.jit(jax.grad(function)).lower(params, inputs).compile()
        return compiled.memory_analysis().temp_size_in_bytes / 1e6

    alone = megabytes(lambda params, inputs: layers(params, inputs)[0], params["one"])
    assert megabytes(plain, params) > 1.7 * alone
    assert megabytes(staged, params) < 1.3 * alone


@pytest.mark.parametrize(("wide", "narrow"), [(3, 4), (7, 2)], ids=["widening", "narrowing"])
def test_weights_first_is_a_product_with_its_gradients(wide, narrow):
    rng = np.random.default_rng(1)
    inputs, kernel = rng.normal(size=(2, 5, wide)), rng.normal(size=(wide, narrow))
    along = rng.random((2, 5, narrow))
    dimensions = (((2,), (0,)), ((), ()))
    with jax.enable_x64(True):
        value, pull = jax.vjp(lambda x, k: weights_first(x, k, dimensions), inputs, kernel)
        to_inputs, to_kernel = pull(jnp.asarray(along))
    np.testing.assert_allclose(value, inputs @ kernel, atol=1e-12)
    np.testing.assert_allclose(to_inputs, along @ kernel.T, atol=1e-12)
    np.testing.assert_allclose(to_kernel, np.einsum("bni,bno->io", inputs, along), atol=1e-12)
