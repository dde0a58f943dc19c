"""Eqs 17-23 as corrected in the errata, against numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caper_jax.config import preset
from caper_jax.training import losses

Z = [0.0, 0.0, 1.0]


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def units(*shape, seed=0):
    vectors = normal(*shape, 3, seed=seed)
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def array(values):
    return jnp.asarray(values, jnp.float32)


def turned(degrees):
    """z turned by an angle about x, and about the diagonal of x and y."""
    angle = math.radians(degrees)
    axes = np.array([[1, 0, 0], [math.sqrt(0.5), math.sqrt(0.5), 0]])
    return Rotation.from_rotvec(angle * axes).apply(Z)


def test_rotation_and_translation_take_the_mean_over_components():
    truth = array([[[0, 1, 0], Z]])
    predicted = array([[[0.3, 1, 0], [0, -0.6, 1]]])
    assert losses.rotation_loss(predicted, truth) == pytest.approx(0.3 / 3 + 0.6 / 3)
    shift = losses.translation_loss(array([[1, 2, 3], [0, 0, 0]]), array([[1, 0, -1], [0, 0, 0]]))
    np.testing.assert_allclose(shift, [(2 + 4) / 3, 0], rtol=1e-6)


def test_confidence_is_half_at_12_9_degrees():
    """And 0.66 at 10, 0.19 at 20: the constants of the public code (errata, Eq 18)."""
    for degrees, expected in ((0, 1.0), (10, 0.66), (12.9, 0.5), (20, 0.19), (180, 0.0)):
        predicted = array(turned(degrees)[None])
        target = array([[Z, Z]])
        # Where the confidence is right, no other confidence is.
        right, low, high = (
            losses.confidence_loss(array([[c, c]]), predicted, target)[0]
            for c in (expected, expected - 0.2, expected + 0.2)
        )
        assert right < 0.012
        np.testing.assert_allclose([low, high], 0.4, atol=0.012)


def test_each_confidence_is_paired_with_its_own_direction():
    predicted = array([[Z, [1, 0, 0]]])
    target = array([[Z, [0, 1, 0]]])  # the first is right, the second 90 deg off
    paired = losses.confidence_loss(array([[1.0, 0.0]]), predicted, target)
    crossed = losses.confidence_loss(array([[0.0, 1.0]]), predicted, target)
    np.testing.assert_allclose(paired, 0.0, atol=1e-6)
    np.testing.assert_allclose(crossed, 2.0, atol=1e-6)


def test_confidences_of_both_directions_add_up_as_directions_do():
    """Eq 18 sums over the two, like Eq 17; against the sum in float64."""
    rng = np.random.default_rng(0)
    predicted, target = np.asarray(units(5, 2)), np.asarray(units(5, 2, seed=1))
    predicted = target + 0.2 * predicted
    confidence = rng.uniform(size=(5, 2))
    goodness = np.exp(-13.7 * np.square(predicted - target).sum(-1, dtype=np.float64))
    expected = np.abs(confidence - goodness).sum(-1)
    got = losses.confidence_loss(array(confidence), predicted, target)
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_the_fast_preset_weighs_the_mean_over_both_directions():
    """Half of the sum: bit for bit the total that the shipped models were trained with."""
    predicted, target = units(64, 2), units(64, 2, seed=1)
    predicted = target + 0.1 * predicted
    confidence = jax.nn.sigmoid(normal(64, 2, seed=2))
    shift = normal(64, 3, seed=3)
    weights = preset("fast").loss.weights
    terms = {
        "rotation": losses.rotation_loss(predicted, target),
        "translation": losses.translation_loss(shift, jnp.zeros_like(shift)),
        "confidence": losses.confidence_loss(confidence, predicted, target),
    }
    mean = jnp.abs(confidence - jnp.exp(-13.7 * ((predicted - target) ** 2).sum(-1))).mean(-1)
    by_mean = losses.weighted_total(
        dataclasses.replace(weights, confidence=1.0), terms | {"confidence": mean}
    )
    np.testing.assert_array_equal(losses.weighted_total(weights, terms), by_mean)


def test_confidence_teaches_the_directions_too():
    """The target is not detached: a confident head pulls its direction to the truth."""
    predicted = array(turned(10)[None])
    target = array([[Z, Z]])
    gradient = jax.grad(lambda d: losses.confidence_loss(array([[0.99, 0.99]]), d, target).sum())(
        predicted
    )
    assert ((gradient * (target - predicted)).sum(-1) < 0).all()


def test_axis_offsets_lead_to_the_foot_on_the_line():
    points, pivot, axis = normal(2, 30, 3), normal(2, 4, 3, seed=1), units(2, 4, seed=2)
    offsets = losses.axis_offsets(*map(array, (points, axis, pivot)))
    feet = points[:, :, None] + offsets
    np.testing.assert_allclose(np.cross(feet - pivot[:, None], axis[:, None]), 0, atol=1e-5)
    np.testing.assert_allclose((offsets * axis[:, None]).sum(-1), 0, atol=1e-5)
    slid = losses.axis_offsets(*map(array, (points, axis, pivot + 3 * axis)))
    np.testing.assert_allclose(slid, offsets, atol=1e-5)  # any point of the line is its pivot


@pytest.mark.parametrize("kind", ["exponential", "scaled", "linear"])
def test_heatmap_is_gated_per_joint(kind):
    """D_max is each joint's own: 10 for the first joint, 100 for the second."""
    distance = np.zeros((1, 4, 2), np.float32)
    distance[0, :, 0] = [0.0, 1.0, 1.99, 10.0]
    distance[0, :, 1] = [0.0, 2.5, 20.01, 100.0]
    value = {
        "exponential": lambda d, reach: math.exp(-d),
        "scaled": lambda d, reach: math.exp(-d / reach),
        "linear": lambda d, reach: 1 - d / reach,
    }[kind]
    expected = [
        [value(0, 2), value(0, 20)],
        [value(1, 2), value(2.5, 20)],
        [value(1.99, 2), 0.0],
        [0.0, 0.0],
    ]
    heatmap = losses.heatmap_target(array(distance), kind)
    np.testing.assert_allclose(heatmap[0], expected, rtol=1e-5, atol=1e-6)
    double = losses.heatmap_target(array(distance), kind, gate=0.4)
    assert double[0, 2, 1] > 0


