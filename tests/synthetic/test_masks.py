"""What hides an object, and imperfect masks: rates, sizes, and where foreign points lie."""

from __future__ import annotations

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.microwave import MICROWAVE
from _helpers.shapes import outside_part

from caper_jax import categories
from caper_jax.config import GeneratorConfig
from caper_jax.synthetic import masks
from caper_jax.synthetic.frames import Generator
from caper_jax.synthetic.instances import build_bank, draw_instances
from caper_jax.synthetic.masks import add_clutter, spill_on_table, table_depth
from caper_jax.synthetic.ray_casting import FAR

SIDE, KEYS = 64, 300
ROWS, COLUMNS = np.indices((SIDE, SIDE))
DISC = np.hypot(ROWS - 30, COLUMNS - 33) < 25
# As arrays of JAX: indices drawn inside jit do not index those of numpy.
HIT = jnp.asarray(DISC)
PART = jnp.where(HIT, 0, -1)
DEPTH = jnp.where(HIT, 1.0, FAR)
RAYS = (jnp.asarray((COLUMNS - 32) / 200.0), jnp.asarray((ROWS - 32) / 200.0))


def over_keys(function):
    """The function's results for many keys, as numpy arrays."""
    keys = jax.random.split(jax.random.key(0), KEYS)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(function))(keys))


def distance_to(pixels):
    """[SIDE, SIDE] distance to the nearest of the pixels."""
    return np.min([np.hypot(ROWS - r, COLUMNS - c) for r, c in np.argwhere(pixels)], axis=0)


@pytest.mark.parametrize("shapes", [("edge",), ("strip",), ("blob",), masks.OCCLUDERS])
def test_occluders_hide_a_part_at_the_stated_rate(shapes):
    left = over_keys(lambda key: masks.occlude(key, HIT, 0.4, shapes))
    assert not (left & ~DISC).any()
    share = left.sum((1, 2)) / DISC.sum()
    # Some lie beside the object, and some would hide too much of it.
    assert 0.15 < (share < 1).mean() < 0.46
    assert share.min() > 0.3 and share[share < 1].mean() < 0.97


def test_strips_leave_two_sides_and_edges_one():
    for shapes, convex in ((("edge",), True), (("strip",), False)):
        left = over_keys(partial(masks.occlude, hit=HIT, rate=1.0, shapes=shapes))
        hidden = DISC & ~left
        # Of three collinear points of a half plane, the middle one is never hidden alone.
        opposite = left & left[:, ::-1, ::-1]
        middle = hidden[:, 30, 33]
        assert (middle & opposite.any((1, 2))).any() != convex


def test_erosion_keeps_its_rate_and_width():
    left = over_keys(lambda key: masks.erode(key, HIT, 0.3))
    eroded = (left != DISC).any((1, 2))
    assert 0.22 < eroded.mean() < 0.38
    inward = distance_to(~DISC)
    for image in left[eroded]:
        assert inward[DISC & ~image].max() <= 2.0  # 3 % of 64 pixels
        assert inward[image].min() > 1.0


def test_erosion_by_a_given_width():
    left = over_keys(lambda key: masks.erode(key, HIT, 1.0, (0.05, 0.05)))
    inward = distance_to(~DISC)
    for image in left:
        # 5 % of 64 pixels, in steps to the sides: a diagonal is as far as two of them.
        assert 2.5 < inward[DISC & ~image].max() <= 3.0
        assert inward[image].min() > 4 / np.sqrt(2) - 0.1


def test_thin_objects_are_not_eroded_away():
    thin = np.abs(ROWS - 30) < 1
    left = over_keys(lambda key: masks.erode(key, jnp.asarray(thin), 1.0))
    np.testing.assert_array_equal(left, np.broadcast_to(thin, left.shape))


def test_nearest_pixels_are_those_around_the_center():
    center, count = (20, 40), 150
    found = np.asarray(jax.jit(masks.nearest_pixels)(HIT, center, count))
    distance = np.hypot(ROWS - center[0], COLUMNS - center[1])
    assert 0.9 * count <= found.sum() <= count
    assert distance[found].max() <= distance[DISC & ~found].min()


