"""Stray points: counted as by brute force, left out alone, and nothing else touched."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from caper_jax.geometry.outliers import count_distinct, find_inliers, neighbor_counts
from caper_jax.geometry.raster_order import raster_order


def slab(rng, count=1024):
    """Points of two perpendicular plates of 0.3 m, 0.7 m before the camera, in raster order."""
    flat = rng.uniform(-0.15, 0.15, (count, 2))
    upright = np.arange(count) % 2 == 0
    x, y = flat.T
    points = np.stack([x, np.where(upright, y, 0.15), np.where(upright, 0.15, y)], -1)
    points = (points + [0.05, 0.0, 0.7]).astype(np.float32)
    return points[raster_order(points)]


def with_specks(rng, points, number):
    """The cloud with its last points replaced by specks, in raster order, and which these are."""
    center, radius = points.mean(0), np.linalg.norm(points - points.mean(0), axis=1).max()
    direction = rng.normal(size=(number, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cloud = rng.permutation(points)
    cloud[-number:] = center + 1.5 * radius * rng.random((number, 1)) ** (1 / 3) * direction
    stray = np.arange(len(cloud)) >= len(cloud) - number
    order = raster_order(cloud)
    return cloud[order], stray[order]


def test_counts_are_those_of_27_voxels():
    rng = np.random.default_rng(0)
    offset = rng.normal(0, 4, (300, 3)).astype(np.float32)
    found = np.asarray(neighbor_counts(offset, 15))
    cell = np.clip(np.floor(offset + 7.5), 1, 13)
    near = np.abs(cell[:, None] - cell).max(-1) <= 1
    np.testing.assert_array_equal(found, near.sum(1))
    assert found.min() == 1 < found.max()


@pytest.mark.parametrize("share", [0.003, 0.03, 0.1])
def test_specks_are_left_out_and_the_surface_stays(share):
    rng = np.random.default_rng(1)
    left, lost, far = 0, 0, []
    for _ in range(5):
        surface = slab(rng)
        cloud, stray = with_specks(rng, surface, round(share * 1024))
        kept = np.asarray(find_inliers(cloud[None]).kept[0])
        left += (kept & stray).sum()
        lost += (~kept & ~stray).sum()
        far.append(cKDTree(cloud[~stray]).query(cloud[kept & stray])[0])
    assert lost <= 5
    assert left <= 0.3 * 5 * share * 1024
    # What is left lies close to the surface: within a fifth of the plates' side.
    assert np.concatenate(far).max(initial=0.0) < 0.1


def test_a_cloud_without_strays_stays_as_it_is():
    points = slab(np.random.default_rng(2))[None]
    inliers = find_inliers(points)
    assert inliers.kept.all()
    np.testing.assert_array_equal(inliers.apply(points), points)
    np.testing.assert_array_equal(inliers.undo(points), points)
    assert inliers.distinct == 1024


def test_kept_points_fill_the_places_of_strays_evenly_and_in_order():
    cloud, _ = with_specks(np.random.default_rng(3), slab(np.random.default_rng(3)), 150)
    inliers = jax.tree.map(lambda values: np.asarray(values)[0], find_inliers(cloud[None]))
    index, kept = inliers.index, inliers.kept
    assert kept[index].all() and (np.diff(index) >= 0).all()
    times = np.bincount(index, minlength=1024)[kept]
    assert set(times) <= {1, 2} and times.sum() == 1024
    # What is said of a place is said of the point that stands there.
    np.testing.assert_array_equal(index[inliers.position[kept]], np.flatnonzero(kept))
    assert inliers.distinct == kept.sum()


@pytest.mark.parametrize("distinct", [48, 100, 400])
def test_repeated_points_are_no_neighbors_of_themselves(distinct):
    rng = np.random.default_rng(4)
    some = slab(rng)[:: 1024 // distinct][:distinct]
    cloud = np.resize(some, (1024, 3))
    cloud[:3] = some.mean(0) + [0.0, -0.9, 0.0]  # one speck, three times
    cloud = cloud[raster_order(cloud)]
    inliers = find_inliers(cloud[None])
    stray = np.linalg.norm(cloud - some.mean(0), axis=1) > 0.5
    np.testing.assert_array_equal(inliers.kept[0], ~stray)
    assert inliers.distinct == len(np.unique(cloud[~stray], axis=0))


def test_equal_points_are_one_point():
    cloud = np.full((1, 64, 3), 0.5, np.float32)
    inliers = find_inliers(cloud)
    assert inliers.distinct == 1 and inliers.kept.all()
    assert count_distinct(cloud) == 1


def test_clouds_of_a_batch_are_judged_alone_and_vmap_is_the_same():
    rng = np.random.default_rng(5)
    clouds = np.stack([with_specks(rng, slab(rng), number)[0] for number in (3, 40, 120)])
    together = find_inliers(clouds)
    for number, cloud in enumerate(clouds):
        alone = find_inliers(cloud[None])
        np.testing.assert_array_equal(together.kept[number], alone.kept[0])
    mapped = jax.vmap(lambda cloud: find_inliers(cloud[None]).kept[0])(jnp.asarray(clouds))
    np.testing.assert_array_equal(mapped, together.kept)


def test_gradients_pass_through_what_is_kept_and_no_other():
    cloud, _ = with_specks(np.random.default_rng(6), slab(np.random.default_rng(6)), 20)
    kept = np.asarray(find_inliers(cloud[None]).kept[0])

    def total(points):
        return find_inliers(points).apply(points).sum()

    gradient = np.asarray(jax.grad(total)(jnp.asarray(cloud)[None]))[0]
    assert (gradient[~kept] == 0).all()
    assert gradient[kept].sum() == pytest.approx(3 * 1024) and (gradient[kept] >= 1).all()
