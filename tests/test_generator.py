"""The generator: exact ray casting, consistent labels and poses, disjoint and repeatable splits."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax import categories
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.data.synthetic import sensor as sensors
from caper_jax.data.synthetic.bank import build_bank, draw_models
from caper_jax.data.synthetic.caster import FAR, cast, projected_bounds
from caper_jax.data.synthetic.render import render_image, write_frame
from caper_jax.data.synthetic.scene import Generator, GeneratorConfig, draw_state_and_poses
from caper_jax.errors import CaperError

NAMES = ("box", "laptop")
CLEAN = GeneratorConfig(instances=12, grid=48, num_points=512, noise=("none",))


@pytest.fixture(scope="module", params=NAMES)
def clean(request):
    """(category, generator, batch of 24 clean frames)."""
    category = categories.get(request.param)
    generator = Generator(category, CLEAN)
    return category, generator, jax.tree.map(np.asarray, generator.batch(jax.random.key(1), 24))


def in_part_frame(batch, labels):
    """Points in the rest frame of the part they are labelled with, [B, N, 3]."""
    rows = np.arange(len(labels))[:, None]
    rotation = batch.pose.rotation[rows, labels]
    offset = batch.points - batch.pose.translation[rows, labels]
    return np.einsum("bnji,bnj->bni", rotation, offset)


@pytest.mark.parametrize("name", NAMES)
def test_caster_agrees_with_embree(name):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    pytest.importorskip("manifold3d")
    from solid_meshes import part_mesh

    category = categories.get(name)
    models = draw_models(category, 6, "train", 7)
    bank = build_bank(models)
    side = 100
    draw = jax.jit(partial(draw_state_and_poses, category=category))
    trace = jax.jit(cast)
    for index, model in enumerate(models):
        instance = jax.tree.map(lambda values, i=index: jnp.asarray(values[i]), bank)
        _, poses, _ = draw(jax.random.key(index), instance)
        low, high = map(np.asarray, projected_bounds(instance.groups, poses))
        grid = (np.arange(side) + 0.37) / side
        x, y = np.meshgrid(low[0] + grid * (high - low)[0], low[1] + grid * (high - low)[1])
        x, y = x.ravel().astype(np.float32), y.ravel().astype(np.float32)
        depth, part = map(np.asarray, trace(instance.groups, poses, (x, y)))

        best, label = np.full(x.shape, FAR), np.full(x.shape, -1)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float64)
        for k, solids in enumerate(model.parts):
            pose = np.asarray(poses[k], np.float64)
            mesh = part_mesh(solids)
            intersector = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)
            origin = np.tile(-pose[:3, :3].T @ pose[:3, 3], (len(x), 1))
            where, ray, _ = intersector.intersects_location(
                origin, rays @ pose[:3, :3], multiple_hits=False
            )
            z = (where @ pose[:3, :3].T + pose[:3, 3])[:, 2]
            nearer = z < best[ray]
            best[ray[nearer]], label[ray[nearer]] = z[nearer], k
        assert (label == part).mean() >= 0.999
        both = (label == part) & (label >= 0)
        error = np.abs(best - depth)[both]
        assert np.median(error) < 1e-6
        assert (error > 1e-3 * depth[both]).mean() < 1e-3


def test_points_lie_on_their_part(clean):
    _, _, batch = clean
    local = in_part_frame(batch, batch.labels)
    rows = np.arange(len(local))[:, None]
    half = batch.pose.size[rows, batch.labels] / 2
    center = batch.pose.box_center[rows, batch.labels]
    assert (np.abs(local - center) - half).max() < 1e-4


def test_part_poses_follow_the_joints(clean):
    category, _, batch = clean
    pose = batch.pose
    root = np.tile(np.eye(4, dtype=np.float32), (len(pose.rotation), 1, 1))
    root[:, :3, :3], root[:, :3, 3] = pose.rotation[:, 0], pose.translation[:, 0]
    expected = forward_kinematics(
        root,
        pose.joint_axis,
        pose.joint_pivot,
        pose.joint_state,
        category.joint_types,
        category.parents,
    )
    np.testing.assert_allclose(pose.rotation, expected[..., :3, :3], atol=2e-6)
    np.testing.assert_allclose(pose.translation, expected[..., :3, 3], atol=2e-6)


def test_rest_frame_is_the_convention(clean):
    """Origin at the centre of the whole box at rest; positive opens; x along the hinge."""
    category, generator, _ = clean
    bank = jax.tree.map(np.asarray, generator.bank)
    low = (bank.box_center - bank.size / 2).min(axis=1)
    high = (bank.box_center + bank.size / 2).max(axis=1)
    np.testing.assert_allclose(low, -high, atol=1e-6)
    np.testing.assert_allclose(np.abs(bank.joint_axis[:, 0, 0]), 1.0)
    # Opening from rest moves the far edge of the lid up (box) or back (laptop).
    axis, pivot = bank.joint_axis[:, 0], bank.joint_pivot[:, 0]
    lid = bank.box_center[:, 1] - pivot
    motion = np.cross(axis, lid)
    assert (motion[:, 1] > 0).all() if category.name == "box" else (motion[:, 2] < 0).all()


def test_cameras_keep_the_declared_ranges(clean):
    category, _, batch = clean
    view = category.viewpoint
    eye = -np.einsum("bji,bj->bi", batch.pose.rotation[:, 0], batch.pose.translation[:, 0])
    distance = np.linalg.norm(eye, axis=-1)
    elevation = np.degrees(np.arcsin(eye[:, 1] / distance))
    # The camera aims up to 5 % of a diagonal beside the origin.
    assert elevation.min() > view.elevation[0] - 4 and elevation.max() < view.elevation[1] + 4
    low = (batch.pose.box_center - batch.pose.size / 2).min(axis=1)
    high = (batch.pose.box_center + batch.pose.size / 2).max(axis=1)
    relative = distance / np.linalg.norm(high - low, axis=-1)
    assert relative.min() > view.distance[0] - 1e-3 and relative.max() < view.distance[1] + 1e-3
    assert (batch.points[..., 2] > 0).all()


def test_states_cover_each_instance_range():
    generator = Generator(categories.get("laptop"), dataclasses.replace(CLEAN, grid=8))
    batch = generator.batch(jax.random.key(0), 400)
    limits = np.asarray(generator.bank.limits)[np.asarray(batch.instance)]
    low, high = limits[..., 0], limits[..., 1]
    share = (np.asarray(batch.pose.joint_state) - low) / (high - low)
    assert share.min() >= 0 and share.max() <= 1
    counts, _ = np.histogram(share, bins=4, range=(0, 1))
    assert counts.min() > 60


def test_visible_counts_hidden_parts(clean):
    _, _, batch = clean
    for labels, visible in zip(batch.labels, batch.visible, strict=True):
        seen = np.bincount(labels, minlength=len(visible))
        assert ((seen > 0) <= (visible > 0)).all()


def test_splits_are_disjoint_and_repeatable():
    category = categories.get("box")
    sizes = {}
    for split in ("train", "val", "test"):
        bank = build_bank(draw_models(category, 30, split, 0))
        again = build_bank(draw_models(category, 30, split, 0))
        assert jax.tree.all(jax.tree.map(np.array_equal, bank, again))
        sizes[split] = {tuple(size.ravel().tolist()) for size in bank.size}
        assert len(sizes[split]) == 30
    assert not sizes["train"] & sizes["val"] | sizes["train"] & sizes["test"]
    assert not sizes["val"] & sizes["test"]
    other = build_bank(draw_models(category, 30, "train", 1))
    assert not sizes["train"] & {tuple(size.ravel().tolist()) for size in other.size}


def test_same_key_same_batch_and_other_key_other_batch(clean):
    _, generator, batch = clean
    again = generator.batch(jax.random.key(1), 24)
    assert np.array_equal(again.points, batch.points)
    other = generator.batch(jax.random.key(2), 24)
    assert not np.array_equal(other.points, batch.points)


def test_mean_sizes_of_the_definitions_hold():
    for name in NAMES:
        category = categories.get(name)
        bank = build_bank(draw_models(category, 1500, "train", 0))
        diagonal = np.linalg.norm(bank.size.mean(axis=0), axis=-1).max()
        np.testing.assert_allclose(bank.size.mean(axis=0), category.mean_size, atol=0.02 * diagonal)
        center = bank.box_center.mean(axis=0)
        np.testing.assert_allclose(center, category.mean_center, atol=0.02 * diagonal)


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
    "wrong", [{"grid": 2}, {"num_points": 3}, {"noise": ()}, {"residue": 1.5}, {"instances": 0}]
)
def test_config_refuses_what_makes_no_sense(wrong):
    with pytest.raises(CaperError, match=next(iter(wrong))):
        GeneratorConfig(**wrong)


def test_occlusion_and_residue(clean):
    category, _, _ = clean
    config = dataclasses.replace(CLEAN, occlusion=1.0, residue=0.2)
    batch = jax.tree.map(np.asarray, Generator(category, config).batch(jax.random.key(0), 24))
    share = (batch.labels == -1).mean(axis=1)
    assert 0.02 < share.mean() < 0.2 and share.max() < 0.3
    # Residue lies behind: farther from its part's box than any noise-free point can be.
    local = in_part_frame(batch, np.maximum(batch.labels, 0))
    rows = np.arange(len(local))[:, None]
    labels = np.maximum(batch.labels, 0)
    outside = np.abs(local - batch.pose.box_center[rows, labels])
    outside = (outside - batch.pose.size[rows, labels] / 2).max(-1)
    assert outside[batch.labels >= 0].max() < 1e-4
    plain = jax.tree.map(np.asarray, Generator(category, CLEAN).batch(jax.random.key(0), 24))
    np.testing.assert_array_equal(plain.pose.joint_state, batch.pose.joint_state)
    assert batch.visible.sum() < 0.95 * plain.visible.sum()


def test_rendered_frames_read_back(tmp_path):
    from caper_jax.data.cloud import cloud_from_depth
    from caper_jax.data.images import read_depth, read_intrinsics, read_mask

    category = categories.get("laptop")
    bank = build_bank(draw_models(category, 1, "test", 3))
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
    assert outside.max() < 0.0011  # depth is rounded to millimetres
