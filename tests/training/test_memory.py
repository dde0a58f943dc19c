"""Gradients of both stages one after the other: the same numbers, less memory."""

from __future__ import annotations

from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.objectives import BOX, DEEP, THIN, frames
from _helpers.tiny import network, random_variables

from caper_jax.config import RotationClassifierConfig
from caper_jax.models.layers import after, weights_first
from caper_jax.training import memory
from caper_jax.training.objective import Objective


@flax.struct.dataclass
class Result:
    points: jax.Array


def layers(params, inputs):
    hidden = inputs
    for kernel in params:
        hidden = jnp.tanh(hidden @ kernel)
    return (hidden**2).sum(), hidden.mean(0)


class TwoStages:
    """Stacks of layers; the second sees the mean of what the first makes of the inputs."""

    def stage1(self, params, model_state, inputs, key):
        loss, mean = layers(params, inputs)
        return loss, Result(inputs + mean)

    def stage2(self, params, model_state, result, key):
        return layers(params, result.points)[0], ({}, {})

    def __call__(self, params, model_state, inputs, key, progress):
        first, result = self.stage1(params["root"], model_state, inputs, key)
        result = jax.lax.stop_gradient(result)
        second, rest = self.stage2(params["parts"], model_state, result, key)
        return first + second, rest


def case(rows=8, width=6, depth=3):
    rng = np.random.default_rng(0)
    kernels = rng.normal(0, width**-0.5, (2, depth, width, width)).astype(np.float32)
    params = {
        name: list(map(jnp.asarray, one))
        for name, one in zip(("root", "parts"), kernels, strict=True)
    }
    return params, jnp.asarray(rng.normal(size=(rows, width)), jnp.float32)


def gradient(transform, params, inputs):
    return transform(TwoStages(), has_aux=True)(params, {}, inputs, None, 0.0)


def assert_close(got, wanted, tolerance):
    jax.tree.map(partial(np.testing.assert_allclose, rtol=tolerance, atol=tolerance), got, wanted)


def test_value_and_gradient_are_those_of_the_plain_sum():
    given = case()
    assert_close(
        gradient(memory.value_and_grad, *given), gradient(jax.value_and_grad, *given), 1e-5
    )


def test_a_loss_without_stages_is_differentiated_as_it_is():
    value, slope = memory.value_and_grad(lambda x: (x**2, "aux"))(3.0)
    assert value == (9.0, "aux") and slope == 6.0


def test_a_first_gradient_that_is_not_finite_spoils_what_waits_for_it():
    params, inputs = case()
    params["root"][0] = params["root"][0].at[0, 0].set(jnp.nan)
    _, slopes = gradient(memory.value_and_grad, params, inputs)
    assert np.isnan(slopes["parts"][0]).any()
    assert np.isnan(after(jnp.asarray(jnp.inf), jnp.ones(3))).all()


def test_one_stage_is_forgotten_before_the_next_begins():
    params, inputs = case(rows=4096, width=64, depth=6)

    def megabytes(function):
        compiled = jax.jit(function).lower(params, inputs).compile()
        return compiled.memory_analysis().temp_size_in_bytes / 1e6

    alone = megabytes(
        lambda params, inputs: jax.grad(lambda p: layers(p, inputs)[0])(params["root"])
    )

    def coupled(params, inputs):
        """The same stages, differentiated through what the first hands to the second."""
        first, mean = layers(params["root"], inputs)
        return first + layers(params["parts"], inputs + mean)[0]

    assert megabytes(jax.grad(coupled)) > 1.7 * alone
    assert megabytes(partial(gradient, memory.value_and_grad)) < 1.3 * alone


def test_the_gradients_of_the_networks_are_the_same_with_and_without():
    config = RotationClassifierConfig(4)
    objective = Objective(BOX, network(pool_first=True, rotation_classifier=config))
    variables = random_variables(BOX, objective.network)
    state = {"batch_stats": variables["batch_stats"]}
    rest = (state, frames(BOX, [THIN, DEEP]), jax.random.key(1), 0.0)
    (one, gradients), (other, expected) = (
        jax.jit(transform(objective, has_aux=True))(variables["params"], *rest)
        for transform in (memory.value_and_grad, jax.value_and_grad)
    )
    assert_close(one, other, 1e-4)
    scale = max(np.abs(leaf).max() for leaf in jax.tree.leaves(expected))
    assert_close(*(jax.tree.map(lambda x: x / scale, tree) for tree in (gradients, expected)), 1e-4)


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
