"""Rims, walls, hands, cables, flying, stray and few points: where they lie, and how often."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.microwave import MICROWAVE
from _helpers.shapes import outside_part
from scipy import ndimage

from caper_jax import categories
from caper_jax.config import GeneratorConfig
from caper_jax.geometry.boxes import corners, rest_diagonal
from caper_jax.synthetic import capsules, masks
from caper_jax.synthetic import disturbances as dist
from caper_jax.synthetic.frames import Generator, draw_state_and_poses
from caper_jax.synthetic.instances import build_bank, draw_instances
from caper_jax.synthetic.ray_casting import FAR
from caper_jax.synthetic.videos import VideoGenerator

SIDE, KEYS = 64, 300
ROWS, COLUMNS = np.indices((SIDE, SIDE))
DISC = np.hypot(ROWS - 30, COLUMNS - 33) < 20
HIT = jnp.asarray(DISC)
PART = jnp.where(HIT, 0, -1)
DEPTH = jnp.where(HIT, 1.0, FAR)
RAYS = (jnp.asarray((COLUMNS - 32) / 200.0), jnp.asarray((ROWS - 32) / 200.0))
NOTHING = jnp.full((SIDE, SIDE), FAR)
TABLE = jnp.full((SIDE, SIDE), 1.4)
SCENE = dist.Scene(DEPTH, PART, HIT, TABLE)
DIAGONAL = 0.3

N = 4000
LABELS = jnp.asarray(np.arange(N) % 3)
POINTS = jnp.asarray(np.random.default_rng(0).uniform([-0.2, -0.2, 0.8], [0.2, 0.2, 1.2], (N, 3)))
POINTS = POINTS.astype(jnp.float32)
RATES = dict.fromkeys(("specks", "speckle", "flying", "rim", "hand", "cable", "few_points"), 1.0)


def over_keys(function, keys=KEYS):
    """The function's results for many keys, as numpy arrays."""
    keys = jax.random.split(jax.random.key(0), keys)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(function))(keys))


# ------------------------------------------------------------------------------ stray points


def test_specks_are_uniform_in_the_ball():
    center = jnp.array([0.1, -0.05, 1.0])
    points, labels = over_keys(
        lambda key: dist.add_specks(key, POINTS, LABELS, center, DIAGONAL, 0.4), 40
    )
    specks = labels < 0
    np.testing.assert_array_equal(points[~specks], np.broadcast_to(POINTS, points.shape)[~specks])
    shares = specks.mean(1)
    assert shares.max() < 0.43 and 0.13 < shares.mean() < 0.27  # uniform from 0 to 0.4
    offset = (points[specks] - np.asarray(center)) / (0.75 * DIAGONAL)
    radius = np.linalg.norm(offset, axis=-1)
    assert radius.max() <= 1.0 + 1e-6
    chances = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
    # In a ball the fraction within r of it is r cubed; any coordinate has variance 1/5.
    np.testing.assert_allclose(np.quantile(radius, chances), np.cbrt(chances), atol=0.01)
    np.testing.assert_allclose(np.cov(offset.T), np.eye(3) / 5, atol=0.01)
    np.testing.assert_allclose(offset.mean(0), 0, atol=0.02)


def test_speckle_stays_on_its_rays_and_is_laplacian():
    points, labels = over_keys(lambda key: dist.add_speckle(key, POINTS, LABELS, DIAGONAL, 0.4), 40)
    moved = labels < 0
    before = np.broadcast_to(POINTS, points.shape)
    np.testing.assert_array_equal(points[~moved], before[~moved])
    assert 0.13 < moved.mean() < 0.27
    np.testing.assert_allclose(
        points[moved] / points[moved][:, 2:], before[moved] / before[moved][:, 2:], atol=1e-5
    )
    push = np.linalg.norm(points[moved], axis=-1) - np.linalg.norm(before[moved], axis=-1)
    # Of a Laplace distribution of scale b, quantile p < 1/2 is b log 2p.
    chances = np.array([0.05, 0.2, 0.4])
    expected = 0.1 * DIAGONAL * np.log(2 * chances)
    np.testing.assert_allclose(np.quantile(push, chances), expected, atol=0.002)
    np.testing.assert_allclose(np.quantile(push, 1 - chances), -expected, atol=0.002)
    assert points[..., 2].min() > 0


def test_speckle_never_passes_the_camera():
    points, _ = over_keys(lambda key: dist.add_speckle(key, POINTS, LABELS, 20.0, 1.0), 5)
    assert points[..., 2].min() > 0


