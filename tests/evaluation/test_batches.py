"""Errors of batches on the device, of several models and seeds at once."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from _helpers import tiny
from _helpers.frames import random_pose

from caper_jax import categories
from caper_jax.config import GeneratorConfig
from caper_jax.data.types import Batch
from caper_jax.errors import CaperError
from caper_jax.estimator import Prediction, estimate
from caper_jax.evaluation import batches
from caper_jax.evaluation.metrics import pose_errors, pose_errors_up_to_symmetry
from caper_jax.synthetic.frames import Generator, collect_frames

BOX = categories.get("box")
NETWORK = tiny.network()
CONFIG = GeneratorConfig(instances=6, grid=24, num_points=64)
MODELS = [tiny.random_variables(BOX, NETWORK, seed) for seed in (0, 1)]
STACKED = jax.tree.map(lambda *leaves: np.stack(leaves), *MODELS)


@pytest.fixture(scope="module")
def generator():
    return Generator(BOX, CONFIG, "test", 3)


def test_models_and_seeds_at_once_are_one_by_one_on_the_frames_of_generate(generator):
    """26 frames are a full draw and a part of another; errors in float64 are the oracle."""
    frames, seeds = 26, (0, 7)
    found = batches.evaluate_models(generator, BOX, NETWORK, STACKED, frames, seeds, True)
    assert found.rotation_deg.shape == (2, 2, frames, 2) and found.state.shape == (2, 2, frames, 1)
    compiled = batches._errors_of_draw._cache_size()
    batches.evaluate_models(generator, BOX, NETWORK, STACKED, 1, seeds, True)
    assert batches._errors_of_draw._cache_size() == compiled
    predict = jax.jit(lambda v, points: estimate(v, points, BOX, NETWORK).pose)
    for s, seed in enumerate(seeds):
        drawn = collect_frames(generator, seed, frames)
        for m, variables in enumerate(MODELS):
            pose = jax.device_get(predict(variables, drawn["points"]))
            expected = pose_errors_up_to_symmetry(pose, drawn["pose"], BOX)
            for name, values in vars(expected).items():
                one = getattr(found, name)[m, s]
                # Random weights magnify the rounding of a few frames.
                alike = np.isclose(one, values, rtol=1e-3, atol=2e-3, equal_nan=True)
                assert alike.mean() > 0.95, name


def test_the_truth_scores_perfectly_and_failures_the_worst(monkeypatch):
    truth = random_pose(5)
    points = np.random.default_rng(0).normal(size=(5, 64, 3)).astype(np.float32)

    def know(variables, points, category, network):
        pose = jax.tree.map(np.array, truth)
        pose.joint_state[3] = np.nan
        return Prediction(pose, *[points] * 10)

    monkeypatch.setattr(batches, "estimate", know)
    batch = Batch(points, None, truth)
    run = jax.jit(lambda batch: batches.frame_errors({}, batch, BOX, NETWORK))
    errors = jax.device_get(run(batch))
    failed = np.arange(5) == 3
    for key in ("rotation_deg", "translation_m", "axis_deg", "pivot_m", "state"):
        np.testing.assert_allclose(getattr(errors, key)[~failed], 0, atol=1e-5, err_msg=key)
    np.testing.assert_allclose(errors.iou_full[~failed], 1, atol=1e-5)
    expected = pose_errors(truth, truth, BOX, failed)
    for key, values in vars(expected).items():
        np.testing.assert_allclose(getattr(errors, key)[3], values[3], rtol=1e-5, err_msg=key)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 0}, "nothing to evaluate: 0 frames of 1 seeds"),
        ({"seeds": ()}, "nothing to evaluate: 4 frames of 0 seeds"),
        ({"category": categories.get("laptop")}, "draws 'box', the models know 'laptop'"),
        (
            {"network": dataclasses.replace(NETWORK, num_points=128)},
            r"draws 64 points per frame, the networks see 128",
        ),
        ({"variables": MODELS[0]}, "stacked on a leading axis"),
    ],
)
def test_mistakes_are_named(generator, changes, message):
    arguments = {"category": BOX, "network": NETWORK, "variables": STACKED, "frames": 4}
    with pytest.raises(CaperError, match=message):
        batches.evaluate_models(generator, **(arguments | changes))
