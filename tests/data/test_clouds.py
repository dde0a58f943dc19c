"""Clouds from depth images and files, and masks from detection boxes."""

import numpy as np
import pytest
import trimesh

from caper_jax.data.clouds import (
    are_sampled,
    cloud_from_depth,
    count_distinct,
    fit_support_plane,
    mask_from_box,
    read_points,
    sample_points,
    shows_object,
    systematic_indices,
)
from caper_jax.errors import CaperError

K = np.array([[300.0, 0, 79.5], [0, 310.0, 59.5], [0, 0, 1]])
SHAPE = (120, 160)


def slope():
    """A depth image whose points all satisfy z = 1 + x / 2."""
    columns = np.arange(SHAPE[1])
    depth = 1 / (1 - 0.5 * (columns - K[0, 2]) / K[0, 0])
    return np.tile(depth, (SHAPE[0], 1)).astype(np.float32)


def test_points_project_onto_their_pixels():
    depth = slope()
    mask = np.zeros(SHAPE, bool)
    mask[20:90, 30:120] = True
    cloud = cloud_from_depth(depth, mask, K, num_points=500)
    assert cloud.points.shape == (500, 3) and cloud.points.dtype == np.float32
    projected = cloud.points @ K.T.astype(np.float32)
    np.testing.assert_allclose(projected[:, 1::-1] / projected[:, 2:], cloud.pixels, atol=1e-4)
    np.testing.assert_allclose(cloud.points[:, 2], 1 + cloud.points[:, 0] / 2, atol=1e-6)
    assert len(np.unique(cloud.index)) == 500
    np.testing.assert_array_equal(cloud.index, cloud.pixels @ [SHAPE[1], 1])
    assert (cloud.available, cloud.dropped) == (70 * 90, 0)


def test_huge_and_far_points_are_dropped_and_counted():
    """Some cameras say "nothing" by the largest number there is."""
    near = np.random.default_rng(0).normal([0, 0, 1], 0.1, (64, 3))
    for value in (3.4e38, 1e300, 1e10, -1e5, 60.0):
        points = np.vstack([near, [[0.0, value, 1.0]]])
        cloud = sample_points(points, 65)
        assert cloud.dropped == 1 and np.abs(cloud.points).max() < 2
        assert not are_sampled(points[None], 65)


def test_pixels_without_depth_are_dropped_and_counted():
    depth, mask = slope(), np.ones(SHAPE, bool)
    depth[:, :10], depth[:, 10:15], depth[:, 15:17], depth[:, 17] = 0, np.nan, np.inf, -1
    cloud = cloud_from_depth(depth, mask, K)
    assert cloud.dropped == 18 * SHAPE[0]
    assert cloud.available == (SHAPE[1] - 18) * SHAPE[0]
    assert (cloud.pixels[:, 1] >= 18).all() and np.isfinite(cloud.points).all()


def test_every_point_is_picked_equally_often():
    for available, wanted in ((16, 1024), (1000, 1024), (1024, 1024), (40_000, 1024), (17, 64)):
        for seed in (None, 0, 1):
            picked = systematic_indices(available, wanted, seed)
            counts = np.bincount(picked, minlength=available)
            assert len(picked) == wanted and (np.diff(picked) >= 0).all()
            assert counts.max() - counts.min() <= 1
    assert not np.array_equal(systematic_indices(9999, 64, 0), systematic_indices(9999, 64, 1))


@pytest.mark.parametrize("width", [360, 384, 500])
def test_picks_cover_a_large_object_evenly(width):
    """Over 256 rows, 1024 even picks of the plain raster all fall on four columns."""
    depth = np.ones((320, 640), np.float32)
    mask = np.zeros(depth.shape, bool)
    mask[10:266, 40 : 40 + width] = True
    cloud = cloud_from_depth(depth, mask, K, num_points=1024)
    assert cloud.available == 256 * width
    assert len(np.unique(cloud.index)) == 1024
    counts, _, _ = np.histogram2d(
        *cloud.pixels.T, bins=(16, 16), range=((10, 266), (40, 40 + width))
    )
    assert counts.min() >= 2 and counts.max() <= 6