def test_any_pixel_draws_each_alike():
    few = np.zeros((SIDE, SIDE), bool)
    few[[3, 3, 40], [5, 60, 2]] = True
    draws = np.linspace(0, 0.9999, 300)
    rows, columns = jax.vmap(lambda u: masks.random_pixel(u, jnp.asarray(few)))(draws)
    found, counts = np.unique(np.stack([rows, columns]), axis=1, return_counts=True)
    np.testing.assert_array_equal(found, [[3, 3, 40], [5, 60, 2]])
    np.testing.assert_array_equal(counts, [100, 100, 100])


def test_missing_pixels_and_holes():
    lone = over_keys(lambda key: masks.missing_depth(key, HIT, 0.2, 0.0))
    shares = lone.mean((1, 2))
    assert shares.max() < 0.22 and 0.08 < shares.mean() < 0.12  # uniform from 0 to 0.2
    holes = over_keys(lambda key: masks.missing_depth(key, HIT, 0.0, 0.5))
    some = (holes & DISC).any((1, 2))
    assert 0.42 < some.mean() < 0.58
    # Up to four ellipses within 8 % of the side in radius.
    assert holes.sum((1, 2)).max() < 4 * np.pi * (0.08 * SIDE + 1) ** 2
    assert holes[some].sum((1, 2)).min() >= 1


def test_the_table_touches_the_object_from_below():
    category = categories.get("laptop")
    bank = build_bank(draw_instances(category, 1, "train", 0))
    instance = jax.tree.map(lambda values: values[0], bank)
    # Seen from 40 deg above, 1.5 m away; the lid leans back below the base.
    angle, lean = np.radians(40), np.radians(-100)
    root = np.eye(4)
    root[:3, :3] = [
        [1, 0, 0],
        [0, -np.cos(angle), np.sin(angle)],
        [0, -np.sin(angle), -np.cos(angle)],
    ]
    root[:3, 3] = [0.1, 0.05, 1.5]
    turn = np.eye(4)
    cos, sin = np.cos(lean), np.sin(lean)
    turn[1:3, 1:3] = [[cos, -sin], [sin, cos]]
    poses = np.stack([root, root @ turn]).astype(np.float32)
    depth = np.asarray(table_depth(instance, poses, category.viewpoint, RAYS))

    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    up = root[:3, 1]
    lowest = [
        ((instance.box_center[k] + corners * instance.size[k]) @ pose[:3, :3].T + pose[:3, 3]) @ up
        for k, pose in enumerate(poses)
    ]
    x, y = map(np.asarray, RAYS)
    table = np.stack([x, y, np.ones_like(x)], -1) * depth[..., None]
    assert (depth < FAR).all() and (depth > 0).all()
    np.testing.assert_allclose(table @ up, np.min(lowest), atol=1e-5)
    # Upside down the table touches it from the other side, where such objects may lie so.
    either = dataclasses.replace(category.viewpoint, either_side=True)
    over = np.diag([1.0, -1.0, -1.0, 1.0])
    turned = (poses @ over).astype(np.float32)
    for k in range(2):
        instance.box_center[k] *= [1, -1, -1]
    below = np.asarray(table_depth(instance, turned, either, RAYS))
    np.testing.assert_allclose(below, depth, rtol=1e-5)
    # Rays along or above the horizon never meet it.
    assert np.asarray(table_depth(instance, poses, category.viewpoint, (0.0, -1.3))) == FAR


def test_spill_is_a_stretch_of_the_rim_on_the_table():
    table = jnp.full_like(DEPTH, 1.4)
    spill = over_keys(lambda key: spill_on_table(key, DEPTH, PART, HIT, table, 0.6, 0.2))
    depth, hit = spill
    added = hit & ~DISC
    assert (hit & DISC == DISC).all()
    share = added.sum((1, 2)) / DISC.sum()
    assert 0.5 < (share > 0).mean() < 0.7
    assert 0.14 < share.max() <= 0.2
    np.testing.assert_array_equal(depth[added], np.float32(1.4))
    outward = distance_to(DISC)
    assert all(outward[image].max() <= 3.0 for image in added if image.any())  # 4 % of 64


