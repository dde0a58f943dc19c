"""Readings of a cloud: what they are, their probabilities, and how these are fitted."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.tiny import network, random_scorer, random_variables
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from caper_jax import categories
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, estimate
from caper_jax.models import hypotheses
from caper_jax.models.hypotheses import ReadingScorer, log_probabilities, num_features, repeated
from caper_jax.models.refiner import StageEstimate
from caper_jax.training import fit_hypotheses

BOX = categories.get("box")


@pytest.fixture(scope="module")
def model():
    config = network("fast", pool_first=True)
    variables = random_variables(BOX, config)
    variables["params"]["hypotheses"] = random_scorer()
    return config, variables


def clouds(batch, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.uniform(-0.15, 0.15, (batch, 64, 3)) + [0.1, -0.1, 0.8]).astype(np.float32)


def test_the_answer_comes_first_and_the_rest_by_probability(model):
    config, variables = model
    four = Estimator(BOX, config, variables, hypotheses=4)(clouds(6))
    alone = Estimator(BOX, config, variables)(clouds(6))
    stated = four.hypotheses
    assert stated.probability.shape == (6, 4) and stated.pose.rotation.shape == (6, 4, 2, 3, 3)
    for found in (four, alone):
        first = jax.tree.map(lambda leaf: leaf[:, 0], found.hypotheses.pose)
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5), first, found.pose)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5), four.pose, alone.pose)
    assert (np.diff(stated.probability[:, 1:], axis=1) <= 1e-7).all()
    assert (stated.probability >= 0).all() and (stated.probability.sum(1) < 1 + 1e-5).all()
    assert (stated.rotation_class[:, 0] == 0).all()
    assert all(len(set(row)) == 4 for row in np.asarray(stated.rotation_class))
    rotation = np.asarray(stated.pose.rotation, np.float64)
    identity = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation @ rotation.swapaxes(-1, -2), identity, atol=1e-5)


@pytest.mark.parametrize("shift", [-60.0, 0.0])
def test_a_cloud_has_the_same_readings_alone_and_in_a_batch(model, shift):
    """Also where some answers are settled, so that nothing more is computed for those alone."""
    config, variables = model
    params = dict(variables["params"])
    own = {**params["hypotheses"], "sharpness": np.float32([1.0, 8.0])}
    variables = {**variables, "params": {**params, "hypotheses": own}}
    points = clouds(8)
    certain = Estimator(BOX, config, variables)(points).hypotheses.probability[:, 0]
    logits = np.log(certain) - np.log1p(-certain)
    # Half of them are settled, or none.
    own["shift"] = np.float32(5.3 - np.median(logits) + shift)
    estimator = Estimator(BOX, config, variables, hypotheses=4)
    together = estimator(points)
    settled = Estimator(BOX, config, variables)(points).hypotheses.probability[:, 0] > 0.995
    assert 0 < settled.sum() < 8 if shift == 0.0 else not settled.any()
    for i in range(8):
        one = jax.tree.map(lambda leaf: leaf[0], estimator(points[i : i + 1]))
        same = jax.tree.map(lambda leaf, i=i: leaf[i], together)
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=2e-3, atol=2e-4),
            (one.hypotheses.probability, one.hypotheses.pose.rotation),
            (same.hypotheses.probability, same.hypotheses.pose.rotation),
        )


def test_gradients_and_vmap(model):
    config, variables = model
    function = partial(estimate, category=BOX, network=config, hypotheses=3)

    def total(points):
        stated = function(variables, points).hypotheses
        return (stated.probability * stated.pose.translation.sum((-1, -2))).sum()

    assert np.isfinite(jax.jit(jax.grad(total))(clouds(2))).all()
    stacked = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), variables)
    both = jax.jit(jax.vmap(function, in_axes=(0, None)))(stacked, clouds(2))
    np.testing.assert_allclose(
        both.hypotheses.probability[0], both.hypotheses.probability[1], rtol=1e-5
    )


def test_gravity_decides_between_readings(model):
    """Of an answer that lies, gravity leaves little; and it finds the readings that stand."""
    config, variables = model
    params = {**variables["params"]}
    params["hypotheses"] = {**params["hypotheses"], "sharpness": np.float32([0.0, 0.0])}
    variables = {**variables, "params": params}
    # Stage II is not asked to turn the answer first.
    still = dataclasses.replace(config, refine_steps=0)
    function = jax.jit(partial(estimate, category=BOX, network=still, hypotheses=4))
    points = clouds(1)
    rotation = np.asarray(function(variables, points).pose.rotation)[0, 0]
    for axis in (0, 1):
        down = -rotation[:, axis]
        # Level already: gravity changes the frame the networks see, and so the answer a little.
        stated = function(variables, points, gravity=down[None]).hypotheses
        up = np.asarray(stated.pose.rotation)[0, :, 0, :, 1]
        weight = np.exp(-(1 + up @ down) / np.radians(15) ** 2) + 1e-3
        copies = stated.probability[0] < 1e-6
        likelihood = np.append(np.where(copies, 0.0, weight / 1.001), 1.0)
        wanted = likelihood / likelihood.sum()
        np.testing.assert_allclose(stated.probability[0], wanted[:-1], atol=2e-3)


def test_probabilities_are_a_softmax_with_none_of_these():
    rng = np.random.default_rng(0)
    score = rng.normal(size=(4, 5))
    params = {"none": np.float64(0.3), "sharpness": np.array([2.0, 1.0])}
    copies = np.zeros((4, 5), bool)
    copies[2, 1] = True
    found = np.exp(log_probabilities(params, score.astype(np.float32), copies))
    wanted = softmax(np.concatenate([np.where(copies, -1e3, score), np.full((1, 5), 0.6)]), axis=0)
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_readings_that_are_one_count_once():
    turns = Rotation.from_euler("y", [[0], [90], [10], [95]], degrees=True).as_matrix()
    root = np.tile(np.eye(4), (4, 1, 1, 1))
    root[:, 0, :3, :3] = turns
    nothing = np.zeros((4, 1, 1))
    estimate = StageEstimate(jnp.asarray(root), *[nothing] * 5)
    np.testing.assert_array_equal(repeated(estimate)[:, 0], [False, False, True, True])


def test_numbers_of_readings(model):
    config, variables = model
    with pytest.raises(CaperError, match="from 1 to 4, got 5"):
        Estimator(BOX, config, variables, hypotheses=5)
    plain = random_variables(BOX, config)
    assert Estimator(BOX, config, plain)(clouds(1)).hypotheses is None
    with pytest.raises(CaperError, match=r"not fitted to state 4 hypotheses.*caper calibrate"):
        Estimator(BOX, config, plain, hypotheses=4)


def made_up(samples, seed, shift=0.0):
    """Readings whose rightness follows from their first feature: one of four, or none."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(samples, 4, num_features(2))).astype(np.float32)
    features[..., 4:] = 0.0
    odds = np.concatenate([2.0 * features[..., 0], np.full((samples, 1), shift)], -1)
    chance = softmax(odds, axis=-1)
    pick = (rng.random((samples, 1)) > np.cumsum(chance, -1)).sum(-1)
    data = {
        "features": features,
        "rotation_class": np.tile(np.arange(4, dtype=np.int32), (samples, 1)),
        "repeated": np.zeros((samples, 4), bool),
        "right": np.arange(4) == pick[:, None],
    }
    return data, chance


