"""Whole turns of the root, and the ablations of both networks: targets, outputs, corrections."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.networks import normal, variables_of
from _helpers.objectives import BOX
from _helpers.tiny import network, random_variables
from scipy.spatial.transform import Rotation

from caper_jax.config import RotationClassifierConfig
from caper_jax.estimator import estimate
from caper_jax.geometry.frames import part_points
from caper_jax.models import rotation_classes
from caper_jax.models.parts import PartsNetwork, vote
from caper_jax.models.root import RootNetwork, quaternion_axes


def test_turns_are_the_rotations_of_the_cube():
    cube = Rotation.create_group("O").as_matrix()
    found = {tuple(np.round(turn).astype(int).ravel()) for turn in rotation_classes.CUBE_ROTATIONS}
    assert found == {tuple(np.round(turn).astype(int).ravel()) for turn in cube}
    np.testing.assert_array_equal(rotation_classes.CUBE_ROTATIONS[0], np.eye(3))
    axes = sorted(
        Rotation.from_matrix(rotation_classes.CUBE_ROTATIONS[i]).magnitude()
        for i in rotation_classes.HALF_TURNS
    )
    np.testing.assert_allclose(axes, np.pi)


def test_the_turn_between_two_rotations_is_the_nearest():
    rng = np.random.default_rng(0)
    one, other = Rotation.random(50, rng=rng), Rotation.random(50, rng=rng)
    index, angle = rotation_classes.nearest_cube_rotation(
        jnp.asarray(one.as_matrix(), jnp.float32), jnp.asarray(other.as_matrix(), jnp.float32)
    )
    off = np.stack(
        [
            ((one * Rotation.from_matrix(t)).inv() * other).magnitude()
            for t in rotation_classes.CUBE_ROTATIONS
        ],
        1,
    )
    np.testing.assert_array_equal(index, off.argmin(1))
    np.testing.assert_allclose(angle, off.min(1), atol=1e-3)


def test_a_turn_must_lead_by_the_margin():
    logits = jnp.zeros((3, rotation_classes.NUM_CUBE_ROTATIONS)).at[:, 0].set(1.0)
    logits = logits.at[1, 5].set(1.9).at[2, 5].set(2.1)
    found = rotation_classes.select_rotation(logits, margin=1.0)
    for row, turn in zip(found, (0, 0, 5), strict=True):
        np.testing.assert_array_equal(row, rotation_classes.CUBE_ROTATIONS[turn])


def test_the_estimator_makes_the_turn_that_stage_two_asks_for():
    """A head with a constant answer turns every root by it, about the root's origin."""
    config = dataclasses.replace(
        network("fast", pool_first=True), rotation_classifier=RotationClassifierConfig(8)
    )
    variables = random_variables(BOX, config)
    head = variables["params"]["parts"]["turn"]
    last = head[f"Dense_{len(head) - 1}"]
    points = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, (3, 64, 3)) + [0, 0, 0.7])

    def roots(bias):
        last["kernel"], last["bias"] = jnp.zeros_like(last["kernel"]), jnp.asarray(bias)
        increments = variables["params"]["parts"]["increment"]
        for layer in increments.values():
            layer["kernel"], layer["bias"] = layer["kernel"] * 0, layer["bias"] * 0
        return estimate(variables, points.astype(jnp.float32), BOX, config).pose

    plain = roots(np.zeros(rotation_classes.NUM_CUBE_ROTATIONS, np.float32))
    bias = np.zeros(rotation_classes.NUM_CUBE_ROTATIONS, np.float32)
    bias[rotation_classes.HALF_TURNS[1]] = 5.0
    turned = roots(bias)
    expected = (
        np.asarray(plain.rotation[:, 0])
        @ rotation_classes.CUBE_ROTATIONS[rotation_classes.HALF_TURNS[1]]
    )
    np.testing.assert_allclose(turned.rotation[:, 0], expected, atol=1e-5)
    np.testing.assert_allclose(turned.translation[:, 0], plain.translation[:, 0], atol=1e-6)


def test_quaternions_give_axes_of_rotations():
    numbers = normal(20, 4)
    axes = np.asarray(quaternion_axes(jnp.asarray(numbers)))
    wxyz = numbers + np.array([1.0, 0, 0, 0])
    expected = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(axes, expected.swapaxes(-1, -2)[:, :2], atol=1e-5)


@pytest.mark.parametrize("change", [{"rotation": "quaternion"}, {"vertical_correction": False}])
def test_ablations_of_stage_one(change):
    config = dataclasses.replace(network("fast", pool_first=True), **change)
    points = normal(2, 64, 3)
    module = RootNetwork(config)
    found = jax.jit(partial(module.apply, variables_of(module, points), train=False))(points)
    right = np.abs(np.asarray((found.directions[:, 0] * found.directions[:, 1]).sum(-1)))
    if "rotation" in change:
        np.testing.assert_allclose(right, 0.0, atol=1e-5)
    else:  # the first direction stays, the second gives way
        np.testing.assert_array_equal(found.confidence, [[1.0, 0.0]] * 2)


def test_direct_joints_are_what_the_votes_come_to():
    config = dataclasses.replace(network("fast", pool_first=True), joints="direct")
    points = normal(2, 64, 3)
    module = PartsNetwork(config, num_parts=3)
    variables = variables_of(module, points)
    found, kept = module.apply(
        variables, points, train=False, capture_intermediates=lambda m, _: m.name == "joint"
    )
    (numbers,) = kept["intermediates"]["joint"]["__call__"]
    numbers = np.asarray(numbers).reshape(2, 2, 6)
    axis, pivot = vote(jnp.asarray(points), found.heatmap, found.offset, found.direction)
    length = np.linalg.norm(numbers[..., :3], axis=-1, keepdims=True)
    np.testing.assert_allclose(axis, numbers[..., :3] / length, atol=1e-4)
    np.testing.assert_allclose(pivot, numbers[..., 3:], atol=1e-5)


def test_points_of_a_part_fill_the_cloud_evenly():
    points = normal(2, 12, 3)
    chosen = np.zeros((2, 12), bool)
    chosen[0, [1, 4, 7]] = True  # of the other cloud none: it stays whole
    found = np.asarray(part_points(jnp.asarray(points), jnp.asarray(chosen)))
    np.testing.assert_array_equal(found[0], np.repeat(points[0, [1, 4, 7]], 4, axis=0))
    np.testing.assert_array_equal(found[1], points[1])
