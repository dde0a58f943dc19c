"""Evaluation of models: one program of estimate and errors, on any batches and devices."""

from __future__ import annotations

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers import tiny

import caper_jax as caper
from caper_jax import categories
from caper_jax.config import GeneratorConfig
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation import batches, protocol
from caper_jax.evaluation.loading import frame_batches
from caper_jax.evaluation.metrics import PoseErrors, pose_errors
from caper_jax.synthetic.dataset import GeneratedDataset
from caper_jax.synthetic.frames import Generator, collect_frames
from caper_jax.training.parallel import data_mesh

BOX = categories.get("box")
NETWORK = tiny.network()
FRAMES = 40
CONFIG = GeneratorConfig(instances=6, grid=24, num_points=64, measure_visibility=True)
MODEL = Estimator(BOX, NETWORK, tiny.random_variables(BOX, NETWORK))


@pytest.fixture(scope="module")
def generator():
    return Generator(BOX, CONFIG, "test", 3)


@pytest.fixture(scope="module")
def found(generator):
    return caper.evaluate(generator, MODEL, frames=FRAMES, seed=5)


class Mean(Estimator):
    """The truth of one frame, moved to the middle of the points: no network, no rounding of one."""

    def __init__(self, truth):
        self.category, self.network, self.variables = BOX, NETWORK, {}
        self.function = lambda variables, points: types.SimpleNamespace(
            pose=jax.tree.map(
                lambda leaf: jnp.broadcast_to(leaf, (len(points), *leaf.shape)), truth
            ).replace(translation=jnp.broadcast_to(points.mean(1)[:, None], (len(points), 2, 3))),
            plausible=points[:, 0, 0] > 0,
        )


def test_generated_frames_are_those_of_generate(generator):
    dataset = GeneratedDataset(generator, FRAMES, 5)
    drawn = collect_frames(generator, 5, FRAMES)
    for index in (0, 39, 24, 25):
        frame = dataset[index]
        np.testing.assert_array_equal(frame.points, drawn["points"][index])
        np.testing.assert_array_equal(frame.visibility, drawn["visibility"][index])
        np.testing.assert_array_equal(frame.truth.rotation, drawn["pose"].rotation[index])
    assert len(dataset) == FRAMES == len(set(dataset.names))
    with pytest.raises(IndexError):
        dataset[FRAMES]


def test_errors_are_those_of_the_poses_that_are_kept(found, generator):
    """In float64, from the kept estimates; and the truth is that of the frames."""
    drawn = collect_frames(generator, 5, FRAMES)
    jax.tree.map(np.testing.assert_array_equal, found.truth, drawn["pose"])
    np.testing.assert_array_equal(found.visibility, drawn["visibility"])
    expected = pose_errors(found.estimate, found.truth, BOX, found.failed)
    for key, values in vars(expected).items():
        np.testing.assert_allclose(
            getattr(found.errors, key), values, rtol=1e-4, atol=1e-4, err_msg=key
        )
    assert found.seconds_per_frame > 0 and not found.failed.any()


def test_a_model_is_evaluated_as_what_calls_it_and_as_one_of_many(found, generator):
    predictor = protocol.model_predictor(MODEL)
    called = protocol.evaluate(generator, predictor, FRAMES, num_points=64, seed=5)
    stacked = jax.tree.map(lambda leaf: leaf[None], MODEL.variables)
    many = batches.evaluate_models(generator, BOX, NETWORK, stacked, FRAMES, (5,))
    for field in dataclasses.fields(PoseErrors):
        values = getattr(found.errors, field.name)
        for other in (getattr(called.errors, field.name), getattr(many, field.name)[0, 0]):
            # Random weights magnify the rounding of a few frames.
            alike = np.isclose(values, other, rtol=1e-3, atol=2e-3, equal_nan=True)
            assert alike.mean() > 0.95, field.name
    np.testing.assert_array_equal(found.plausible, called.plausible)


@pytest.mark.parametrize(("batch_size", "devices"), [(7, 1), (3, 8), (64, 3)])
def test_no_figure_depends_on_batches_or_devices(generator, batch_size, devices):
    model = Mean(GeneratedDataset(generator, 1)[0].truth)
    one = protocol.evaluate(generator, model, FRAMES, FRAMES, devices=jax.devices()[:1])
    other = protocol.evaluate(generator, model, FRAMES, batch_size, devices=jax.devices()[:devices])
    assert one.names == other.names and 0 < one.plausible.mean() < 1
    np.testing.assert_array_equal(one.plausible, other.plausible)
    for errors in ("errors", "symmetric_errors"):
        for key, values in vars(getattr(one, errors)).items():
            assert values.shape[0] == FRAMES
            np.testing.assert_allclose(
                getattr(getattr(other, errors), key), values, rtol=1e-6, atol=1e-6
            )


def test_programs_run_on_the_devices_given(generator):
    dataset = GeneratedDataset(generator, 4)
    model = Mean(dataset[0].truth)
    (batch,) = frame_batches(dataset, 4, 4, 64)
    for devices in (jax.devices()[2:3], jax.devices()[4:6]):
        step = protocol._EstimatorStep(model, BOX, data_mesh(devices))
        assert step.predict(batch).failed.devices() == set(devices)


def test_frames_without_an_estimate_fail(generator):
    class Few(GeneratedDataset):
        def __getitem__(self, index):
            frame = super().__getitem__(index)
            return dataclasses.replace(frame, points=frame.points[:5]) if index == 9 else frame

    found = protocol.evaluate(Few(generator, 12), MODEL)
    assert np.flatnonzero(found.failed).tolist() == [9] and not found.plausible[9]
    assert np.isnan(found.estimate.size[9]).all() and (found.errors.rotation_deg[9] == 180).all()
    assert np.isfinite(found.estimate.size[:9]).all()


def test_mistakes_are_named(generator):
    laptop = Estimator(categories.get("laptop"), NETWORK, {})
    with pytest.raises(CaperError, match="frames show 'box', the model estimates 'laptop'"):
        protocol.evaluate(generator, laptop, frames=3)
    with pytest.raises(CaperError, match="say how many frames="):
        protocol.evaluate(generator, MODEL)
    with pytest.raises(CaperError, match="nothing to generate: 0 frames"):
        protocol.evaluate(generator, MODEL, frames=0)
    with pytest.raises(CaperError, match="nothing to evaluate: 5 frames, 0 wanted"):
        protocol.evaluate(GeneratedDataset(generator, 5), MODEL, frames=0)
