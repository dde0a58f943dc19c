"""Gravity: clouds are leveled by it, and what stands is not read as lying."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.tiny import network, random_variables
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.config import GeneratorConfig
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load
from caper_jax.geometry.frames import CUBE_ROTATIONS, level_rotation
from caper_jax.models.gravity import class_log_weights, upright_log_weight
from caper_jax.synthetic.frames import Generator

BOX = categories.get("box")
ROLLS = (0.0, 37.0, 90.0, 180.0)


def roll(degrees):
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix().astype(np.float32)


def test_leveling_turns_gravity_down_the_image_and_nothing_else():
    gravity = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    level = np.asarray(level_rotation(gravity))
    np.testing.assert_allclose(
        level @ level.swapaxes(-1, -2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-6
    )
    np.testing.assert_allclose(level[:, :, 2], np.tile([0, 0, 1], (20, 1)), atol=1e-6)
    down = (level @ gravity[..., None])[..., 0]
    np.testing.assert_allclose(down[:, 0], 0.0, atol=1e-5)
    assert (down[:, 1] > 0).all()


@pytest.mark.parametrize("gravity", [(0, 0, 0), (0, 0, 1), (0.02, 0.02, -1)])
def test_unknown_gravity_and_gravity_along_the_view_level_nothing(gravity):
    np.testing.assert_array_equal(level_rotation(jnp.array([gravity], jnp.float32))[0], np.eye(3))
    slope = jax.jacobian(level_rotation)(jnp.array([gravity], jnp.float32))
    assert np.isfinite(slope).all()


def test_what_stands_must_be_upright():
    gravity = jnp.array([0.0, 1.0, 0.0])
    tilts = Rotation.from_euler("x", [[0], [10], [90], [180]], degrees=True) * Rotation.from_euler(
        "z", 180, degrees=True
    )  # y up is against gravity, which is along y in the camera
    tilts = tilts.as_matrix().astype(np.float32)
    weights = np.asarray(upright_log_weight(tilts, gravity, BOX))
    # A normal distribution of 15 deg, with a chance of one in a thousand to lie.
    expected = [0.0, -0.5 * (10 / 15) ** 2, np.log(1e-3), np.log(1e-3)]
    np.testing.assert_allclose(weights, expected, atol=0.01)
    np.testing.assert_array_equal(upright_log_weight(tilts, 0 * gravity, BOX), 0.0)
    lying = dataclasses.replace(BOX, stands=False)
    np.testing.assert_array_equal(upright_log_weight(tilts, gravity, lying), 0.0)


def test_weights_of_rotation_classes_are_those_of_the_rotated_roots():
    rotation = Rotation.random(3, random_state=0).as_matrix()
    gravity = Rotation.random(3, random_state=1).as_matrix()[:, 0]
    weights = class_log_weights(jnp.asarray(rotation), jnp.asarray(gravity), BOX)
    for t in (0, 5, 17):
        one = upright_log_weight(jnp.asarray(rotation @ CUBE_ROTATIONS[t]), gravity, BOX)
        np.testing.assert_allclose(weights[:, t], one, atol=1e-5)


def test_stapler_scissors_eyeglasses_and_cutter_lie_as_they_like():
    lying = {name for name in categories.names() if not categories.get(name).stands}
    assert lying == {"stapler", "scissors", "eyeglasses", "cutter"}


def test_any_camera_roll_gives_the_same_estimate():
    config = network("fast", pool_first=True)
    estimator = Estimator(BOX, config, random_variables(BOX, config))
    rng = np.random.default_rng(0)
    points = (rng.uniform(-0.15, 0.15, (8, 64, 3)) + [0.1, -0.1, 0.8]).astype(np.float32)
    down = np.float32([0.1, 0.9, 0.3])
    poses = []
    for degrees in ROLLS:
        turn = roll(degrees)
        pose = estimator(points @ turn.T, gravity=turn @ down).pose
        poses.append((turn.T @ np.asarray(pose.rotation), np.asarray(pose.translation) @ turn))
    for rotation, translation in poses[1:]:
        turned = np.abs(rotation - poses[0][0]).max((1, 2, 3))
        moved = np.abs(translation - poses[0][1]).max((1, 2))
        # A point that rounding moves to another row of the scan may change what is looked at.
        assert np.sort(turned)[5] < 2e-3 and np.sort(moved)[5] < 1e-3
    turn = roll(90)
    without = np.asarray(estimator(points @ turn.T).pose.rotation)
    assert np.abs(turn.T @ without - poses[0][0]).max() > 0.05


@pytest.mark.parametrize("name", ["box", "cutter"])
def test_the_shipped_models_see_with_any_roll(name):
    """Generated frames have level cameras, within 15 deg: gravity levels them, too."""
    category = categories.get(name)
    config = GeneratorConfig(instances=12, noise=("kinect",))
    batch = Generator(category, config, "test").batch(jax.random.key(0), 12)
    estimator = load(name)
    points, truth = np.asarray(batch.points), np.asarray(batch.pose.rotation[:, 0])
    down = -truth[:, :, "xyz".index(category.viewpoint.up)]
    medians = []
    for degrees in (0.0, 90.0, 180.0):
        turn = roll(degrees)
        pose = estimator(points @ turn.T, gravity=down @ turn.T).pose
        off = Rotation.from_matrix(turn.T @ np.asarray(pose.rotation[:, 0])).inv()
        angle = np.degrees((off * Rotation.from_matrix(truth)).magnitude())
        medians.append(np.median(angle))
    np.testing.assert_allclose(medians, medians[0], atol=0.2)
    assert medians[0] < 1.5


@pytest.mark.parametrize(
    ("gravity", "named"),
    [
        ((0, 0, 0), "must be a direction"),
        ((0, np.nan, 1), "must be a direction"),
        ((0, 1), "three numbers"),
        (np.ones((3, 3)), "each of 2 clouds"),
        ("down", "three numbers"),
        (5.0, "three numbers"),
    ],
)
def test_what_is_no_direction_is_named(gravity, named):
    config = network("fast")
    estimator = Estimator(BOX, config, random_variables(BOX, config))
    points = np.random.default_rng(0).uniform(0.5, 0.8, (2, 64, 3))
    with pytest.raises(CaperError, match=named):
        estimator(points, gravity=gravity)