def test_a_raw_cloud_is_picked_evenly_in_any_order():
    """Better than by chance, which is what every n-th of unordered points would be."""
    raster = cloud_from_depth(slope(), np.ones(SHAPE, bool), K, num_points=100_000).points
    assert len(raster) == 100_000  # every pixel, some of them repeated
    raster = np.unique(raster, axis=0)
    mixed = np.random.default_rng(0).permutation(raster)
    one, other = (sample_points(points, 1024).points for points in (raster, mixed))
    assert len(set(map(tuple, one)) & set(map(tuple, other))) > 1000

    def in_cells(picked):
        pixels = (picked @ K.T.astype(np.float32))[:, 1::-1] / picked[:, 2:]
        return np.histogram2d(*pixels.T, bins=(12, 16), range=((0, 120), (0, 160)))[0]

    for picked in (one, other):
        assert in_cells(picked).min() >= 3 and in_cells(picked).max() <= 8
    by_chance = in_cells(mixed[:1024])
    assert by_chance.min() < 2 or by_chance.max() > 9


def test_thin_objects_keep_enough_pixels():
    depth = np.ones((600, 600), np.float32)
    mask = np.eye(600, dtype=bool) | np.eye(600, k=1, dtype=bool)
    cloud = cloud_from_depth(depth, mask, K, num_points=1024)
    assert len(np.unique(cloud.index)) == 1024


def test_small_objects_are_filled_up_by_repeating():
    mask = np.zeros(SHAPE, bool)
    mask[50:57, 60:67] = True
    cloud = cloud_from_depth(slope(), mask, K, num_points=1024)
    assert cloud.available == 49
    assert len(np.unique(cloud.points, axis=0)) == 49


def test_far_outliers_go_only_when_asked():
    depth, mask = slope(), np.zeros(SHAPE, bool)
    mask[40:60, 40:60] = True
    depth[40, 40:50] = 3.0
    kept = cloud_from_depth(depth, mask, K, num_points=400)
    assert kept.points[:, 2].max() == 3.0
    cleaned = cloud_from_depth(depth, mask, K, num_points=400, radius=0.5)
    assert cleaned.dropped == 10 and cleaned.points[:, 2].max() < 1.1
    same = sample_points(kept.points, 400, radius=0.5)
    assert same.dropped == 10


def test_bad_images_are_named():
    depth, mask = slope(), np.ones(SHAPE, bool)
    with pytest.raises(CaperError, match="depth is 160 x 120 but mask is 80 x 120"):
        cloud_from_depth(depth, mask[:, :80], K)
    with pytest.raises(CaperError, match="mask is empty"):
        cloud_from_depth(depth, ~mask, K)
    with pytest.raises(CaperError, match="none of the 19200 masked pixels has valid depth"):
        cloud_from_depth(np.zeros_like(depth), mask, K)
    with pytest.raises(CaperError, match="float image"):
        cloud_from_depth((depth * 1000).astype(np.uint16), mask, K)
    few = np.zeros(SHAPE, bool)
    few[0, :47] = True
    with pytest.raises(CaperError, match="only 47 of 47 masked pixels are usable; at least 48"):
        cloud_from_depth(depth, few, K)
    with pytest.raises(CaperError, match="intrinsics has shape"):
        cloud_from_depth(depth, mask, K[:2])


def test_equal_points_count_once():
    rng = np.random.default_rng(0)
    points = (rng.normal(size=(60, 3)) * 0.1 + [0, 0, 1]).astype(np.float32)
    np.testing.assert_array_equal(count_distinct(points[None]), 60)
    np.testing.assert_array_equal(count_distinct(np.resize(points[:7], (2, 60, 3))), 7)
    zeros = np.zeros((1, 9, 3), np.float32)
    zeros[0, 4] = -0.0
    assert count_distinct(zeros) == 1
    with pytest.raises(CaperError, match="only 47 of 300 usable points in points differ"):
        sample_points(np.resize(points[:47], (300, 3)))
    with pytest.raises(CaperError, match="all 200 usable points of points are the same point"):
        sample_points(np.resize(points[:1], (200, 3)))
    assert sample_points(np.resize(points[:48], (300, 3))).available == 300
    assert shows_object(np.resize(points[:48], (5000, 3)))
    assert not shows_object(np.resize(points[:47], (5000, 3)))
    assert not are_sampled(np.resize(points[:47], (1, 300, 3)), 300)