def test_clutter_is_a_blob_in_front_or_behind():
    table = jnp.full_like(DEPTH, FAR)
    depth, part, hit = over_keys(
        lambda key: add_clutter(key, DEPTH, PART, HIT, table, 0.5, RAYS, rate=0.7, spill=0.2)
    )
    clutter = hit & (part < 0)
    share = clutter.sum((1, 2)) / DISC.sum()
    assert 0.6 < (share > 0).mean() < 0.8 and 0.14 < share.max() <= 0.2
    covers = (clutter & DISC).any((1, 2))
    assert 0.35 < covers[share > 0].mean() < 0.65
    edge = distance_to(DISC & (distance_to(~DISC) <= 1))
    for image, values, in_front in zip(clutter, depth, covers, strict=True):
        if not image.any():
            continue
        near_edge = image & (edge < 3)
        assert near_edge.any()
        # 3 to 30 % of the diagonal (0.5 m) away where it meets the silhouette, tilted beside.
        offset = np.abs(np.median(values[near_edge]) - 1.0)
        assert 0.0 < offset < 0.25
        if in_front:
            assert values[image & DISC].max() < 1.0
    assert (part[hit & ~clutter] == 0).all()


def test_clutter_never_lies_below_the_table():
    table = jnp.full_like(DEPTH, 1.02)
    depth, part, hit = over_keys(
        lambda key: add_clutter(key, DEPTH, PART, HIT, table, 0.5, RAYS, rate=1.0, spill=0.2)
    )
    assert depth[hit & (part < 0)].max() <= np.float32(1.02)


CLEAN = GeneratorConfig(instances=8, grid=48, num_points=512, noise=("none",))


@pytest.fixture(scope="module")
def plain():
    """Frames that nothing disturbs."""
    return draw(CLEAN)


def draw(config):
    """24 frames of ovens, as numpy arrays."""
    generator = Generator(MICROWAVE, config)
    draw = jax.jit(partial(generator.draw, batch_size=24))
    return jax.tree.map(np.asarray, draw(jax.random.key(0), bank=generator.bank))


def test_everything_at_once_keeps_poses_and_labels_true(plain):
    config = dataclasses.replace(
        CLEAN,
        occlusion=1.0,
        occluders=masks.OCCLUDERS,
        erosion=1.0,
        table=0.5,
        clutter=0.5,
        residue=0.05,
        dropout=0.1,
        holes=0.5,
    )
    batch = draw(config)
    # Compiled apart, the two programs round differently.
    jax.tree.map(partial(np.testing.assert_allclose, rtol=0, atol=1e-5), batch.pose, plain.pose)
    np.testing.assert_array_equal(batch.instance, plain.instance)
    own = batch.labels >= 0
    outside = outside_part(batch.pose, batch.points, np.maximum(batch.labels, 0))
    assert outside[own].max() < 1e-4
    foreign = (~own).mean(axis=1)
    assert 0.01 < foreign.mean() < 0.15 and foreign.max() < 0.3
    # A wider grid of rays sees fewer pixels of the object: (1 + 2 * 0.04)^2.
    full = plain.visible.sum(axis=1) / 1.08**2
    share = batch.visible.sum(axis=1) / full
    assert share.max() < 1.03 and share.mean() < 0.95


def test_depth_scale_moves_a_frame_and_residue_single_points(plain):
    config = dataclasses.replace(CLEAN, depth_scale=0.02, residue=0.2)
    batch = draw(config)
    ratio = np.linalg.norm(batch.points, axis=-1) / np.linalg.norm(plain.points, axis=-1)
    residue = batch.labels < 0
    assert 0.02 < residue.mean() < 0.2 and residue.mean(axis=1).max() < 0.3
    scale = np.median(ratio, axis=1, keepdims=True)
    np.testing.assert_allclose((ratio / scale)[~residue], 1.0, rtol=1e-5)
    assert ((ratio / scale)[residue] > 1).all()
    assert 0.01 < scale.std() < 0.03 and np.abs(scale - 1).max() <= 0.0601
