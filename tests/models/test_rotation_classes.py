"""Whole turns of the root, and the ablations of both networks: targets, outputs, corrections."""

from __future__ import annotations

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.networks import normal, variables_of
from _helpers.objectives import BOX, CABINET, DEEP, THIN, frames
from _helpers.tiny import network, random_variables
from scipy.spatial.transform import Rotation

from caper_jax.config import LossConfig, RotationClassifierConfig
from caper_jax.estimator import estimate
from caper_jax.geometry.frames import part_points
from caper_jax.lie import so3
from caper_jax.models import rotation_classes
from caper_jax.models.parts import PartsNetwork, vote
from caper_jax.models.root import RootNetwork, quaternion_axes
from caper_jax.training.objective import Objective


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


def turning_task(category=BOX, **config):
    sizes = dataclasses.replace(
        network("fast", pool_first=True), rotation_classifier=RotationClassifierConfig(8)
    )
    return Objective(category, sizes, LossConfig(**config))


def predicting(made, batch, turn):
    """Truth in the networks' frame; the task's stage I answers with it after a turn."""
    truth = made._targets(batch.pose, jnp.broadcast_to(jnp.eye(3), (len(batch.points), 3, 3)))
    made._root_rotation = lambda _: truth.rotation[:, 0] @ turn
    return truth, SimpleNamespace(translation=truth.translation[:, 0])


def test_references_are_turned_on_purpose_and_say_so():
    batch = frames(BOX, [DEEP] * 200)
    made = turning_task(turned=0.4, root_noise_deg=1.0, predicted_root=0.0)
    truth, output = predicting(made, batch, np.eye(3, dtype=np.float32))
    key = jax.random.key(0)
    reference, turn = made._noisy_root(key, output, truth)
    assert not np.asarray(turn).any()
    reference, turn = made._turned(key, reference, turn)
    turn = np.asarray(turn)
    assert 0.3 < (turn > 0).mean() < 0.5
    assert 0.4 < np.isin(turn[turn > 0], rotation_classes.HALF_TURNS).mean() < 0.8
    mended = np.asarray(reference)[:, :3, :3] @ rotation_classes.CUBE_ROTATIONS[turn]
    off = so3.geodesic_distance(jnp.asarray(mended), truth.rotation[:, 0])
    assert np.degrees(off).max() < 30  # the noise alone


def test_predictions_that_are_turned_are_references_with_their_turn():
    batch = frames(BOX, [DEEP] * 100)
    made = turning_task(predicted_root=1.0)
    half = np.diag([-1.0, 1.0, -1.0]).astype(np.float32)  # about y
    truth, output = predicting(made, batch, half)
    reference, turn = made._noisy_root(jax.random.key(0), output, truth)
    np.testing.assert_array_equal(
        rotation_classes.CUBE_ROTATIONS[np.asarray(turn)], np.tile(half, (100, 1, 1))
    )
    np.testing.assert_allclose(reference[:, :3, :3], truth.rotation[:, 0] @ half, atol=1e-6)


def test_only_turn_and_increment_are_learned_from_turned_references():
    """With every reference turned, nothing else of stage II has a slope."""
    made = turning_task(CABINET, turned=1.0, predicted_root=0.0)
    batch = frames(CABINET, np.array([CABINET.mean_size] * 2), count=64)
    variables = made.init(jax.random.key(0))
    state = {name: value for name, value in variables.items() if name != "params"}
    slopes = jax.jit(jax.grad(lambda p: made.loss(p, state, batch, jax.random.key(1), 0.0)[0]))(
        variables["params"]
    )["parts"]
    largest = {name: max(np.abs(x).max() for x in jax.tree.leaves(slopes[name])) for name in slopes}
    assert {name for name, value in largest.items() if value > 0} == {
        "encoder",
        "increment",
        "turn",
    }


def test_what_is_logged_is_of_references_that_are_not_turned(monkeypatch):
    made = turning_task(CABINET)
    batch = frames(CABINET, np.array([CABINET.mean_size] * 3), count=64)
    variables = made.init(jax.random.key(0))
    state = {name: value for name, value in variables.items() if name != "params"}
    found = {"state": jnp.array([1.0, 9.0, 2.0])}, {"state1_unit": jnp.array([3.0, 9.0, 5.0])}
    monkeypatch.setattr(made, "_parts_losses", lambda *_: found)

    def logged(*turn):
        monkeypatch.setattr(made, "_turned", lambda _, reference, __: (reference, jnp.array(turn)))
        metrics = made.loss(variables["params"], state, batch, jax.random.key(1), 0.0)[1][1]
        return float(metrics["state"]), float(metrics["state1_unit"])

    assert logged(0, 7, 0) == (1.5, 4.0)
    assert logged(7, 7, 7) == (0.0, 0.0)


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
    made = Objective(BOX, config, LossConfig())
    assert set(made._root_losses(found, frames(BOX, [THIN, THIN]).pose)) == {
        "rotation",
        "translation",
    }


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


def test_direct_joints_find_back_from_the_opposite_axis():
    """The loss of a unit vector has no slope there."""
    config = dataclasses.replace(network("fast", pool_first=True), joints="direct")
    made = Objective(BOX, config, LossConfig())
    batch = frames(BOX, [DEEP, DEEP])
    truth = made._targets(batch.pose, jnp.broadcast_to(jnp.eye(3), (2, 3, 3)))
    ones = jnp.ones(batch.labels.shape)[..., None]

    def loss(axis):
        output = SimpleNamespace(
            segmentation=jnp.zeros((*batch.labels.shape, 2)),
            heatmap=ones,
            offset=truth.joint_pivot[:, None] - batch.points[:, :, None],
            direction=jnp.broadcast_to(axis[:, None], (*ones.shape, 3)),
            state=truth.joint_state,
            size=truth.size,
            center=truth.box_center,
        )
        parts, _ = made._parts_losses(batch.points, output, truth, batch.labels)
        assert "heatmap" not in parts and "offset" not in parts
        return parts["direction"].sum()

    slope = jax.grad(loss)(-truth.joint_axis)
    assert (np.asarray((slope * truth.joint_axis).sum(-1)) < -0.1).all()


def test_points_of_a_part_fill_the_cloud_evenly():
    points = normal(2, 12, 3)
    chosen = np.zeros((2, 12), bool)
    chosen[0, [1, 4, 7]] = True  # of the other cloud none: it stays whole
    found = np.asarray(part_points(jnp.asarray(points), jnp.asarray(chosen)))
    np.testing.assert_array_equal(found[0], np.repeat(points[0, [1, 4, 7]], 4, axis=0))
    np.testing.assert_array_equal(found[1], points[1])
