"""Neighborhoods and neighbor maxima: against numpy, finite differences and dense JAX."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.models.encoders.neighbors import (
    directional_max,
    directions,
    first_smallest,
    gather,
    nearest,
    nearest_row,
    neighbor_max,
    smallest_k,
    squared_distances,
)

B, N, K, C = 2, 12, 5, 3


def random(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def dense_squared_distances(a, b):
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return ((a[:, :, None] - b[:, None]) ** 2).sum(-1)


@pytest.mark.parametrize("channels", [3, 6])
def test_squared_distances(channels):
    a, b = random(2, 9, channels), random(2, 7, channels, seed=1)
    result = squared_distances(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(result, dense_squared_distances(a, b), rtol=1e-5, atol=1e-5)


def test_distances_of_points_are_exact_far_from_the_origin():
    a = (np.random.default_rng(0).integers(0, 512, (1, 20, 3)) / 1024 + 1000).astype(np.float32)
    assert (np.asarray(squared_distances(a, a)) == dense_squared_distances(a, a)).all()


def test_distances_of_features_are_never_negative():
    a = np.repeat(random(1, 10, 16) * 30, 2, axis=1)
    assert squared_distances(jnp.asarray(a), jnp.asarray(a)).min() >= 0


@pytest.mark.parametrize("channels", [3, 6])
@pytest.mark.parametrize("exclude_self", [False, True])
def test_nearest_is_argsort(channels, exclude_self):
    points = random(2, 40, channels)
    distance = dense_squared_distances(points, points)
    if exclude_self:
        distance[:, np.arange(40), np.arange(40)] = np.inf
    result = nearest(jnp.asarray(points), jnp.asarray(points), 7, exclude_self)
    assert result.dtype == jnp.int32
    np.testing.assert_array_equal(result, distance.argsort(-1, kind="stable")[..., :7])


def test_nearest_of_another_cloud():
    query, points = random(2, 15, 3), random(2, 30, 3, seed=1)
    order = dense_squared_distances(query, points).argsort(-1)
    np.testing.assert_array_equal(nearest(query, points, 4), order[..., :4])
    np.testing.assert_array_equal(nearest_row(query, points), order[..., 0])


@pytest.mark.parametrize("count", [4 * 8, 4 * 8 + 3])  # whole blocks, and not
@pytest.mark.parametrize("channels", [3, 6])
def test_neighbors_in_blocks_are_the_same(monkeypatch, channels, count):
    points, queries = random(2, count, channels), random(2, 11, channels, seed=1)
    points[:, 9] = points[:, 20]  # twins in different blocks

    def all_of(points, queries):
        return (
            nearest(points, points, 7, exclude_self=True),
            nearest(queries, points, 5),
            nearest_row(points, queries),
            nearest_row(queries, points),
        )

    at_once = jax.jit(all_of)(points, queries)
    monkeypatch.setattr("caper_jax.models.encoders.neighbors.BLOCK_ABOVE", 10)
    monkeypatch.setattr("caper_jax.models.encoders.neighbors._BLOCK", 8)
    in_blocks = jax.jit(lambda *clouds: all_of(*clouds))(points, queries)
    jax.tree.map(np.testing.assert_array_equal, in_blocks, at_once)

    def total(points):
        index = nearest(points, points, 7, exclude_self=True)
        return (directions(points, index) * jnp.arange(3)).sum()

    in_blocks = jax.jit(jax.grad(total))(points[..., :3])
    monkeypatch.undo()
    np.testing.assert_array_equal(in_blocks, jax.jit(jax.grad(lambda x: total(x)))(points[..., :3]))


def test_many_neighbors_take_no_square_of_memory():
    """Of 16,384 points: all distances at once would be 1 GiB."""
    points = jax.ShapeDtypeStruct((1, 16384, 3), jnp.float32)
    compiled = jax.jit(lambda x: nearest(x, x, 20, exclude_self=True)).lower(points).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 150e6
    assert " sort(" not in compiled.as_text()


def test_ties_go_to_the_lower_row():
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(1, 64, 3).astype(np.float32)
    distance = dense_squared_distances(grid, grid)
    order = distance.argsort(-1, kind="stable")
    np.testing.assert_array_equal(nearest(grid, grid, 10), order[..., :10])
    middle = grid[:, :5] + np.float32(0.5)
    np.testing.assert_array_equal(
        nearest_row(middle, grid), dense_squared_distances(middle, grid).argmin(-1)
    )


def test_a_repeated_point_is_a_neighbor_of_its_twin_but_never_of_itself():
    points = np.repeat(random(1, 10, 3), 2, axis=1)
    index = np.asarray(nearest(points, points, 3, exclude_self=True))[0]
    np.testing.assert_array_equal(index[:, 0], np.arange(20) ^ 1)
    same = np.ones((1, 20, 3), np.float32)
    index = np.asarray(nearest(same, same, 6, exclude_self=True))[0]
    assert (index != np.arange(20)[:, None]).all()
    assert all(len(set(row)) == 6 for row in index)


def test_nearest_does_not_sort():
    """top_k(k + 1)[1:], the obvious way to leave the point itself out, becomes a full sort."""
    points = jnp.zeros((2, 64, 8))

    def compiled(function):
        return jax.jit(function).lower(points).compile().as_text()

    assert " sort(" in compiled(partial(jnp.sort, axis=1))  # what a sort looks like
    assert " sort(" not in compiled(lambda x: nearest(x, x, 20, exclude_self=True))


@pytest.mark.parametrize("shape", [(4,), (4, 3)])
def test_gather_takes_rows_per_batch_element(shape):
    rows, index = random(2, 9, 5), np.random.default_rng(1).integers(0, 9, (2, *shape))
    expected = np.stack([rows[b][index[b]] for b in range(2)])
    np.testing.assert_array_equal(gather(jnp.asarray(rows), jnp.asarray(index)), expected)


def test_directions():
    points = random(2, 10, 3)
    points[:, 4] = points[:, 3]
    index = np.asarray(nearest(points, points, 4, exclude_self=True))
    result = np.asarray(directions(jnp.asarray(points), jnp.asarray(index)))
    for b in range(2):
        offset = points[b][index[b]] - points[b][:, None]
        length = np.linalg.norm(offset, axis=-1, keepdims=True)
        np.testing.assert_allclose(result[b], offset / np.where(length > 0, length, 1), atol=1e-6)
    assert index[0, 4, 0] == 3
    assert (result[0, 4, 0] == 0).all()


def difference_quotient(function, point, gradient, seed=5, step=1e-6):
    """(slope of ``function`` along a random direction, the same from its gradient)."""
    rng = np.random.default_rng(seed)
    toward = jax.tree.map(lambda values: rng.normal(size=np.shape(values)), point)
    ends = [
        function(jax.tree.map(lambda x, d, s=sign: x + s * step * d, point, toward))
        for sign in (1, -1)
    ]
    slopes = jax.tree.map(lambda g, d: (np.asarray(g) * d).sum(), gradient, toward)
    return (ends[0] - ends[1]) / (2 * step), sum(jax.tree.leaves(slopes))


def test_directions_have_finite_gradients_at_coincident_points():
    index = jnp.asarray([[[1, 2], [0, 3], [4, 5], [5, 1], [0, 1], [2, 0]]])

    @jax.jit
    def total(x, weights):
        return (directions(x, index) * weights).sum()

    gradient = jax.jit(jax.grad(total))
    with jax.enable_x64(True):
        points, weights = random(1, 6, 3).astype(np.float64), random(1, 6, 2, 3)
        slopes = difference_quotient(lambda x: total(x, weights), points, gradient(points, weights))
        np.testing.assert_allclose(*slopes, rtol=1e-6)

        points[0, 1] = points[0, 0]
        with_pair = gradient(points, weights)
        assert np.isfinite(with_pair).all()
        # The coincident pair (0 -> 1, 1 -> 0) adds no slope.
        weights[0, 0, 0] = weights[0, 1, 0] = 0
        np.testing.assert_allclose(with_pair, gradient(points, weights), atol=1e-12)


def dense_directional_max(direction, index, features, weights):
    """The maximum in the open: [B, N, k, C] at once."""
    theta = jax.nn.relu(jnp.einsum("bnki,ic->bnkc", direction, weights))
    if features is not None:
        theta = theta * jax.vmap(lambda rows, at: rows[at])(features, index)
    return theta.max(2)


def layer_inputs(seed=0, neighbors=K):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(B, N, neighbors, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    index = np.argsort(rng.random((B, N, N)), -1)[..., :neighbors]
    return direction, index, rng.normal(size=(B, N, C)), rng.normal(size=(3, C))


@pytest.mark.parametrize(("surface", "neighbors"), [(True, K), (False, K), (False, 1)])
def test_directional_max_and_its_gradients(surface, neighbors):
    direction, index, features, weights = layer_inputs(neighbors=neighbors)
    direction[0, 0, 0] = 0.0  # a coincident neighbor
    arguments = {"direction": direction, "weights": weights}
    if not surface:
        arguments["features"] = features
    cotangent = random(B, N, C, seed=3)

    def both(function, arguments):
        def total(arguments):
            value = function(index=jnp.asarray(index), **{"features": None, **arguments})
            return (value * cotangent).sum(), value

        return jax.value_and_grad(total, has_aux=True)(arguments)

    def ours(direction, index, features, weights):
        return directional_max(direction, index, features, weights)

    @jax.jit
    def compare(arguments):
        return both(ours, arguments), both(dense_directional_max, arguments)

    with jax.enable_x64(True):
        one, other = compare(arguments)
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-13), one, other)
        slopes = difference_quotient(lambda at: compare(at)[0][0][0], arguments, one[1])
        # The coincident neighbor stands on the kink of the relu.
        if neighbors > 1:
            np.testing.assert_allclose(*slopes, rtol=1e-6)


def test_slopes_have_the_types_of_what_they_belong_to():
    """Under 64-bit JAX points may be finer than weights."""
    rng = np.random.default_rng(0)
    index = rng.integers(0, 6, (2, 5, 4))
    direction = rng.normal(size=(2, 5, 4, 3))
    features, weights = (rng.normal(size=s).astype(np.float32) for s in ((2, 6, 7), (3, 7)))
    with jax.enable_x64(True):
        slopes = jax.grad(
            lambda d, f, w: directional_max(d, index, f, w).sum() + (f * w[0] * w[0]).sum(),
            (0, 1, 2),
        )(*map(jnp.asarray, (direction, features, weights)))
    assert [slope.dtype for slope in slopes] == [np.float64, np.float32, np.float32]


def test_directional_max_with_the_most_neighbors():
    """The winner's number is a uint8: the 256th neighbor still counts."""
    direction = np.tile(np.float32([0, 0, 0.5]), (1, 1, 256, 1))
    direction[0, 0, 255] = [0, 0, 1.0]
    weights = np.float32([[0], [0], [1]])
    features = np.arange(256, dtype=np.float32).reshape(1, 256, 1)
    index = np.arange(256)[None, None]
    total = jax.value_and_grad(lambda f: directional_max(direction, index, f, weights).sum())
    value, gradient = jax.jit(total)(features)
    assert value == 255.0
    assert gradient[0, 255, 0] == 1.0 and gradient.sum() == 1.0