# ------------------------------------------------------------------------------ flying pixels


def test_jumps_reach_to_what_is_beside_and_behind():
    # A disc at 1 m, its right half a step nearer; the table at 1.4 m, missing above row 20.
    near = DISC & (COLUMNS > 33)
    depth = np.where(DISC, 1.0, FAR)
    depth[near] = 0.9
    behind = np.where(ROWS < 20, FAR, 1.4)
    reach = np.asarray(dist.jump_reach(jnp.asarray(depth), jnp.asarray(behind), DIAGONAL))
    scene = np.minimum(depth, behind)
    for row, column in np.argwhere(DISC):
        beside = [scene[row + r, column + c] for r, c in ((0, 1), (0, -1), (1, 0), (-1, 0))]
        steps = [0.3 * DIAGONAL if s >= FAR else s - depth[row, column] for s in beside]
        farthest = max(steps)
        expected = farthest if farthest > 0.03 * depth[row, column] else 0.0
        assert reach[row, column] == pytest.approx(expected, abs=1e-5)
    assert reach[30, 34] == pytest.approx(0.1, abs=1e-5) and reach[30, 33] == 0
    # At the border of the grid nothing is known beyond but the table.
    whole = np.asarray(dist.jump_reach(jnp.ones((SIDE, SIDE)), TABLE, DIAGONAL))
    np.testing.assert_allclose(whole[0], 0.4, atol=1e-6)
    assert (whole[1:-1, 1:-1] == 0).all()


def test_flying_pixels_lie_between_the_surfaces():
    reach = jnp.where(LABELS == 1, 0.3, 0.0)
    points, labels = over_keys(lambda key: dist.fly(key, POINTS, LABELS, reach, 0.6), 40)
    flying = labels < 0
    before = np.broadcast_to(POINTS, points.shape)
    np.testing.assert_array_equal(points[~flying], before[~flying])
    assert not flying[:, np.asarray(LABELS) != 1].any()
    share = flying[:, np.asarray(LABELS) == 1].mean(1)
    assert share.max() < 0.65 and 0.2 < share.mean() < 0.4
    np.testing.assert_allclose(
        points[flying] / points[flying][:, 2:], before[flying] / before[flying][:, 2:], atol=1e-5
    )
    behind = (points - before)[flying][:, 2]
    assert behind.min() >= 0 and behind.max() <= 0.3001
    np.testing.assert_allclose(
        np.quantile(behind, [0.25, 0.5, 0.75]), [0.075, 0.15, 0.225], atol=0.01
    )


# --------------------------------------------------------------------------------- rim, wall


def test_rims_run_all_around_within_their_widths():
    wide = over_keys(lambda key: dist.widen(key, SCENE, 0.6))
    added = wide.hit & ~DISC
    assert (wide.hit & DISC == DISC).all()
    some = added.any((1, 2))
    assert 0.5 < some.mean() < 0.7
    np.testing.assert_array_equal(wide.depth[added], np.float32(1.4))
    outward = ndimage.distance_transform_edt(~DISC)
    widest = np.array([outward[image].max() for image in added[some]])
    # From one pixel to 8 % of 64; an octagon is no wider than 1.09 times the disc.
    assert widest.min() < 1.5 and 4.5 < widest.max() < 0.08 * SIDE * 1.09 + 0.5
    for image in added[some]:
        around = np.degrees(np.arctan2(ROWS - 30, COLUMNS - 33))[image] // 30
        assert len(np.unique(around)) >= 12
        # Whole: nothing nearer to the disc is left out.
        missing = outward[~image & ~DISC].min()
        assert missing > 0.95 * outward[image].max()


def test_rims_of_a_given_width():
    wide = over_keys(lambda key: dist.widen(key, SCENE, 1.0, (0.047, 0.047)), 20)
    outward = ndimage.distance_transform_edt(~DISC)
    for image in wide.hit & ~DISC:  # 3 of 64 pixels, an octagon
        assert 2.5 < outward[image].max() < 3 * 1.09 + 0.5


