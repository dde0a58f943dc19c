"""Layers are Flax's: the same weights and outputs, and wrong shapes are still noticed."""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax
import numpy as np
import pytest
from flax.errors import FlaxError

from caper_jax.errors import CaperError
from caper_jax.networks.layers import BatchNorm, Dense, Weights

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
