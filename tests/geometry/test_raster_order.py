"""Scan order: what it is on a plain image, that it spreads points evenly, and is nearly free."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.geometry.raster_order import (
    from_raster_order,
    grid_raster_order,
    raster_order,
    to_raster_order,
)

on_host_and_device = pytest.mark.parametrize(
    "order_of",
    [raster_order, lambda points: np.asarray(jax.jit(raster_order)(jnp.asarray(points)))],
)


def facing(lines, distance=1.5):
    """A square wall across the view, [lines^2, 3] in raster order."""
    steps = (np.arange(lines) + 0.5) / lines - 0.5
    x, y = np.meshgrid(steps, steps, indexing="xy")
    wall = np.stack([x.ravel(), y.ravel(), np.ones(lines * lines)], axis=-1)
    return (distance * wall).astype(np.float32)


def spread(count=1024, seed=0):
    """A slope seen at random places, [count, 3]: even in the image, not in space."""
    rng = np.random.default_rng(seed)
    image = rng.uniform(-0.3, 0.3, (count, 2))
    depth = 1.0 + image.sum(1)
    return np.concatenate([image * depth[:, None], depth[:, None]], axis=1).astype(np.float32)


@on_host_and_device
@pytest.mark.parametrize("lines", [64, 96])
def test_rows_of_an_image_are_run_through_to_and_fro(order_of, lines):
    order = order_of(facing(lines)).astype(np.int64)
    row, column = np.divmod(order, lines)
    per_band = lines // 32
    bands = row.reshape(32, -1) // per_band
    np.testing.assert_array_equal(bands, np.repeat(np.arange(32)[:, None], per_band * lines, 1))
    for number, columns in enumerate(column.reshape(32, -1)):
        steps = np.diff(columns) * (-1 if number % 2 else 1)
        assert (steps >= 0).all() and (steps <= 1).all()
    np.testing.assert_array_equal(order, grid_raster_order(lines))


@on_host_and_device
def test_every_fourth_point_covers_the_image_evenly(order_of):
    """Of the points in each of 8 x 8 cells a fourth is due."""

    def in_cells(points):
        image = points[:, :2] / points[:, 2:]
        return np.histogram2d(*image.T, bins=8, range=[(-0.3, 0.3)] * 2)[0]

    def unevenness(points):
        return (in_cells(points[::4]) - in_cells(points) / 4).std()

    for seed in range(5):
        points = spread(seed=seed)
        random = unevenness(points)
        assert random > 1.3  # 1.7 is expected
        assert unevenness(points[order_of(points)]) < 0.7 * random
        points[3, 2] = 1e-4  # a pixel at the lens leaves the rest of the image as it was
        assert unevenness(points[order_of(points)]) < 0.7 * random


@on_host_and_device
def test_the_order_of_the_input_does_not_matter(order_of):
    points = spread()
    shuffled = np.random.default_rng(1).permutation(points)
    one, other = points[order_of(points)], shuffled[order_of(shuffled)]
    # Points in nearly the same place of the image may change places.
    assert (one == other).all(1).mean() > 0.98
    wall = facing(64)
    shuffled = np.random.default_rng(1).permutation(wall)
    np.testing.assert_array_equal(shuffled[order_of(shuffled)], wall[order_of(wall)])


@on_host_and_device
def test_it_is_a_permutation_whatever_the_cloud(order_of):
    rng = np.random.default_rng(0)
    clouds = (
        spread(17),
        np.ones((40, 3), np.float32),
        rng.normal(size=(3, 100, 3)).astype(np.float32),  # some behind the camera
        rng.normal(size=(2, 50, 3)).astype(np.float32) * [1e4, 1e-4, 1.0],
        rng.normal(size=(5000, 3)).astype(np.float32) + [0, 0, 1e3],
    )
    for points in clouds:
        order = order_of(points.astype(np.float32))
        assert order.shape == points.shape[:-1]
        whole = np.broadcast_to(np.arange(order.shape[-1]), order.shape)
        np.testing.assert_array_equal(np.sort(order, axis=-1), whole)


def test_rows_go_back_where_they_were():
    points = jnp.stack([spread(50, 1), spread(50, 2)])
    order = jax.jit(raster_order)(points)
    there = jax.jit(to_raster_order)(points, order)
    for own, cloud, sorted_cloud in zip(order, points, there, strict=True):
        np.testing.assert_array_equal(np.asarray(cloud)[np.asarray(own)], sorted_cloud)
    np.testing.assert_array_equal(jax.jit(from_raster_order)(there, order), points)

    def weighted(points):
        order = raster_order(points)
        rows = to_raster_order(points, order) * jnp.arange(50.0)[:, None]
        return (from_raster_order(rows, order) ** 2).sum()

    place = np.argsort(np.asarray(order), axis=1)[..., None]
    expected = 2.0 * np.asarray(points) * place**2
    np.testing.assert_allclose(jax.jit(jax.grad(weighted))(points), expected, rtol=1e-5)