def test_rims_leave_out_what_has_no_depth_and_other_parts_of_the_object():
    part = jnp.where(COLUMNS > 33, PART, -1)  # the left half is not of the object
    scene = dist.Scene(DEPTH, PART, HIT & (COLUMNS > 33), jnp.where(ROWS < 30, FAR, TABLE))
    wide = over_keys(lambda key: dist.widen(key, scene, 1.0), 20)
    added = wide.hit & ~np.asarray(scene.hit)
    assert added.any() and not added[:, ROWS < 30].any() and not added[:, DISC].any()
    # What stands in front there is seen.
    wide = over_keys(lambda key: dist.widen(key, scene._replace(part=part), 1.0), 20)
    over = wide.hit & DISC & (COLUMNS <= 33)
    assert over.any()
    np.testing.assert_array_equal(wide.depth[over], 1.0)


@pytest.fixture(scope="module")
def laptop():
    """(instance, poses, viewpoint, diagonal) of a laptop."""
    category = categories.get("laptop")
    bank = build_bank(draw_instances(category, 1, "train", 0))
    instance = jax.tree.map(lambda values: jnp.asarray(values[0]), bank)
    _, poses, diagonal = draw_state_and_poses(jax.random.key(3), instance, category)
    return instance, poses, category.viewpoint, diagonal


def test_walls_stand_upright_behind_the_object(laptop):
    instance, poses, view, diagonal = laptop
    low, high = dist.object_center(instance, poses) - 0.4, dist.object_center(instance, poses) + 0.4
    x, y = np.meshgrid(np.linspace(low[0], high[0], 9), np.linspace(low[1], high[1], 9))
    rays = np.stack([x, y, np.ones_like(x)], -1) / np.asarray(low[2] + 0.4)
    rays /= rays[..., 2:]
    camera = (jnp.asarray(rays[..., 0]), jnp.asarray(rays[..., 1]))
    up = np.asarray(poses[0, :3, 1], np.float64)
    box = np.asarray(
        corners(poses[:, :3, :3], poses[:, :3, 3], instance.box_center, instance.size)
    ).reshape(-1, 3)
    center = (box.min(0) + box.max(0)) / 2
    np.testing.assert_allclose(dist.object_center(instance, poses), center, atol=1e-5)
    ahead = center - up * (up @ center)
    ahead /= np.linalg.norm(ahead)
    for turn, far in ((0.0, 0.0), (0.5, 0.3), (0.99, 0.1)):
        depth = dist.wall_depth(jnp.array([turn, far]), instance, poses, view, diagonal, camera)
        depth = np.asarray(depth, np.float64)
        seen = depth < FAR
        assert seen.sum() > 20
        wall = (rays * depth[..., None])[seen]
        middle = wall.mean(0)
        _, sizes, axes = np.linalg.svd(wall - middle, full_matrices=False)
        normal = axes[2] * np.sign(axes[2] @ ahead)
        assert sizes[2] < 1e-4 * sizes[1]
        assert abs(normal @ up) < 1e-3
        angle = np.degrees(np.arccos(np.clip(normal @ ahead, -1, 1)))
        assert angle == pytest.approx(60 * abs(turn - 0.5), abs=0.2)
        gap = middle @ normal - (box @ normal).max()
        assert gap == pytest.approx((0.1 + 1.4 * far) * float(diagonal), rel=2e-3)


def test_half_of_the_frames_have_a_wall(laptop):
    instance, poses, view, diagonal = laptop
    center = dist.object_center(instance, poses)
    rays = (RAYS[0] + center[0] / center[2], RAYS[1] + center[1] / center[2])
    args = (instance, poses, view, diagonal, rays)
    table = np.asarray(masks.table_depth(instance, poses, view, rays))
    behind = over_keys(lambda key: dist.background(key, *args, wall=True))
    assert (behind <= table * 1.0001).all()
    walls = (behind < 0.999 * table).any((1, 2))
    assert 0.25 < walls.mean() < 0.6  # of half of them some are hidden by the table
    alone = over_keys(lambda key: dist.background(key, *args, wall=False), 3)
    np.testing.assert_allclose(alone, np.broadcast_to(table, alone.shape), rtol=1e-6)


# --------------------------------------------------------------------------- hands and cables


def march(capsule, rays):
    """Depth [R] of rays [R, 3] on capsules by sphere tracing in float64, inf for none."""
    start, end, radius = (np.asarray(value, np.float64) for value in capsule)
    length = np.linalg.norm(rays, axis=-1)
    unit = rays / length[:, None]
    along = np.zeros(len(rays))
    axis = end - start
    for _ in range(400):
        points = (unit * along[:, None])[:, None]
        place = ((points - start) * axis).sum(-1) / np.maximum((axis * axis).sum(-1), 1e-15)
        nearest = start + np.clip(place, 0, 1)[..., None] * axis
        distance = (np.linalg.norm(points - nearest, axis=-1) - radius).min(1)
        along += np.maximum(distance, 0.0)
    return np.where(distance < 1e-6, along / length, np.inf)