def test_heatmap_of_a_cloud_on_the_axis_is_finite():
    assert np.isfinite(losses.heatmap_target(jnp.zeros((1, 5, 1)), "linear")).all()


def test_offsets_count_where_points_vote():
    target = jnp.zeros((2, 3, 2, 3))
    predicted = np.zeros((2, 3, 2, 3), np.float32)
    predicted[0, 0, 0] = [3.0, 0.0, 0.0]  # votes
    predicted[0, 1, 0] = [9.0, 9.0, 9.0]  # does not
    heatmap = np.zeros((2, 3, 2), np.float32)
    heatmap[:, 0, 0] = heatmap[:, 2, 0] = 0.5
    # One of two voters is off by a mean of 1; the second joint has no voters and adds nothing.
    np.testing.assert_allclose(
        losses.offset_loss(array(predicted), target, array(heatmap)), [0.25, 0.0], rtol=1e-6
    )
    np.testing.assert_allclose(
        losses.heatmap_loss(array(heatmap), jnp.zeros((2, 3, 2))), [1 / 6, 1 / 6], rtol=1e-6
    )


def test_location_is_the_distance_from_the_line():
    axis = array([[Z, Z]])
    pivot = array([[[3, 4, 7], [3, 4, 7]]])  # 5 from the z axis
    for revolute, expected in (((True, True), 5.0), ((True, False), 2.5), ((False, False), 0.0)):
        loss = losses.location_loss(pivot, axis, jnp.zeros((1, 2, 3)), revolute)
        np.testing.assert_allclose(loss, expected, rtol=1e-6)


def test_location_has_a_finite_gradient_on_the_line():
    def total(pivot):
        return losses.location_loss(pivot, array([[Z]]), jnp.zeros((1, 1, 3)), (True,)).sum()

    on, off = array([[[0, 0, 2.0]]]), array([[[0, 0.1, 2.0]]])
    assert total(on) == 0
    np.testing.assert_array_equal(jax.grad(total)(on), np.zeros((1, 1, 3)))
    np.testing.assert_allclose(jax.grad(total)(off), [[[0, 1, 0]]], atol=1e-6)


def test_state_with_the_wrong_sign_costs_twenty_times():
    """Per joint, and a product of exactly zero counts as wrong (errata, Eq 20)."""
    state, truth = array([[0.5, -0.5, 0.0, 0.2]]), array([[0.3, 0.3, 0.1, 0.2]])
    expected = (0.2 + 20 * 0.8 + 20 * 0.1 + 0.0) / 4
    np.testing.assert_allclose(losses.state_loss(state, truth), expected, rtol=1e-6)
    plain = losses.state_loss(state, truth, penalty=1.0)
    np.testing.assert_allclose(plain, (0.2 + 0.8 + 0.1) / 4, rtol=1e-6)


