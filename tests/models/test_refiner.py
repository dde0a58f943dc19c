"""The refiner: features against numpy, targets that undo errors, a fit."""

from __future__ import annotations

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax import categories
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import GeneratorConfig, RefinerConfig
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load, shipped_weights
from caper_jax.lie import se3, so3
from caper_jax.models import refiner
from caper_jax.models.files import read_model
from caper_jax.models.pipeline import articulated_pose
from caper_jax.models.uncertainty import EVIDENCE
from caper_jax.synthetic.frames import Generator
from caper_jax.training import fit_refiner as fitting

BOX = categories.get("box")
DRAWER = categories.get("drawer")


def reading(category, rng, batch=2):
    parts, joints = category.num_parts, category.num_joints
    axis = rng.normal(size=(batch, joints, 3))
    root = se3.from_rt(so3.exp(rng.normal(size=(batch, 3))), rng.normal(size=(batch, 3)))
    return refiner.StageEstimate(
        root=jnp.asarray(root, jnp.float32),
        axis=jnp.asarray(axis / np.linalg.norm(axis, axis=-1, keepdims=True), jnp.float32),
        pivot=jnp.asarray(rng.normal(size=(batch, joints, 3)), jnp.float32),
        state=jnp.asarray(rng.uniform(0.1, 0.8, (batch, joints)), jnp.float32),
        size=jnp.asarray(rng.uniform(0.2, 1.0, (batch, parts, 3)), jnp.float32),
        center=jnp.asarray(0.1 * rng.normal(size=(batch, parts, 3)), jnp.float32),
    )


@pytest.mark.parametrize("category", [BOX, DRAWER], ids=lambda c: c.name)
def test_features_count_points_in_the_box_of_their_part(category):
    """The spread of each part along its own axes, in numpy; unsure points count by their share."""
    rng = np.random.default_rng(0)
    one = reading(category, rng)
    cloud = rng.normal(size=(2, 50, 3)).astype(np.float32)
    share = rng.dirichlet(np.ones(category.num_parts), (2, 50)).astype(np.float32)
    evidence = np.zeros((2, EVIDENCE), np.float32)
    found = refiner.refiner_features(
        one, jnp.asarray(cloud), jnp.asarray(share), evidence, category
    )
    assert found.shape == (2, refiner.num_features(category.num_parts))
    view = np.broadcast_to(np.eye(3, dtype=np.float32), (2, 3, 3))
    pose = articulated_pose(one, view, category)
    places = refiner._PLACES
    spread = np.asarray(found)[:, : category.num_parts * 3 * len(places)]
    spread = spread.reshape(2, category.num_parts, 3, len(places))
    for b in range(2):
        for k in range(category.num_parts):
            away = cloud[b] - np.asarray(pose.translation[b, k]) * category.unit
            own = away @ np.asarray(pose.rotation[b, k])
            inside = (own - np.asarray(one.center[b, k])) / (np.asarray(one.size[b, k]) / 2)
            passed = np.clip((places - inside[..., None]) / refiner._RAMP + 0.5, 0, 1)
            weight = share[b, :, k] / (share[b, :, k].sum() + 1)
            wanted = (weight[:, None, None] * passed).sum(0)
            np.testing.assert_allclose(spread[b, k], wanted, atol=2e-4)


def test_a_tilted_side_shows_its_slope():
    """A plane near the side x = 1 that leans by 0.05 along y and by -0.03 along z."""
    rng = np.random.default_rng(1)
    across = rng.uniform(-1, 1, (400, 2))
    x = 1.01 + 0.05 * across[:, 0] - 0.03 * across[:, 1]
    inside = np.column_stack([x, across]).astype(np.float32)[None, :, None]
    tilt = np.asarray(refiner._tilt(jnp.asarray(inside), jnp.ones((1, 400, 1)), 1.0))[0, 0, 0]
    assert tilt[1] == pytest.approx(0.01, abs=5e-3)
    assert tilt[2] / 3 == pytest.approx(0.05, abs=0.012)
    assert tilt[3] / 3 == pytest.approx(-0.03, abs=0.012)