def test_capsules_are_hit_where_sphere_tracing_hits_them():
    rng = np.random.default_rng(1)
    start = rng.uniform([-0.3, -0.3, 0.7], [0.3, 0.3, 1.5], (8, 3))
    end = start + rng.uniform(-0.2, 0.2, (8, 3))
    end[0] = start[0]  # a ball
    end[1] = 1.3 * start[1]  # seen along its axis
    radius = rng.uniform(0.0015, 0.05, 8)
    radius[:2] = 0.04
    x, y = rng.uniform(-0.4, 0.4, (2, 3000)).astype(np.float32)
    aim = start[1] / start[1, 2]
    x[0], y[0] = aim[:2]
    solid = capsules.Capsules(*(jnp.asarray(v, jnp.float32) for v in (start, end, radius)))
    found = np.asarray(jax.jit(capsules.capsule_depth)(solid, (x, y)), np.float64)
    truth = march(solid, np.stack([x, y, np.ones_like(x)], -1).astype(np.float64))
    hit, expected = found < FAR, np.isfinite(truth)
    assert 200 < expected.sum() < 2500 and hit[0]
    assert (hit != expected).mean() < 2e-3  # but for rays that graze
    both = hit & expected
    error = np.abs(found - truth)[both]
    assert np.quantile(error, 0.99) < 1e-4 and error.max() < 5e-3
    # Each of them alone, too; and none behind the camera.
    for index in range(8):
        one = jax.tree.map(lambda value, i=index: value[i : i + 1], solid)
        alone = np.asarray(capsules.capsule_depth(one, (x, y)))
        assert (alone >= found - 1e-4).all()
    back = capsules.Capsules(-solid.start, -solid.end, solid.radius)
    assert (np.asarray(capsules.capsule_depth(back, (x, y))) >= FAR).all()


def test_hands_have_the_sizes_of_hands():
    draws = np.random.default_rng(0).random((200, 6)).astype(np.float32)
    touch, along = jnp.array([0.1, 0.0, 1.0]), jnp.array([0.8, 0.0, -0.6])
    hand = jax.vmap(lambda u: capsules.hand_capsules(u, touch, along, 1.0))(draws)
    start, end, radius = map(np.asarray, hand)
    fingers = np.linalg.norm(end - start, axis=-1)[:, 0]
    assert fingers.min() >= 0.05 and fingers.max() < 0.0901
    assert 2 * radius[:, 0].min() > 0.0149 and 2 * radius[:, 0].max() < 0.0251
    assert (radius[:, 3] > 2 * radius[:, 0]).all()
    # The first finger's tip touches: its surface is at the point, from the camera.
    gap = np.linalg.norm(start[:, 0] - np.asarray(touch), axis=-1) - radius[:, 0]
    np.testing.assert_allclose(gap, 0, atol=1e-6)
    assert (np.linalg.norm(start[:, 0], axis=-1) < np.linalg.norm(touch)).all()
    number = [len(np.unique(row, axis=0)) for row in start[:, :3].round(5)]
    assert set(number) == {1, 2, 3}
    assert capsules.hand_scale(0.125) == 0.5 and capsules.hand_scale(1.0) == 1.0


def test_hands_hide_or_join_the_mask():
    center = jnp.array([0.005, -0.01, 1.0])
    found = over_keys(lambda key: dist.add_hand(key, SCENE, center, DIAGONAL, RAYS, 0.7))
    shown = (found.part < 0) & (found.depth < FAR)
    there, foreign = shown.any((1, 2)), found.hit & (found.part < 0)
    assert 0.35 < there.mean() < 0.75  # of 0.7, less those that would hide too much
    within = foreign.any((1, 2))[there]
    assert 0.35 < within.mean() < 0.65
    left = (found.hit & (found.part >= 0)).sum((1, 2)) / DISC.sum()
    assert left.min() > 0.3 and (left[there] < 1).mean() > 0.9
    assert foreign.sum((1, 2)).max() <= 0.6 * DISC.sum()
    assert (found.depth[shown & DISC] < 1.0).all() and (found.depth[shown] < 1.4).all()
    assert np.isfinite(found.depth).all()
    np.testing.assert_array_equal(found.hit[~there], np.broadcast_to(DISC, found.hit[~there].shape))
    # It reaches in from outside: what is seen of it goes on past the silhouette.
    assert ((shown & ~DISC).any((1, 2)))[there].mean() > 0.8