def test_direction_and_scale_are_mean_absolute_differences():
    one, other = normal(2, 3, 3), normal(2, 3, 3, seed=1)
    expected = np.abs(one - other).reshape(2, 9).mean(1)
    for loss in (losses.direction_loss, losses.scale_loss):
        np.testing.assert_allclose(loss(one, other), expected, rtol=1e-6)


def test_segmentation_is_cross_entropy_without_unlabeled_points():
    logits = normal(2, 5, 3)
    labels = jnp.array([[0, 1, 2, -1, -1], [2, 2, -1, 0, 1]])
    odds = np.exp(logits)
    probability = odds / odds.sum(-1, keepdims=True)
    expected = [
        np.mean([-math.log(probability[b, n, k]) for n, k in enumerate(labels[b]) if k >= 0])
        for b in range(2)
    ]
    np.testing.assert_allclose(losses.segmentation_loss(logits, labels), expected, rtol=1e-5)
    assert (losses.segmentation_loss(logits, jnp.full((2, 5), -1)) == 0).all()


def test_twist_adds_the_mean_of_each_half():
    loss = losses.twist_loss(array([[1, 0, 2, 0, 0, 0]]), array([[0, 0, 0, 0, -6, 3]]))
    np.testing.assert_allclose(loss, 3 / 3 + 9 / 3)


def test_weights_of_the_paper():
    """8 rotation + 10 translation + 1 confidence + ... (errata, Eq 22)."""
    paper = {
        "rotation": 8,
        "translation": 10,
        "confidence": 1,
        "location": 1,
        "direction": 1,
        "state": 6,
        "scale": 1,
        "segmentation": 0.1,
        "twist": 1,
    }
    weights = losses.LossWeights()
    assert {name: getattr(weights, name) for name in paper} == paper
    ones = {name: jnp.ones(2) for name in paper}
    np.testing.assert_allclose(losses.weighted_total(weights, ones), sum(paper.values()), rtol=1e-6)
    doubled = dataclasses.replace(weights, state=12.0)
    np.testing.assert_allclose(losses.weighted_total(doubled, {"state": jnp.ones(1)}), 12.0)


def exact_cases():
    """Every loss at the truth: (function of the prediction, the right prediction)."""
    directions, joints, points = units(2, 2), units(2, 3, seed=1), normal(2, 9, 3, seed=2)
    pivot, state = normal(2, 3, 3, seed=3), jnp.abs(normal(2, 3, seed=4))
    offsets = losses.axis_offsets(points, joints, pivot)
    heatmap = losses.heatmap_target(jnp.linalg.norm(offsets, axis=-1))
    certain = jnp.ones((2, 2))
    return {
        "rotation": (lambda x: losses.rotation_loss(x, directions), directions),
        "translation": (lambda x: losses.translation_loss(x, pivot[:, 0]), pivot[:, 0]),
        "confidence": (lambda x: losses.confidence_loss(x, directions, directions), certain),
        "confident direction": (
            lambda x: losses.confidence_loss(certain, x, directions),
            directions,
        ),
        "heatmap": (lambda x: losses.heatmap_loss(x, heatmap), heatmap),
        "offset": (lambda x: losses.offset_loss(x, offsets, heatmap), offsets),
        "location": (lambda x: losses.location_loss(x, joints, pivot, (True,) * 3), pivot),
        "direction": (lambda x: losses.direction_loss(x, joints), joints),
        "state": (lambda x: losses.state_loss(x, state), state),
        "scale": (lambda x: losses.scale_loss(x, pivot), pivot),
        "twist": (lambda x: losses.twist_loss(x, normal(2, 6)), normal(2, 6)),
    }


def test_the_truth_costs_nothing_and_has_finite_gradients():
    cases = exact_cases()
    labels = jnp.array([[0, 1, -1]])
    logits = 1e4 * np.eye(2, dtype=np.float32)[labels]
    cases["segmentation"] = (lambda x: losses.segmentation_loss(x, labels), logits)

    @jax.jit
    def differentiate(truths):
        return {
            name: jax.value_and_grad(lambda x, loss=loss: loss(x).sum())(truths[name])
            for name, (loss, _) in cases.items()
        }

    results = differentiate({name: array(truth) for name, (_, truth) in cases.items()})
    for name, (value, gradient) in results.items():
        assert value == 0, name
        assert np.isfinite(gradient).all(), name