def test_raw_clouds_are_checked():
    points = np.random.default_rng(0).normal(size=(200, 3)) * 0.1 + [0, 0, 1]
    dirty = points.copy()
    dirty[3, 0], dirty[7], dirty[11] = np.nan, np.inf, 0
    cloud = sample_points(dirty, 197)
    assert (cloud.available, cloud.dropped) == (197, 3)
    np.testing.assert_array_equal(cloud.index, np.setdiff1d(np.arange(200), [3, 7, 11]))
    np.testing.assert_array_equal(cloud.points, points[cloud.index].astype(np.float32))
    for bad, message in (
        (points * 1000, "cloud.npy: median depth .* millimeters: multiply by 0.001"),
        (points * [1, -1, -1], "behind the camera"),
        (points[:, :2], r"a cloud must be \[N, 3\]"),
        (points.astype(str), "must be numbers"),
        (points[:5], "only 5 of 5 points in cloud.npy are usable"),
        (np.full((50, 3), np.nan), "only 0 of 50"),
    ):
        with pytest.raises(CaperError, match=message):
            sample_points(bad, where="cloud.npy")
    with pytest.raises(CaperError, match="radius must be positive"):
        sample_points(points, radius=0)


def test_only_clouds_that_sampling_would_return_count_as_sampled():
    clouds = np.random.default_rng(0).normal(size=(3, 50, 3)) * 0.1 + [0, 0, 1]
    assert are_sampled(clouds, 50)
    for cloud in clouds:
        np.testing.assert_array_equal(sample_points(cloud, 50).points, cloud.astype(np.float32))
    assert not are_sampled(clouds, 49)
    assert not are_sampled(clouds.astype(str), 50)
    for spoil in (np.nan, np.inf, 0.0):
        spoilt = clouds.copy()
        spoilt[1, 7] = spoil
        assert not are_sampled(spoilt, 50)
    for factor in (1000.0, -1.0):
        spoilt = clouds.copy()
        spoilt[2] *= factor
        assert not are_sampled(spoilt, 50)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply_files_of_trimesh_are_read(tmp_path, encoding):
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    path = tmp_path / "cloud.ply"
    colors = np.tile(np.uint8([[1, 2, 3, 255]]), (50, 1))
    cloud = trimesh.PointCloud(points, colors=colors)
    path.write_bytes(trimesh.exchange.ply.export_ply(cloud, encoding=encoding.split("_")[0]))
    np.testing.assert_allclose(read_points(path), points, rtol=1e-5, atol=1e-7)
    np.save(tmp_path / "cloud.npy", points)
    np.testing.assert_array_equal(read_points(tmp_path / "cloud.npy"), points)


def test_faces_after_the_vertices_are_ignored(tmp_path):
    mesh = trimesh.creation.box()
    mesh.export(tmp_path / "box.ply")
    np.testing.assert_allclose(read_points(tmp_path / "box.ply"), mesh.vertices, atol=1e-7)


HEADER = "ply\nformat {} 1.0\nelement vertex 4\n{}end_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    "content",
    [
        "hello",
        HEADER.format("text", XYZ),
        HEADER.format("ascii", "property float x\n") + "0\n" * 4,
        HEADER.format("ascii", XYZ) + "0 0 1\n0 1",
        HEADER.format("ascii", XYZ) + "0 0 x\n" * 4,
        HEADER.format("binary_little_endian", XYZ) + "12345678",
        "ply\nformat ascii 1.0\nelement face 1\nend_header\n",
    ],
)
def test_broken_ply_files_are_named(tmp_path, content):
    path = tmp_path / "cloud.ply"
    path.write_bytes(content.encode())
    with pytest.raises(CaperError, match=r"cloud\.ply: "):
        read_points(path)


def test_other_kinds_of_cloud_are_refused(tmp_path):
    with pytest.raises(CaperError, match=r"must be \.npy or \.ply"):
        read_points(tmp_path / "cloud.obj")
    with pytest.raises(CaperError, match="no such file"):
        read_points(tmp_path / "cloud.ply")


