"""The generator: exact ray casting, consistent labels and poses, disjoint and repeatable splits."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.quick import quick_jit
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.config import GeneratorConfig
from caper_jax.errors import CaperError
from caper_jax.geometry.raster_order import grid_raster_order
from caper_jax.geometry.solids import bounds
from caper_jax.synthetic import sensor as sensors
from caper_jax.synthetic.frames import Generator, draw_state_and_poses, systematic
from caper_jax.synthetic.instances import build_bank, draw_instances
from caper_jax.synthetic.ray_casting import FAR, cast
from caper_jax.synthetic.render import render_image, write_frame

NAMES = categories.names()
CLEAN = GeneratorConfig(
    instances=12, grid=48, num_points=512, noise=("none",), measure_visibility=True
)
MANY = 1500


@cache
def drawn(name):
    """Train instances of a category; the first twelve are those of ``clean``."""
    return draw_instances(categories.get(name), MANY, "train", 0)


@pytest.fixture(scope="module", params=NAMES)
def clean(request):
    """(category, generator, batch of 24 clean frames)."""
    category = categories.get(request.param)
    generator = Generator(category, CLEAN)
    draw = quick_jit(partial(generator.draw, batch_size=24))
    batch = draw(jax.random.key(1), bank=generator.bank)
    return category, generator, jax.tree.map(np.asarray, batch)


def in_part_frame(batch, labels):
    """Points in the rest frame of the part they are labeled with, [B, N, 3]."""
    rows = np.arange(len(labels))[:, None]
    rotation = batch.pose.rotation[rows, labels]
    offset = batch.points - batch.pose.translation[rows, labels]
    return np.einsum("bnji,bnj->bni", rotation, offset)


def outside_part(batch, labels):
    """How far points are outside of the box of their part, meters (negative inside), [B, N]."""
    rows = np.arange(len(labels))[:, None]
    offset = np.abs(in_part_frame(batch, labels) - batch.pose.box_center[rows, labels])
    return (offset - batch.pose.size[rows, labels] / 2).max(-1)


def test_caster_agrees_with_embree(clean):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    pytest.importorskip("manifold3d")
    from _helpers.solid_meshes import part_mesh

    category, generator, batch = clean
    side = 100
    trace = quick_jit(cast)
    for frame in range(3):
        index = int(batch.instance[frame])
        groups = jax.tree.map(lambda values, i=index: values[i], generator.bank.groups)
        poses = np.tile(np.eye(4), (category.num_parts, 1, 1))
        poses[:, :3, :3] = batch.pose.rotation[frame]
        poses[:, :3, 3] = batch.pose.translation[frame]
        plane = batch.points[frame, :, :2] / batch.points[frame, :, 2:]
        low, high = plane.min(0), plane.max(0)
        low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
        steps = (np.arange(side) + 0.37) / side
        x, y = np.meshgrid(low[0] + steps * (high - low)[0], low[1] + steps * (high - low)[1])
        x, y = x.ravel().astype(np.float32), y.ravel().astype(np.float32)
        depth, part = map(np.asarray, trace(groups, poses.astype(np.float32), (x, y)))

        best, label = np.full(x.shape, FAR), np.full(x.shape, -1)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float64)
        alone = np.zeros(category.num_parts)
        for k, solids in enumerate(drawn(category.name)[index].parts):
            pose = poses[k]
            intersector = trimesh.ray.ray_pyembree.RayMeshIntersector(part_mesh(solids))
            origin = np.tile(-pose[:3, :3].T @ pose[:3, 3], (len(x), 1))
            where, ray, _ = intersector.intersects_location(
                origin, rays @ pose[:3, :3], multiple_hits=False
            )
            z = (where @ pose[:3, :3].T + pose[:3, 3])[:, 2]
            nearer = z < best[ray]
            best[ray[nearer]], label[ray[nearer]] = z[nearer], k
            alone[k] = len(ray)
        assert (label == part).mean() >= 0.999
        both = (label == part) & (label >= 0)
        error = np.abs(best - depth)[both]
        assert np.median(error) < 1e-6 * max(1.0, best[both].mean())
        assert (error > 1e-3 * depth[both]).mean() < 1e-3
        # The share of each part that is not hidden, counted on another grid.
        shown = np.bincount(label[label >= 0], minlength=category.num_parts)
        large = alone > 300
        np.testing.assert_allclose(
            batch.visibility[frame][large], (shown / np.maximum(alone, 1))[large], atol=0.08
        )


def test_points_lie_on_their_part(clean):
    _, _, batch = clean
    assert (batch.labels >= 0).all()
    assert outside_part(batch, batch.labels).max() < 1e-4


def test_picks_follow_one_another_evenly_along_the_scan():
    hit = np.random.default_rng(0).random((64, 64)) < 0.4
    order = grid_raster_order(64)
    hits = order[hit.ravel()[order]]
    for count in (300, 5000):
        picked = np.asarray(systematic(jax.random.key(0), jnp.asarray(hit), count))
        place = np.argsort(hits)[np.searchsorted(np.sort(hits), picked)]
        np.testing.assert_array_equal(hits[place], picked)
        step = len(hits) / count
        off = place - step * np.arange(count)  # the r-th lies in the r-th of equal pieces
        assert (off > -1).all() and (off <= step).all()


def test_the_last_pick_is_a_hit_however_it_is_rounded(monkeypatch):
    hit = np.zeros((96, 96), bool)
    hit[20:70, 20:70] = True
    largest = jnp.float32(1 - 2**-23)  # that jax.random.uniform gives
    monkeypatch.setattr(jax.random, "uniform", lambda key, shape: jnp.full(shape, largest))
    assert hit.ravel()[systematic(jax.random.key(0), jnp.asarray(hit), 1024)].all()


def test_part_poses_follow_the_joints(clean):
    """SciPy composes the motions along the tree."""
    category, _, batch = clean
    pose = batch.pose
    turns, shifts = [Rotation.from_matrix(pose.rotation[:, 0])], [pose.translation[:, 0]]
    for j, joint in enumerate(category.joints):
        axis, pivot = pose.joint_axis[:, j], pose.joint_pivot[:, j]
        motion = axis * pose.joint_state[:, j, None]
        if joint.type == "revolute":
            turn = Rotation.from_rotvec(motion)
            shift = pivot - turn.apply(pivot)
        else:
            turn, shift = Rotation.identity(len(axis)), motion
        shifts.append(turns[joint.parent].apply(shift) + shifts[joint.parent])
        turns.append(turns[joint.parent] * turn)
    rotation = np.stack([turn.as_matrix() for turn in turns], axis=1)
    np.testing.assert_allclose(pose.rotation, rotation, atol=4e-6)
    np.testing.assert_allclose(pose.translation, np.stack(shifts, axis=1), atol=1e-5)


def test_rest_origin_is_the_center_of_the_whole_box(clean):
    _, generator, _ = clean
    bank = jax.tree.map(np.asarray, generator.bank)
    low = (bank.box_center - bank.size / 2).min(axis=1)
    high = (bank.box_center + bank.size / 2).max(axis=1)
    np.testing.assert_allclose(low, -high, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(bank.joint_axis, axis=-1), 1.0, atol=1e-6)


def test_cameras_keep_the_declared_ranges(clean):
    category, _, batch = clean
    view = category.viewpoint
    eye = -np.einsum("bji,bj->bi", batch.pose.rotation[:, 0], batch.pose.translation[:, 0])
    distance = np.linalg.norm(eye, axis=-1)
    up = "xyz".index(view.up)
    side = np.sign(eye[:, up]) if view.either_side else 1
    assert not view.either_side or 0.2 < (side > 0).mean() < 0.8
    elevation = np.degrees(np.arcsin(side * eye[:, up] / distance))
    assert (side * batch.pose.rotation[:, 0, 1, up] < 0).all()  # what is up is up in the image
    # Exactly: the camera stands on a sphere around the origin, wherever it aims.
    assert elevation.min() > view.elevation[0] - 0.01
    assert elevation.max() < view.elevation[1] + 0.01
    low = (batch.pose.box_center - batch.pose.size / 2).min(axis=1)
    high = (batch.pose.box_center + batch.pose.size / 2).max(axis=1)
    relative = distance / np.linalg.norm(high - low, axis=-1)
    assert relative.min() > view.distance[0] - 1e-3 and relative.max() < view.distance[1] + 1e-3
    assert (batch.points[..., 2] > 0).all()


def test_states_cover_each_instance_range():
    category = categories.get("laptop")
    bank = build_bank(drawn("laptop")[:400])
    draw = quick_jit(jax.vmap(partial(draw_state_and_poses, category=category)))
    state, _, _ = draw(jax.random.split(jax.random.key(0), 400), bank)
    low, high = bank.limits[..., 0], bank.limits[..., 1]
    share = (np.asarray(state) - low) / (high - low)
    assert share.min() >= 0 and share.max() <= 1
    counts, _ = np.histogram(share, bins=4, range=(0, 1))
    assert counts.min() > 60


def test_visible_pixels_are_what_is_sampled(clean):
    _, _, batch = clean
    for labels, visible in zip(batch.labels, batch.visible, strict=True):
        seen = np.bincount(labels, minlength=len(visible))
        assert ((seen > 0) <= (visible > 0)).all()
        expected = len(labels) * visible / visible.sum()
        # Evenly spread picks: far closer than independent ones would be.
        assert np.abs(seen - expected).max() < np.sqrt(len(labels))


def test_visibility_is_the_share_that_nothing_hides(clean):
    _, _, batch = clean
    assert batch.visibility.min() >= 0 and batch.visibility.max() <= 1
    np.testing.assert_array_equal(batch.visibility > 0, batch.visible > 0)
    # The nearest part hides others and is not hidden itself.
    assert batch.visibility.max(axis=1).min() > 0.3


@pytest.mark.parametrize("name", NAMES)
def test_splits_are_disjoint_and_repeatable(name):
    category = categories.get(name)
    sizes = {}
    for split, seed in (("train", 0), ("val", 0), ("test", 0), ("train", 1)):
        bank = build_bank(draw_instances(category, 20, split, seed))
        again = build_bank(draw_instances(category, 20, split, seed))
        assert jax.tree.all(jax.tree.map(np.array_equal, bank, again))
        sizes[split, seed] = {tuple(size.ravel().tolist()) for size in bank.size}
    assert len(set().union(*sizes.values())) == 80


def test_same_key_same_batch_and_other_key_other_batch():
    generator = Generator(categories.get("laptop"), CLEAN)
    draw = quick_jit(partial(generator.batch, batch_size=24))
    batch, again, other = (draw(jax.random.key(seed)) for seed in (1, 1, 2))
    assert np.array_equal(again.points, batch.points)
    assert not np.array_equal(other.points, batch.points)


@pytest.mark.parametrize("name", NAMES)
def test_mean_sizes_of_the_definitions_hold(name):
    category = categories.get(name)
    boxes = np.array([[bounds(part) for part in model.parts] for model in drawn(name)])
    size, center = boxes[:, :, 1] - boxes[:, :, 0], boxes.mean(axis=2)
    diagonal = np.linalg.norm(size.mean(axis=0), axis=-1).max()
    np.testing.assert_allclose(size.mean(axis=0), category.mean_size, atol=0.02 * diagonal)
    np.testing.assert_allclose(center.mean(axis=0), category.mean_center, atol=0.02 * diagonal)


class TestSensor:
    """A flat wall at 1 m, 40,000 pixels."""

    SIDE = 200

    def wall(self, name, tilt=0.0, distance=1.0):
        sensor = jax.tree.map(lambda v: v[0], sensors.sensor_mix((name,)))
        axis = np.linspace(-0.3, 0.3, self.SIDE, dtype=np.float32)
        x, y = np.meshgrid(axis, axis)
        depth = (distance / (1.0 + np.tan(tilt) * x)).astype(np.float32)
        hit = np.ones_like(depth, bool)
        surface = sensors.surface(jnp.asarray(depth), jnp.asarray(hit), (x, y))
        points = sensors.measure(jax.random.key(0), sensor, surface, (x, y))
        seen = sensors.lose(jax.random.key(1), sensor, surface, hit)
        inner = np.s_[1:-1, 1:-1]
        return surface, np.asarray(points)[inner], np.asarray(seen)[inner], depth[inner], (x, y)

    def test_none_is_exact(self):
        _, points, seen, depth, (x, _) = self.wall("none", tilt=0.6)
        np.testing.assert_allclose(points[..., 2], depth, rtol=1e-6)
        np.testing.assert_allclose(points[..., 0], x[1:-1, 1:-1] * depth, rtol=1e-5, atol=1e-7)
        assert seen.all()

    def test_gauss3mm_is_isotropic(self):
        _, points, seen, depth, (x, y) = self.wall("gauss3mm")
        truth = np.stack([x[1:-1, 1:-1] * depth, y[1:-1, 1:-1] * depth, depth], -1)
        np.testing.assert_allclose((points - truth).std((0, 1)), 0.003, rtol=0.03)
        assert seen.all()

    @pytest.mark.parametrize("distance", [0.8, 2.0])
    def test_kinect_noise_grows_as_published(self, distance):
        _, points, _, depth, _ = self.wall("kinect", distance=distance)
        sigma = 0.0012 + 0.0019 * (distance - 0.4) ** 2
        step = distance**2 / (570 * 0.075) / 8  # disparity rounding is uniform over one step
        expected = np.hypot(sigma, step / np.sqrt(12))
        assert (points[..., 2] - depth).std() == pytest.approx(expected, rel=0.05)
        assert abs((points[..., 2] - depth).mean()) < 0.15 * expected

    @pytest.mark.parametrize("distance", [0.4, 1.0, 2.5])
    def test_stereo_noise_is_that_of_its_baseline(self, distance):
        _, points, _, depth, _ = self.wall("realsense", distance=distance)
        pixel = distance**2 / (640 * 0.05)  # a pixel of disparity, meters
        expected = np.hypot(0.08 * pixel, pixel / 32 / np.sqrt(12))
        assert (points[..., 2] - depth).std() == pytest.approx(expected, rel=0.05)

    def test_incidence_is_the_angle_to_the_normal(self):
        # The wall's normal is (tan tilt, 0, 1) up to scale.
        tilt = 0.7
        surface, _, _, _, (x, y) = self.wall("none", tilt=tilt)
        ray = np.stack([x, y, np.ones_like(x)], -1)
        normal = np.array([np.tan(tilt), 0, 1])
        cosine = ray @ normal / np.linalg.norm(ray, axis=-1) / np.linalg.norm(normal)
        inner = np.s_[1:-1, 1:-1]
        np.testing.assert_allclose(np.asarray(surface.cosine)[inner], cosine[inner], atol=2e-3)

    def test_pixels_are_lost_at_jumps_only(self):
        sensor = jax.tree.map(lambda v: v[0], sensors.sensor_mix(("kinect",)))
        x, y = np.meshgrid(np.linspace(-0.3, 0.3, 80), np.linspace(-0.3, 0.3, 80))
        depth = np.where(np.arange(80)[None, :] < 40, 1.0, 1.5) * np.ones((80, 80))
        hit = np.ones((80, 80), bool)
        surface = sensors.surface(jnp.asarray(depth), jnp.asarray(hit), (x, y))
        seen = np.asarray(sensors.lose(jax.random.key(1), sensor, surface, jnp.asarray(hit)))
        lost = ~seen[2:-2, 2:-2]
        edge = lost[:, 37:39]
        assert 0.2 < edge.mean() < 0.5
        assert not lost[:, :36].any() and not lost[:, 40:].any()


def test_unknown_noise_names_the_nearest():
    with pytest.raises(CaperError, match="kinect"):
        sensors.sensor_mix(("kinnect",))


@pytest.mark.parametrize(
    "wrong",
    [
        {"grid": 2},
        {"num_points": 3},
        {"noise": ()},
        {"noise": ("kinnect",)},
        {"instances": 0},
        {"residue": 1.5},
        {"table": -0.1},
        {"depth_scale": 0.5},
        {"occluders": ()},
        {"occluders": ("hand",)},
    ],
)
def test_config_refuses_what_makes_no_sense(wrong):
    with pytest.raises(CaperError, match=next(iter(wrong))):
        GeneratorConfig(**wrong)


def test_rendered_frames_read_back(tmp_path):
    from caper_jax.data.clouds import cloud_from_depth
    from caper_jax.data.images import read_depth, read_intrinsics, read_mask

    category = categories.get("laptop")
    bank = build_bank(draw_instances(category, 1, "test", 3))
    instance = jax.tree.map(lambda values: jnp.asarray(values[0]), bank)
    image = render_image(jax.random.key(2), instance, category, "none", 320, 240)
    assert (image.parts >= 0).sum() > 300
    assert not (image.parts[[0, -1]] >= 0).any() and not (image.parts[:, [0, -1]] >= 0).any()
    write_frame(tmp_path / "frame", image, category, "frame")
    depth = read_depth(tmp_path / "frame" / "depth.png")
    mask = read_mask(tmp_path / "frame" / "mask.png")
    intrinsics = read_intrinsics(tmp_path / "frame" / "intrinsics.json", depth.shape)
    cloud = cloud_from_depth(depth, mask, intrinsics)
    labels = image.parts[cloud.pixels[:, 0], cloud.pixels[:, 1]]
    pose = image.pose
    local = np.einsum("nji,nj->ni", pose.rotation[labels], cloud.points - pose.translation[labels])
    outside = np.abs(local - pose.box_center[labels]) - pose.size[labels] / 2
    assert outside.max() < 0.0011  # depth is rounded to millimeters