def test_cables_pass_in_front_or_behind():
    found = over_keys(lambda key: dist.add_cable(key, SCENE, DIAGONAL, RAYS, 0.9))
    shown = (found.part < 0) & (found.depth < FAR)
    foreign = found.hit & (found.part < 0)
    front = (shown & DISC).any((1, 2))
    assert 0.5 < front.mean() < 0.7  # two thirds of 0.9
    masked = foreign.any((1, 2))
    assert 0.35 < masked[front].mean() < 0.65
    behind = shown.any((1, 2)) & ~front
    assert 0.15 < behind.mean() < 0.35 and masked[behind].all()
    assert found.depth[shown & ~DISC].max() < 1.4
    nearest = found.depth[shown].min()
    assert 1 - (0.15 + 0.3) * DIAGONAL < nearest < 1 - 0.1 * DIAGONAL


def test_cables_are_smooth_thin_chains():
    draws = np.random.default_rng(0).random((200, 5)).astype(np.float32)
    middle = jnp.array([0.1, 0.0, 1.0])
    cable = jax.vmap(lambda u: capsules.cable_capsules(u, middle, 0.5))(draws)
    start, end, radius = map(np.asarray, cable)
    np.testing.assert_array_equal(start[:, 1:], end[:, :-1])
    assert 2 * radius.min() >= 0.003 and 2 * radius.max() <= 0.008
    pieces = end - start
    length = np.linalg.norm(pieces, axis=-1)
    assert set((length > 1e-6).sum(1)) == {3, 4, 5, 6}
    cosine = (pieces[:, 1:] * pieces[:, :-1]).sum(-1) / np.maximum(
        length[:, 1:] * length[:, :-1], 1e-9
    )
    assert cosine[length[:, 1:] > 1e-6].min() > 0.6


# ----------------------------------------------------------------------------- few points