# A table seen from above at 35 degrees, with a block on it and another, larger one to the left.
NORMAL = np.array([0.0, -np.cos(np.radians(35)), -np.sin(np.radians(35))])
DISTANCE = 0.7


def table_scene(noise: float = 0.0015):
    """(depth, true mask of the block); a ray caster of its own, in NumPy."""
    rows, columns = np.indices(SHAPE)
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(SHAPE)], -1)
    table = -DISTANCE / (rays @ NORMAL)
    depth = np.where((table > 0) & (table < 2), table, 0)
    along = np.cross(NORMAL, [1.0, 0, 0])
    frame = np.stack([[1.0, 0, 0], NORMAL, along])
    owner = np.zeros(SHAPE, int)
    middle = depth[SHAPE[0] // 2, SHAPE[1] // 2] * rays[SHAPE[0] // 2, SHAPE[1] // 2]
    for number, (shift, half) in enumerate(
        [((0, 0), (0.09, 0.02, 0.06)), ((-0.26, 0.0), (0.12, 0.05, 0.12))], start=1
    ):
        center = middle + shift[0] * frame[0] + shift[1] * along + half[1] * NORMAL
        direction = rays @ frame.T
        start = -(frame @ center)
        with np.errstate(divide="ignore"):
            a, b = (-np.array(half) - start) / direction, (np.array(half) - start) / direction
        near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
        hit = (near < far) & (near > 0) & ((near < depth) | (depth == 0))
        depth[hit], owner[hit] = near[hit], number
    depth = depth + np.random.default_rng(0).normal(size=SHAPE) * noise * (depth > 0)
    return depth.astype(np.float32), owner


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def test_block_on_a_table_is_found_in_its_box():
    depth, owner = table_scene()
    for number in (1, 2):
        truth = owner == number
        rows, columns = np.nonzero(truth)
        box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        mask = mask_from_box(depth, K, box)
        assert overlap(mask, truth) > 0.8
        # What is missed is the rim that stands less than the noise above the table.
        assert (mask & ~truth).sum() < 0.03 * truth.sum()


def test_support_plane_is_the_table_not_the_top_of_a_large_block():
    depth, owner = table_scene(noise=0.0)
    rows, columns = np.nonzero((owner >= 0) & (depth > 0))
    z = depth[rows, columns]
    points = np.stack([(columns - K[0, 2]) / K[0, 0] * z, (rows - K[1, 2]) / K[1, 1] * z, z], -1)
    # Ten copies of the blocks' tops make them the plane with the most points.
    top = points[owner[rows, columns] == 2]
    normal, offset = fit_support_plane(np.concatenate([points, *[top] * 10]))
    # The foot of the blocks, within the camera's noise, tilts it a little.
    np.testing.assert_allclose(normal, NORMAL, atol=5e-3)
    assert offset == pytest.approx(DISTANCE, abs=2e-3)


def test_holes_in_the_depth_do_not_cut_an_object_apart():
    depth, owner = table_scene()
    truth = owner == 1
    rows, columns = np.nonzero(truth)
    depth[:, columns.mean().astype(int) - 3 : columns.mean().astype(int) + 3] = 0
    box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    mask = mask_from_box(depth, K, box)
    assert overlap(mask, truth & (depth > 0)) > 0.8


def test_boxes_without_an_object_are_named():
    depth, owner = table_scene()
    with pytest.raises(CaperError, match="is empty in the 160 x 120 image"):
        mask_from_box(depth, K, (50, 50, 40, 60))
    with pytest.raises(CaperError, match="is empty in the 160 x 120 image"):
        mask_from_box(depth, K, (400, 10, 500, 60))
    with pytest.raises(CaperError, match="four numbers"):
        mask_from_box(depth, K, (float("nan"), 1, 40, 60))
    with pytest.raises(CaperError, match="almost no valid depth inside"):
        mask_from_box(np.zeros_like(depth), K, (40, 40, 80, 80))
    flat = (125, 90, 150, 110)
    assert not owner[90:110, 125:150].any()
    with pytest.raises(CaperError, match="nothing stands above the supporting plane"):
        mask_from_box(depth, K, flat)
