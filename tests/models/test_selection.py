"""The k smallest of each row: the same columns as a stable sort gives."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.models.encoders.selection import first_smallest, smallest_k


def random(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("columns", [20, 128, 129, 256, 1000, 1024, 2500])
def test_smallest_k_is_a_stable_sort(columns):
    values = random(2, 30, columns)
    values[:, 10:20] = np.round(2 * values[:, 10:20]) + 0.0  # many ties; no -0.0
    values[:, 20:, ::7] = np.inf
    values[:, 25:] = 1.0
    result = jax.jit(partial(smallest_k, k=13))(values)
    assert result.dtype == jnp.int32
    np.testing.assert_array_equal(result, values.argsort(-1, kind="stable")[..., :13])


def test_indices_stay_inside_whatever_the_values_are():
    values = random(1, 4, 300)
    values[0, 0, 5], values[0, 1], values[0, 2], values[0, 3] = np.nan, np.nan, np.inf, -np.inf
    result = np.asarray(jax.jit(partial(smallest_k, k=40))(values))
    assert ((result >= 0) & (result < 300)).all()
    assert (np.asarray(first_smallest(jnp.asarray(values))) < 300).all()


@pytest.mark.parametrize("axis", [-1, 1])
def test_first_smallest_is_argmin(axis):
    values = np.round(random(3, 12, 9)) + 0.0
    np.testing.assert_array_equal(first_smallest(jnp.asarray(values), axis), values.argmin(axis))


@pytest.mark.parametrize("columns", [100, 400])
def test_a_slice_of_the_result_does_not_sort(columns):
    """A slice of top_k becomes a full sort, twenty times as slow."""

    def sliced(values):
        return smallest_k(values, 20)[..., :4]

    values = jax.ShapeDtypeStruct((2, 64, columns), jnp.float32)
    assert " sort(" not in jax.jit(sliced).lower(values).compile().as_text()