def test_few_points_are_repeated_evenly():
    count = 1024
    labels = jnp.asarray(np.random.default_rng(0).choice(4, count, p=[0.5, 0.3, 0.17, 0.03]) - 1)
    index = over_keys(lambda key: dist.thin_out(key, labels, 3, 0.8), 400)
    assert (np.diff(index, axis=1) >= 0).all() and index.min() >= 0 and index.max() < count
    distinct = np.array([len(np.unique(row)) for row in index])
    few = distinct < count
    np.testing.assert_array_equal(index[~few], np.broadcast_to(np.arange(count), index[~few].shape))
    assert 0.7 < few.mean() < 0.87
    assert distinct.min() >= 47
    most = []
    for row in index[few]:
        _, repeats = np.unique(row, return_counts=True)
        assert repeats.max() - repeats.min() <= 1
        shares = [(np.asarray(labels)[np.unique(row)] == part).mean() for part in range(3)]
        most.append(max(shares))
    # Points of no part are half of all: no part has 60 % unless it was chosen.
    chosen = np.array(most) > 0.6
    assert 0.35 < chosen.mean() < 0.65
    shares = np.array(most)[chosen]
    # Labels that change from point to point make the share of 48 points inexact.
    assert shares.min() > 0.62 and abs(shares.mean() - 0.825) < 0.02
    # Log-uniform where nothing else bounds the number.
    spread = np.log(distinct[few][~chosen] / 48) / np.log(count / 48)
    np.testing.assert_allclose(np.quantile(spread, [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.1)


@pytest.mark.parametrize("labels", [np.full(512, -1), np.zeros(512, int), np.arange(512) // 511])
def test_few_points_of_one_kind_and_small_parts(labels):
    index = over_keys(lambda key: dist.thin_out(key, jnp.asarray(labels), 2, 1.0), 50)
    assert min(len(np.unique(row)) for row in index) >= 47
    assert index.min() >= 0 and index.max() < 512


# --------------------------------------------------------------------------------- frames


CLEAN = GeneratorConfig(instances=6, grid=48, num_points=256, noise=("none",))


def draw(config):
    """16 frames of ovens, as numpy arrays."""
    generator = Generator(MICROWAVE, config)
    draw = jax.jit(partial(generator.draw, batch_size=16))
    return jax.tree.map(np.asarray, draw(jax.random.key(0), bank=generator.bank))


def test_off_means_nothing_is_computed_and_seldom_that_little_changes(monkeypatch):
    seldom = draw(dataclasses.replace(CLEAN, **{k: 1e-9 for k in RATES if k != "rim"}))
    for name in ("background", "fly", "add_speckle", "add_specks", "thin_out", "widen"):
        monkeypatch.setattr(dist, name, None)
    plain = draw(CLEAN)
    # The same keys drive the rest of the frame: the same pixels, parts and poses.
    np.testing.assert_array_equal(seldom.labels, plain.labels)
    np.testing.assert_array_equal(seldom.visible, plain.visible)
    np.testing.assert_allclose(seldom.points, plain.points, atol=1e-5)


def test_labels_and_poses_stay_true_with_everything_on():
    config = dataclasses.replace(CLEAN, **RATES, occlusion=0.3, erosion=0.3, table=0.3, clutter=0.3)
    config = dataclasses.replace(config, specks=0.1, speckle=0.1)
    batch = draw(config)
    own = batch.labels >= 0
    outside = outside_part(batch.pose, batch.points, np.maximum(batch.labels, 0))
    assert outside[own].max() < 1e-4
    assert 0.1 < (~own).mean() < 0.7
    # Foreign points are none of the object's: most are clearly outside of all parts.
    away = np.min(
        [outside_part(batch.pose, batch.points, np.full_like(batch.labels, k)) for k in range(2)],
        axis=0,
    )
    assert (away[~own] > 1e-3).mean() > 0.7
    distinct = [len(np.unique(points, axis=0)) for points in batch.points]
    assert np.median(distinct) < 0.8 * CLEAN.num_points


def test_rim_points_lie_on_the_table_or_a_wall():
    batch = draw(dataclasses.replace(CLEAN, rim=1.0, grid=96))
    up = batch.pose.rotation[:, 0, :, "xyz".index(MICROWAVE.viewpoint.up)]
    box = np.asarray(
        corners(batch.pose.rotation, batch.pose.translation, batch.pose.box_center, batch.pose.size)
    ).reshape(len(up), -1, 3)
    lowest = np.einsum("bi,bni->bn", up, box).min(1)
    height = np.einsum("bi,bni->bn", up, batch.points) - lowest[:, None]
    rim = batch.labels < 0
    table = np.abs(height) < 1e-3
    assert (table & rim).sum() > 200 and (rim & ~table).sum() > 50
    assert height[rim].min() > -1e-3
    # Points off the table are on one plane across it, per frame.
    ratio = rest_diagonal(batch.pose.size, batch.pose.box_center)
    for points, wall, normal, diagonal in zip(
        batch.points, rim & ~table, up, np.asarray(ratio), strict=True
    ):
        if wall.sum() < 10:
            continue
        level = points[wall] - np.outer(points[wall] @ normal, normal)
        spread = np.linalg.svd(level - level.mean(0), compute_uv=False)
        assert spread[1] < 1e-3 * diagonal * np.sqrt(wall.sum())


# A chain, two sides, holes to look through.
RUN = ("robotarm", "scissors", "eyeglasses")


@pytest.mark.parametrize("name", categories.names())
def test_every_category_has_frames_with_all_of_it(name):
    config = GeneratorConfig(instances=3, grid=32, num_points=128, **RATES)
    generator = Generator(categories.get(name), config)
    if name not in RUN:  # compiling all would take a minute
        draw = partial(generator.draw, batch_size=4)
        batch = jax.eval_shape(draw, jax.random.key(0), bank=generator.bank)
        assert batch.points.shape == (4, 128, 3) and batch.labels.shape == (4, 128)
        return
    batch = jax.tree.map(np.asarray, generator.batch(jax.random.key(0), 4))
    assert batch.points.shape == (4, 128, 3) and np.isfinite(batch.points).all()
    assert (batch.points[..., 2] > 0).all()
    assert (batch.labels.max(1) >= 0).any() and batch.visible.sum(1).min() > 0


def test_videos_take_them():
    config = dataclasses.replace(CLEAN, grid=32, num_points=64, **RATES)
    generator = VideoGenerator(MICROWAVE, config, frames=3)
    batch = jax.tree.map(np.asarray, generator.batch(jax.random.key(0), 2))
    assert batch.points.shape == (2, 3, 64, 3) and np.isfinite(batch.points).all()
