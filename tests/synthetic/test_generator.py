"""The generator: exact ray casting, consistent labels and poses, disjoint and repeatable splits."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.microwave import MICROWAVE
from _helpers.shapes import outside_part

from caper_jax import categories
from caper_jax.config import GeneratorConfig
from caper_jax.errors import CaperError
from caper_jax.geometry.raster_order import grid_raster_order
from caper_jax.synthetic import sensor as sensors
from caper_jax.synthetic.frames import Generator, draw_state_and_poses, systematic_sample
from caper_jax.synthetic.images import render_image, write_frame
from caper_jax.synthetic.instances import build_bank, draw_instances

NAMES = ("drawer", "robotarm", "scissors")  # several children, a chain, objects on either side
CLEAN = GeneratorConfig(
    instances=12, grid=48, num_points=512, noise=("none",), measure_visibility=True
)


@pytest.fixture(scope="module", params=NAMES)
def clean(request):
    """(category, its instances, batch of 24 clean frames)."""
    category = categories.get(request.param)
    generator = Generator(category, CLEAN)
    draw = jax.jit(partial(generator.draw, batch_size=24))
    batch, again, other = (draw(jax.random.key(seed), bank=generator.bank) for seed in (1, 1, 2))
    np.testing.assert_array_equal(again.points, batch.points)
    assert not np.array_equal(other.points, batch.points)
    models = draw_instances(category, CLEAN.instances, "train", 0)
    return category, models, jax.tree.map(np.asarray, batch)


def test_points_and_visibility_agree_with_embree(clean):
    pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    pytest.importorskip("manifold3d")
    from _helpers.solid_meshes import mesh_object

    from caper_jax.synthetic.urdf_frames import PartCaster

    category, models, batch = clean
    steps = (np.arange(100) + 0.37) / 100
    for frame in range(3):
        caster = PartCaster(mesh_object(models[batch.instance[frame]], category).parts)
        poses = np.tile(np.eye(4), (category.num_parts, 1, 1))
        poses[:, :3, :3] = batch.pose.rotation[frame]
        poses[:, :3, 3] = batch.pose.translation[frame]

        def cast(rays, caster=caster, poses=poses):
            """Depth of each part alone [K, R] and the nearest part [R], -1 for none."""
            alone, _ = caster.cast(poses, np.zeros_like(rays), rays)
            return alone, np.where(np.isfinite(alone.min(0)), alone.argmin(0), -1)

        points = batch.points[frame].astype(np.float64)
        alone, part = cast(points / points[:, 2:])
        same = part == batch.labels[frame]
        assert same.mean() >= 0.99  # but for silhouettes
        error = np.abs(alone.min(0) - points[:, 2])[same]
        assert np.median(error) < 1e-6 * max(1.0, points[:, 2].mean())
        assert (error > 1e-3 * points[same, 2]).mean() < 3e-3
        # The share of each part that is not hidden, counted on another grid.
        plane = points[:, :2] / points[:, 2:]
        low, high = plane.min(0), plane.max(0)
        low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
        x, y = np.meshgrid(*(low[:, None] + steps * (high - low)[:, None]))
        alone, part = cast(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=-1))
        shown = np.bincount(part[part >= 0], minlength=category.num_parts)
        pixels = np.isfinite(alone).sum(1)
        large = pixels > 300
        share = shown[large] / pixels[large]
        np.testing.assert_allclose(batch.visibility[frame][large], share, atol=0.08)


def test_points_lie_on_their_part(clean):
    _, _, batch = clean
    assert (batch.labels >= 0).all()
    assert outside_part(batch.pose, batch.points, batch.labels).max() < 1e-4


def test_picks_follow_one_another_evenly_along_the_scan():
    hit = np.random.default_rng(0).random((64, 64)) < 0.4
    order = grid_raster_order(64)
    hits = order[hit.ravel()[order]]
    for count in (300, 5000):
        picked = np.asarray(
            jax.jit(partial(systematic_sample, count=count))(jax.random.key(0), hit)
        )
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
    assert hit.ravel()[systematic_sample(jax.random.key(0), jnp.asarray(hit), 1024)].all()


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
    bank = build_bank(draw_instances(category, 50, "train", 0))
    bank = jax.tree.map(lambda values: np.repeat(values, 8, axis=0), bank)
    draw = jax.jit(jax.vmap(partial(draw_state_and_poses, category=category)))
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


class TestSensor:
    """A flat wall at 1 m, 40,000 pixels."""

    SIDE = 200

    def wall(self, name, tilt=0.0, distance=1.0):
        sensor = jax.tree.map(lambda v: v[0], sensors.sensor_mix((name,)))
        axis = np.linspace(-0.3, 0.3, self.SIDE, dtype=np.float32)
        x, y = np.meshgrid(axis, axis)
        depth = (distance / (1.0 + np.tan(tilt) * x)).astype(np.float32)
        hit = np.ones_like(depth, bool)
        surface = sensors.surface_map(jnp.asarray(depth), jnp.asarray(hit), (x, y))
        points = sensors.measure(jax.random.key(0), sensor, surface, (x, y))
        seen = sensors.valid_pixels(jax.random.key(1), sensor, surface, hit)
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
        surface = sensors.surface_map(jnp.asarray(depth), jnp.asarray(hit), (x, y))
        seen = sensors.valid_pixels(jax.random.key(1), sensor, surface, jnp.asarray(hit))
        lost = ~np.asarray(seen)[2:-2, 2:-2]
        edge = lost[:, 37:39]
        assert 0.2 < edge.mean() < 0.5
        assert not lost[:, :36].any() and not lost[:, 40:].any()


def test_unknown_noise_names_the_nearest():
    with pytest.raises(CaperError, match="kinect"):
        sensors.sensor_mix(("kinnect",))


def test_rendered_frames_read_back(tmp_path):
    from caper_jax.data.clouds import cloud_from_depth
    from caper_jax.data.images import read_depth, read_intrinsics, read_mask

    bank = build_bank(draw_instances(MICROWAVE, 1, "test", 3))
    instance = jax.tree.map(lambda values: jnp.asarray(values[0]), bank)
    image = render_image(jax.random.key(2), instance, MICROWAVE, "none", 320, 240)
    assert (image.parts >= 0).sum() > 300
    assert not (image.parts[[0, -1]] >= 0).any() and not (image.parts[:, [0, -1]] >= 0).any()
    write_frame(tmp_path / "frame", image, MICROWAVE, "frame")
    depth = read_depth(tmp_path / "frame" / "depth.png")
    mask = read_mask(tmp_path / "frame" / "mask.png")
    intrinsics = read_intrinsics(tmp_path / "frame" / "intrinsics.json", depth.shape)
    cloud = cloud_from_depth(depth, mask, intrinsics)
    labels = image.parts[cloud.pixels[:, 0], cloud.pixels[:, 1]]
    assert outside_part(image.pose, cloud.points, labels).max() < 0.0011  # depth is in millimeters
