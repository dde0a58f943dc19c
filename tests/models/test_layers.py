"""Layers are Flax's: the same weights and outputs, and wrong shapes are still noticed."""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.tiny import random_like
from flax.errors import FlaxError

from caper_jax.config import FastEncoderConfig
from caper_jax.errors import CaperError
from caper_jax.models.encoders.fast import FastEncoder
from caper_jax.models.layers import BatchNorm, Dense, Weights, max_over_points

POINTS = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)


class Ours(Weights, nn.Module):
    @nn.compact
    def __call__(self, x):
        scale = self.param("scale", nn.initializers.uniform(), (3,))
        return BatchNorm(use_running_average=True)(Dense(5)(x * scale))


class Flax(nn.Module):
    @nn.compact
    def __call__(self, x):
        scale = self.param("scale", nn.initializers.uniform(), (3,))
        return nn.BatchNorm(use_running_average=True)(nn.Dense(5)(x * scale))


def test_weights_and_outputs_are_those_of_flax():
    one, other = (jax.jit(m.init_with_output)(jax.random.key(0), POINTS) for m in (Ours(), Flax()))
    jax.tree.map(np.testing.assert_array_equal, one, other)
    variables = one[1]
    np.testing.assert_array_equal(Ours().apply(variables, POINTS), Flax().apply(variables, POINTS))


def test_shapes_without_a_key():
    module = Ours()
    with_key = jax.eval_shape(module.init, jax.random.key(0), POINTS)
    apply = partial(module.apply, mutable=["params", "batch_stats"])
    assert jax.eval_shape(apply, {}, POINTS)[1] == with_key


def test_a_wrong_shape_is_named():
    variables = jax.jit(Ours().init)(jax.random.key(0), POINTS)
    variables["params"]["Dense_0"]["kernel"] = np.zeros((4, 5), np.float32)
    with pytest.raises(CaperError, match=r"Dense_0/kernel has shape \(4, 5\).* \(3, 5\)"):
        Ours().apply(variables, POINTS)


def test_missing_weights_are_not_made_up():
    with pytest.raises(FlaxError):
        Ours().apply({"params": {}}, POINTS)


def test_products_of_wide_layers_round_their_factors_where_asked_to():
    rng = np.random.default_rng(2)
    for width, rounded in ((3, False), (128, True)):
        points = rng.normal(size=(50, width)).astype(np.float32)
        layer = Dense(7)
        variables = jax.jit(layer.init)(jax.random.key(0), points)
        kernel = np.asarray(variables["params"]["kernel"])
        plain = layer.apply(variables, points)
        with jax.default_matmul_precision("bfloat16"):
            found = layer.apply(variables, points)
        factors = [a.astype(jnp.bfloat16).astype(np.float64) for a in (points, kernel)]
        expected = factors[0] @ factors[1] if rounded else plain
        np.testing.assert_allclose(found, expected, atol=1e-5)
        assert found.dtype == np.float32
        assert (np.abs(found - plain).max() > 1e-4) == rounded


def test_maximum_over_points_has_the_value_and_slopes_of_jax():
    """Also where entries are equal, and in forward mode; a NaN is passed on."""
    rng = np.random.default_rng(3)
    features = np.maximum(rng.normal(size=(2, 6, 5)), 0.0).astype(np.float32)
    features[0, :, 0], features[1, :, 1] = 0.0, np.round(features[1, :, 1])
    weights = rng.normal(size=(2, 5)).astype(np.float32)
    change = rng.normal(size=features.shape).astype(np.float32)

    def plain(features):
        return features.max(axis=1)

    found, expected = (
        (
            *jax.jvp(function, (features,), (change,)),
            jax.grad(lambda x, f=function: (weights * f(x)).sum())(features),
        )
        for function in (max_over_points, plain)
    )
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    features[0, 2, 3] = np.nan
    value, slope = jax.jvp(max_over_points, (features,), (features,))
    np.testing.assert_array_equal(np.argwhere(np.isnan(value)), [[0, 3]])
    np.testing.assert_array_equal(np.argwhere(np.isnan(slope)), [[0, 3]])


def test_slopes_are_finite_where_the_compiler_rounds_maxima_twice():
    """Unoptimized, XLA computes the features once for their maximum and again for its slope."""
    config = FastEncoderConfig(16, 16, scales=(0.2, 0.4), width=8, blocks=1, last=8)
    encoder = FastEncoder(config)
    points = np.random.default_rng(4).normal(size=(1, 64, 3)).astype(np.float32)
    shapes = jax.eval_shape(partial(encoder.init, train=False), jax.random.key(0), points)
    variables = random_like(shapes, seed=5)

    def total(params, points):
        features = encoder.apply(variables | {"params": params}, points, train=False)
        return features.shared.sum() + features.levels[-1].features.sum()

    slopes, expected = (
        compiled(jax.grad(total, argnums=(0, 1)))(variables["params"], points)
        for compiled in (jax.jit, jax.jit)
    )
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-3), slopes, expected)