@pytest.mark.parametrize("category", [BOX, DRAWER], ids=lambda c: c.name)
def test_the_difference_to_the_truth_takes_an_estimate_there(category):
    rng = np.random.default_rng(2)
    truth, other = reading(category, rng), reading(category, rng)
    near = jax.tree.map(lambda t, o: t + 0.02 * o, truth, other)
    turn = se3.exp(0.05 * rng.normal(size=(2, 6)).astype(np.float32))
    near = dataclasses.replace(near, root=se3.compose(truth.root, turn), axis=truth.axis)
    view = so3.exp(rng.normal(size=(2, 3)).astype(np.float32))
    poses = [articulated_pose(one, view, category) for one in (near, truth)]
    output = fitting.difference(*poses, category)
    mended: ArticulatedPose = articulated_pose(refiner.apply_residual(near, output), view, category)
    for name in ("rotation", "translation", "size", "box_center", "joint_state"):
        found, wanted = getattr(mended, name), getattr(poses[1], name)
        np.testing.assert_allclose(found, wanted, atol=2e-5, err_msg=name)


def test_it_says_nothing_before_it_is_fitted():
    module = refiner.BoxRefiner(8, 2)
    features = np.random.default_rng(3).normal(size=(2, refiner.num_features(2)))
    output = module.apply(module.init(jax.random.key(0), features), features)
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(output))
    one = reading(BOX, np.random.default_rng(4))
    for found, wanted in zip(
        *map(jax.tree.leaves, (refiner.apply_residual(one, output), one)), strict=True
    ):
        np.testing.assert_allclose(found, wanted, atol=1e-6)


def frames(category, count=192):
    generator = Generator(
        category, GeneratorConfig(instances=64, grid=48, num_points=1024), "val", 7
    )
    return generator.batch(jax.random.key(7), count)


def errors(estimator, batch):
    """(median translation error [m], mean logarithm by which sizes are off)."""
    pose = estimator(batch.points).pose
    shift = np.linalg.norm(pose.translation - batch.pose.translation, axis=-1)
    return np.median(shift), np.abs(np.log(pose.size / batch.pose.size)).mean()


def without(estimator):
    network = dataclasses.replace(estimator.network, refiner=RefinerConfig())
    return Estimator(estimator.category, network, estimator.variables, estimator.card)


def test_shipped_refiners_help():
    estimator, batch = load("box"), frames(BOX)
    with_them, alone = errors(estimator, batch), errors(without(estimator), batch)
    assert with_them[0] < 0.9 * alone[0] and with_them[1] < 0.95 * alone[1]


def test_fitting_writes_a_model_that_knows_sizes_better(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "_STEPS", 300)
    folder = tmp_path / "box"
    shutil.copytree(shipped_weights() / "box", folder)
    data = GeneratorConfig(instances=200, grid=48, num_points=1024, noise=("none",))
    fitting.add_refiner(folder, "box", data, 64, 4096)
    card, variables = read_model(folder)
    assert card["run"]["network"]["refiner"]["width"] == 64 and "calibration" not in card
    assert variables["params"]["refiner"]["Dense_0"]["kernel"].shape[1] == 64
    fitted, batch = load("box", folder), frames(BOX)
    assert errors(fitted, batch)[1] < 0.98 * errors(without(fitted), batch)[1]


def test_too_few_frames_are_refused():
    with pytest.raises(CaperError, match="needs 1024 frames or more, got 100"):
        fitting.fit_refiner(load("box"), GeneratorConfig(), 64, 100)


def test_a_model_that_is_always_turned_is_refused(monkeypatch):
    monkeypatch.setattr(fitting, "_MAX_ROTATION", 1e-6)
    monkeypatch.setattr(fitting, "_BATCH", 64)
    data = GeneratorConfig(instances=64, grid=48, num_points=1024, noise=("none",))
    with pytest.raises(fitting.UnreliableModel, match="train the model longer"):
        fitting.fit_refiner(load("box"), data, 64, 128)
