"""The estimator: consistent poses, transformations of JAX, clouds of any size, clear errors."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import caper_jax as caper
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.geometry import se3


@pytest.fixture(scope="module")
def estimator():
    return caper.load("laptop")


@pytest.fixture(scope="module")
def points():
    """[2, 1024, 3]: two plates at right angles, 0.9 m away, with a little noise."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-0.15, 0.15, (2, 1024, 2))
    up = np.arange(1024) % 2 == 0
    x, y = flat[..., 0], np.where(up, -np.abs(flat[..., 1]), 0.0)
    z = np.where(up, 0.15, flat[..., 1])
    cloud = np.stack([x, y + 0.6 * z + 0.1, z + 0.9], -1) + rng.normal(0, 1e-3, (2, 1024, 3))
    return cloud.astype(np.float32)


def test_the_pose_is_consistent(estimator, points):
    prediction = jax.tree.map(np.asarray, estimator(points))
    pose, category = prediction.pose, estimator.category
    square = np.einsum("bkij,bklj->bkil", pose.rotation, pose.rotation)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), square.shape), atol=1e-5)
    assert (np.linalg.det(pose.rotation) > 0.99).all() and (pose.size > 0).all()
    root = se3.from_rt(pose.rotation[:, 0], pose.translation[:, 0])
    joints = pose.joint_axis, pose.joint_pivot, pose.joint_state
    parts = forward_kinematics(root, *joints, category.joint_types, category.parents)
    np.testing.assert_allclose(parts[..., :3, 3], pose.translation, atol=1e-5)
    assert set(np.unique(prediction.labels)) <= {0, 1} and prediction.labels.shape == (2, 1024)
    assert ((prediction.confidence > 0) & (prediction.confidence < 1)).all()


def test_clouds_of_any_size_compile_once(estimator, points):
    estimator(points[:1])
    before = estimator._jitted._cache_size()
    for count in (16, 700, 1024):
        prediction = estimator(points[0, :count])
        assert prediction.pose.rotation.shape == (2, 3, 3)
        assert prediction.points.shape == (1024, 3)
    assert estimator._jitted._cache_size() == before


def test_bad_points_are_left_out(estimator, points):
    broken = np.concatenate([points[0], np.full((40, 3), np.nan, np.float32)])
    np.testing.assert_array_equal(
        estimator(broken).pose.translation, estimator(points[0]).pose.translation
    )


def test_gradients_agree_with_finite_differences(estimator, points):
    direction = np.random.default_rng(1).normal(size=(1, 1024, 3))
    with jax.enable_x64(True):
        variables = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), estimator.variables)
        cloud = points[:1].astype(np.float64)

        @jax.jit
        def value(points):
            return estimator.function(variables, points).pose.translation[:, 1].sum()

        slope = float((jax.grad(value)(cloud) * direction).sum())
        step = 1e-7  # small: maxima over points have kinks close by
        ahead, behind = value(cloud + step * direction), value(cloud - step * direction)
        numeric = float(ahead - behind) / (2 * step)
    assert slope == pytest.approx(numeric, rel=1e-3)
    assert abs(slope) > 0.01


def test_vmap_over_parameter_sets(estimator, points):
    other = jax.tree.map(lambda leaf: leaf * 1.01, estimator.variables)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), estimator.variables, other)
    stacked = jax.jit(jax.vmap(estimator.function, in_axes=(0, None)))(both, points)
    for index, variables in enumerate((estimator.variables, other)):
        alone = estimator._jitted(variables, points)
        np.testing.assert_allclose(
            stacked.pose.translation[index], alone.pose.translation, atol=1e-4
        )


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.zeros((0, 3), np.float32), "points"),
        (np.ones((10, 3), np.float32), "16"),
        (np.ones((50, 2), np.float32), r"\[N, 3\]"),
        (np.full((50, 3), np.nan, np.float32), "points"),
        (np.full((50, 3), 900.0, np.float32), "milli"),
    ],
)
def test_unusable_clouds_are_named(estimator, wrong, message):
    with pytest.raises(caper.CaperError, match=message):
        estimator(wrong)


def test_load_names_what_is_wrong(tmp_path):
    with pytest.raises(caper.CaperError, match="laptop"):
        caper.load("laptob")
    with pytest.raises(caper.CaperError, match=str(tmp_path)):
        caper.load("box", tmp_path)
    shipped = caper.estimator.shipped_weights() / "laptop"
    with pytest.raises(caper.CaperError, match="'laptop', not 'box'"):
        caper.load("box", shipped)
    for name in ("weights.npz", "model.json"):
        (tmp_path / name).write_bytes((shipped / name).read_bytes())
    (tmp_path / "weights.npz").write_bytes(b"PK not a zip")
    with pytest.raises(caper.CaperError, match=r"weights\.npz"):
        caper.load("laptop", tmp_path)
