"""A map with a transpose of its own, against JAX's derivatives of the same map."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.models.encoders.neighbors import directional_max, neighbor_max
from caper_jax.models.layers import weights_first
from caper_jax.models.linear_map import linear_map

DIMENSIONS = (((2,), (0,)), ((), ()))
INPUTS = np.random.default_rng(0).normal(size=(2, 3, 4))
KERNEL = np.random.default_rng(1).normal(size=(4, 5))


def total(product, inputs, kernel):
    return jnp.sin(product(inputs, kernel)).sum()


def ours(inputs, kernel):
    return weights_first(inputs, kernel, DIMENSIONS)


TRANSFORMS = {
    "jacfwd": lambda f: jax.jacfwd(f, (0, 1)),
    "jacrev": lambda f: jax.jacrev(f, (0, 1)),
    "one argument": lambda f: jax.jacfwd(f, 1),
    "hessian": lambda f: jax.hessian(f, (0, 1)),
    "reverse over reverse": lambda f: jax.jacrev(jax.grad(f)),
    "forward over forward": lambda f: jax.jacfwd(jax.jacfwd(f, 1), 0),
    "vmap of grad": lambda f: lambda x, k: jax.vmap(jax.grad(f, (0, 1)), (0, None))(x[:, None], k),
    "vmap over kernels": lambda f: (
        lambda x, k: jax.vmap(jax.grad(f), (None, 0))(x, k[None] * x[0, 0, 0])
    ),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_derivatives_are_those_of_the_plain_product(name):
    transform = TRANSFORMS[name]
    with jax.enable_x64(True):
        got, expected = (
            jax.jit(transform(partial(total, product)))(INPUTS, KERNEL)
            for product in (ours, jnp.matmul)
        )
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-12), got, expected)


def test_reverse_mode_takes_the_transpose_that_was_given_also_in_batches():
    """A wrong one on purpose: it doubles what it should give, and forward mode never asks it."""

    @jax.custom_jvp
    def scaled(x, factor):
        return factor * x

    @scaled.defjvp
    def _scaled_jvp(primals, tangents):
        x, factor = primals
        change = linear_map(
            lambda kept, change: kept * change,
            lambda kept, cotangent: 2 * kept * cotangent,
            factor,
            tangents[0],
        )
        return scaled(x, factor), change

    x, factors = jnp.arange(3.0), jnp.array([3.0, 5.0])
    np.testing.assert_array_equal(jax.jacfwd(scaled)(x, 3.0), 3 * np.eye(3))
    np.testing.assert_array_equal(jax.jacrev(scaled)(x, 3.0), 6 * np.eye(3))
    each = jax.vmap(jax.grad(lambda x, factor: scaled(x, factor).sum()), (None, 0))(x, factors)
    np.testing.assert_array_equal(each, [[6] * 3, [10] * 3])
    # The transpose of a batched map; what is not batched gets the sum.
    _, pull = jax.vjp(
        lambda x: jax.vmap(jax.linearize(lambda y: scaled(y, 3.0), x)[1])(jnp.stack([x, x])), x
    )
    np.testing.assert_array_equal(pull(jnp.ones((2, 3)))[0], [12] * 3)
    many = jax.linear_transpose(
        lambda x: jax.vmap(lambda f: linear_map(jnp.multiply, lambda f, c: 2 * f * c, f, x))(
            factors
        ),
        x,
    )
    np.testing.assert_array_equal(many(jnp.ones((2, 3)))[0], [16] * 3)


def test_second_derivatives_of_the_reductions_over_neighbors():
    """Against differences of the gradient: of the product of supports and directions."""
    rng = np.random.default_rng(2)
    index = np.array([[[1, 2], [0, 2], [1, 0]]])
    direction, features = rng.normal(size=(1, 3, 2, 3)), rng.normal(size=(1, 3, 4))
    weights = rng.normal(size=(3, 4))

    def value(weights, features):
        kernel = directional_max(direction, index, features, weights)
        return (neighbor_max(kernel, index) ** 3).sum()

    with jax.enable_x64(True):
        features = jnp.asarray(features)
        gradient = jax.jit(jax.grad(value, 1))
        second = jax.jit(jax.jacfwd(jax.grad(value, 1), (0, 1)))(weights, features)
        step = 1e-6
        shift = rng.normal(size=weights.shape), rng.normal(size=features.shape)
        numerical = (
            gradient(weights + step * shift[0], features + step * shift[1])
            - gradient(weights - step * shift[0], features - step * shift[1])
        ) / (2 * step)
        along = sum(
            jnp.tensordot(part, change, change.ndim)
            for part, change in zip(second, shift, strict=True)
        )
    assert np.abs(numerical).max() > 1
    np.testing.assert_allclose(along, numerical, rtol=1e-6, atol=1e-8)