def test_fitted_probabilities_are_the_true_ones(monkeypatch):
    monkeypatch.setattr(fit_hypotheses, "_STEPS", 1000)
    monkeypatch.setattr(fit_hypotheses, "_DRAWN", 256)
    params = random_scorer()
    data, _ = made_up(6000, 0)
    fitted = fit_hypotheses.fit_scorer(params, data, 0)
    fitted = fit_hypotheses.with_temperatures(fitted, made_up(3000, 1)[0])
    unseen, chance = made_up(2000, 2)
    score, alone = ReadingScorer().apply(
        {"params": fitted}, unseen["features"], unseen["rotation_class"]
    )
    found = np.exp(log_probabilities(fitted, score.T, unseen["repeated"].T)).T
    assert np.abs(found - chance).mean() < 0.06
    assert np.abs(found[:, 0].mean() - unseen["right"][:, 0].mean()) < 0.03
    assert np.abs(jax.nn.sigmoid(alone[:, 0]).mean() - unseen["right"][:, 0].mean()) < 0.03


def test_a_reading_is_right_within_30_degrees_of_every_part():
    truth = Rotation.from_euler("x", [[0], [20]], degrees=True).as_matrix()
    category = dataclasses.replace(BOX, symmetries=())

    def judged(turns):
        pose = dataclasses.make_dataclass("Pose", ["rotation", "size"])(
            jnp.asarray(
                Rotation.from_euler("x", np.reshape(turns, (2, 1)), degrees=True).as_matrix()
                @ truth
            )[None],
            None,
        )
        batch = dataclasses.make_dataclass("Frames", ["pose"])(
            dataclasses.make_dataclass("Pose", ["rotation", "size"])(jnp.asarray(truth)[None], None)
        )
        return bool(fit_hypotheses.right(pose, batch, category)[0])

    assert judged([29, 0]) and judged([0, -29])
    assert not judged([31, 0]) and not judged([0, 31])
    assert hypotheses.RIGHT_DEG == 30.0
