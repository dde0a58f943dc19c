"""What probabilities are worth: shares and calibration from known readings, and gravity told."""

from __future__ import annotations

import numpy as np
import pytest
from _helpers import tiny

import caper_jax as caper
from caper_jax import categories
from caper_jax.config import GeneratorConfig
from caper_jax.estimator import Estimator
from caper_jax.evaluation.protocol import Readings
from caper_jax.evaluation.report import reading_summary
from caper_jax.synthetic.camera import gravity
from caper_jax.synthetic.dataset import GeneratedDataset
from caper_jax.synthetic.frames import Generator
from caper_jax.synthetic.masks import table_depth

BOX = categories.get("box")


def test_summary_of_known_readings():
    # Four frames: right and sure, wrong and sure, wrong with a right second one, and neither.
    probability = np.array([[0.95, 0.04], [0.95, 0.0], [0.55, 0.4], [0.55, 0.3]])
    off = np.array([[5.0, 90.0], [180.0, 90.0], [90.0, 1.0], [90.0, 40.0]])
    rotation = np.stack([off, off / 2], -1)  # the lid is half as far off as the base
    found = reading_summary(Readings(probability, rotation), BOX)
    assert (found["right"], found["among_readings"]) == (0.25, 0.5)
    assert (found["confident"], found["confident_and_wrong"]) == (0.5, 0.25)
    # Tenths: 0.95 stated and 0.5 found, 0.55 stated and 0 found.
    assert found["calibration_error"] == pytest.approx((2 * 0.45 + 2 * 0.55) / 4)
    base, lid = found["best_reading_deg"]
    assert base["mean"] == pytest.approx((5 + 90 + 1 + 40) / 4)
    assert lid["mean"] == pytest.approx(base["mean"] / 2)


def test_probabilities_that_keep_their_word_have_no_calibration_error():
    rng = np.random.default_rng(0)
    first = rng.random(200_000)
    wrong = rng.random(len(first)) > first
    rotation = np.where(wrong, 90.0, 1.0)[:, None, None]
    found = reading_summary(Readings(first[:, None], np.repeat(rotation, 2, -1)), BOX)
    assert found["calibration_error"] < 0.005
    assert found["confident_and_wrong"] == pytest.approx(0.005, abs=0.001)


@pytest.mark.parametrize("name", ["box", "scissors"])
def test_gravity_of_generated_frames_falls_onto_the_table(name):
    category = categories.get(name)
    generator = Generator(category, GeneratorConfig(instances=4, grid=24, num_points=64), "test")
    dataset = GeneratedDataset(generator, 8)
    bank = generator.bank
    for frame in (dataset[index] for index in range(8)):
        down = gravity(frame.truth, category.viewpoint)
        np.testing.assert_array_equal(frame.gravity, down)
        assert np.linalg.norm(down) == pytest.approx(1.0, abs=1e-5)
        # Three rays that meet the table span a plane across which things fall.
        rays = np.float32([[0.0, 0.1, 0.05], [0.3, 0.3, 0.35]])
        instance = bank.replace(
            **{key: getattr(bank, key)[int(frame.instance)] for key in ("size", "box_center")}
        )
        poses = np.tile(np.eye(4), (category.num_parts, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = frame.truth.rotation, frame.truth.translation
        depth = np.asarray(table_depth(instance, poses, category.viewpoint, rays), np.float64)
        if (depth > 5.9).any():
            continue
        points = np.column_stack([*rays, np.ones(3)]) * depth[:, None]
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        normal *= np.sign(normal @ points[0]) / np.linalg.norm(normal)
        np.testing.assert_allclose(normal, down, atol=1e-3)


def test_gravity_is_told_where_it_is_wanted():
    network = tiny.network()
    estimator = Estimator(BOX, network, tiny.random_variables(BOX, network))
    told = []
    plain = estimator.function

    def spy(variables, points, gravity=None):
        told.append(None if gravity is None else gravity.shape)
        return plain(variables, points, gravity=gravity)

    estimator.function = spy
    generator = Generator(BOX, GeneratorConfig(instances=4, grid=24, num_points=64), "test")
    with_gravity = caper.evaluate(generator, estimator, frames=8, batch_size=8, use_gravity=True)
    assert told[-1] is not None and told[-1][-1] == 3
    without = caper.evaluate(generator, estimator, frames=8, batch_size=8)
    assert told[-1] is None
    assert with_gravity.readings is None  # the model was not fitted to state any
    assert (with_gravity.estimate.rotation != without.estimate.rotation).any()