def test_neighbor_max_and_its_gradient():
    _, index, features, _ = layer_inputs()
    index = index[:, : N // 2]  # fewer queries than rows, as in pooling
    index[0, 0] = 7  # the same row five times
    cotangent = random(B, N // 2, C, seed=3)

    def dense(features, index):
        return jax.vmap(lambda rows, at: rows[at])(features, index).max(2)

    def both(function, features):
        def total(features):
            value = function(features, jnp.asarray(index))
            return (value * cotangent).sum(), value

        return jax.value_and_grad(total, has_aux=True)(features)

    @jax.jit
    def compare(features):
        return both(neighbor_max, features), both(dense, features)

    with jax.enable_x64(True):
        one, other = compare(features)
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-14), one, other)
        slopes = difference_quotient(lambda at: compare(at)[0][0][0], features, one[1])
        np.testing.assert_allclose(*slopes, rtol=1e-6)


def test_a_tie_sends_its_gradient_to_one_winner():
    features = jnp.ones((1, 3, 1))
    index = jnp.asarray([[[2, 0, 1]]])
    direction = jnp.tile(jnp.asarray([0.0, 0.0, 1.0]), (1, 1, 3, 1))
    weights = jnp.asarray([[0.0], [0.0], [1.0]])
    reductions = (
        lambda f: neighbor_max(f, index).sum(),
        lambda f: directional_max(direction, index, f, weights).sum(),
    )
    for total in reductions:
        np.testing.assert_array_equal(jax.jit(jax.grad(total))(features)[0, :, 0], [0, 0, 1])


def test_vmap_equals_one_by_one():
    stacks = [np.stack(rows) for rows in zip(*(layer_inputs(seed) for seed in (1, 2)), strict=True)]
    direction, index, features, weights = (
        jnp.asarray(s, jnp.int32 if s.dtype.kind == "i" else jnp.float32) for s in stacks
    )

    def both(direction, index, features, weights):
        def total(direction, features, weights):
            value = directional_max(direction, index, features, weights)
            return (neighbor_max(value, index) ** 2).sum()

        return jax.value_and_grad(total, (0, 1, 2))(direction, features, weights)

    together = jax.jit(jax.vmap(both))(direction, index, features, weights)
    both = jax.jit(both)
    for i in range(2):
        alone = both(direction[i], index[i], features[i], weights[i])
        jax.tree.map(
            lambda many, one, i=i: np.testing.assert_allclose(many[i], one, rtol=1e-5, atol=1e-6),
            together,
            alone,
        )


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
