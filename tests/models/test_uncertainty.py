"""What a model says about its own errors: evidence, calibration, and the radii that follow."""

from __future__ import annotations

import dataclasses
import json

import jax
import numpy as np
import pytest
from _helpers.frames import random_pose
from _helpers.tiny import network, random_variables
from scipy.optimize import linprog
from scipy.stats import chi

from caper_jax import categories, cli
from caper_jax.articulation.symmetry import apply_symmetry
from caper_jax.config import GeneratorConfig, to_dict
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load
from caper_jax.lie import se3
from caper_jax.models import uncertainty
from caper_jax.models.files import write_model
from caper_jax.reproduce.static import ball_share, interval_share
from caper_jax.training import fit_hypotheses, fit_plausibility, fit_uncertainty

BOX = categories.get("box")


def section(**changes):
    """A calibration of two parts that says 0.1 rad, 0.2 units and 0.3 rad of every frame."""
    zeros = np.zeros(uncertainty.ALL_EVIDENCE).tolist()
    rows = {name: [*zeros, float(np.log(value))] for name, value in (("r", 0.1), ("t", 0.2))}
    return {
        "rotation": [rows["r"]] * 2,
        "translation": [rows["t"]] * 2,
        "state": [[*zeros, float(np.log(0.3))]],
        "low": [-1.0] * uncertainty.ALL_EVIDENCE,
        "high": [1.0] * uncertainty.ALL_EVIDENCE,
    } | changes


def test_radii_of_a_normal_distribution():
    assert pytest.approx(chi(3).ppf(uncertainty.COVERAGE), abs=1e-6) == uncertainty.RADIUS_3D
    assert pytest.approx(chi(1).ppf(uncertainty.COVERAGE), abs=1e-6) == uncertainty.RADIUS_1D
    for radius in (0.1, 1.0, 2.5):
        assert ball_share(radius) == pytest.approx(chi(3).cdf(radius))
        assert interval_share(radius) == pytest.approx(chi(1).cdf(radius))


def test_evidence_counts_doubts_and_asks_about_parts():
    logits = np.log(np.array([[0.9, 0.1]] * 15 + [[0.5, 0.5001]], np.float32))[None]
    twist = np.array([[0, 0.3, 0.4, 0, 0, 0.2]], np.float32)
    found = uncertainty.evidence(np.array([[0.999, 0.2]], np.float32), twist, logits)
    assert found.shape == (1, 2, uncertainty.EVIDENCE)
    entropy = (15 * -(0.9 * np.log(0.9) + 0.1 * np.log(0.1)) + np.log(2)) / 16
    frame = [np.log(0.002), np.log(0.801), np.log(0.501), np.log(0.201), entropy]
    for part, count in enumerate((15, 1)):
        np.testing.assert_allclose(found[0, part, :5], frame, rtol=1e-3)
        assert found[0, part, 5] == pytest.approx(np.log((count + 1) / 16))


def test_radii_grow_with_the_evidence_up_to_what_was_seen():
    rotation = np.array(section()["rotation"])
    rotation[1, 0] = 2.0
    state = [0.0, 3.0] + [0.0] * (uncertainty.ALL_EVIDENCE - 1)
    card = section(rotation=rotation.tolist(), state=[state])
    fitted = uncertainty.from_card(card, 2, "card")
    found = np.zeros((3, 2, uncertainty.ALL_EVIDENCE), np.float32)
    found[1:, :, 0], found[:, 1, 1] = [[0.5], [50.0]], 0.25
    turn, shift, state = uncertainty.radii(fitted, found)
    np.testing.assert_allclose(turn[:, 0], 0.1, rtol=1e-5)
    np.testing.assert_allclose(turn[:, 1], 0.1 * np.exp([0, 1, 2]), rtol=1e-5)
    np.testing.assert_allclose(shift, 0.2, rtol=1e-5)
    np.testing.assert_allclose(state[:, 0], np.exp(0.75), rtol=1e-5)  # of the part it holds


def test_deviations_of_sizes_follow_from_what_is_seen_of_each_extent():
    """A plate that faces the camera says nothing of its thickness."""
    pose = se3.from_rt(np.eye(3), np.array([[[0.0, 0.0, 2.0], [3.0, 0.0, 4.0]]]))
    seen = uncertainty.foreshortening(pose[..., :3, :3], pose[..., :3, 3])
    np.testing.assert_allclose(seen[0], [[0, 0, 1], [0.6, 0, 0.8]], atol=1e-6)
    zeros = [0.0] * uncertainty.ALL_EVIDENCE
    rows = [[*zeros, 1.0, 2.0, float(np.log(0.1))]] * 3
    fitted = uncertainty.from_card(section(size=[rows, rows]), 2, "card")
    evidence = np.zeros((1, 2, uncertainty.ALL_EVIDENCE), np.float32)
    radii = uncertainty.size_radii(fitted, evidence, seen)
    np.testing.assert_allclose(radii, 0.1 * np.exp(seen + 2 * np.square(seen)), rtol=1e-5)
    older = uncertainty.from_card(section(), 2, "card")
    assert uncertainty.size_radii(older, evidence, seen) is None
    with pytest.raises(CaperError, match="calibration size must be finite numbers"):
        uncertainty.from_card(section(size=[rows]), 2, "card")


def test_covariance_is_that_of_twists():
    rng = np.random.default_rng(0)
    covariance = uncertainty.pose_covariance(np.array([0.1, 0.2]), np.array([0.01, 0.03]))
    twists = rng.normal(size=(20000, 6)) * np.repeat([0.2, 0.03], 3)
    np.testing.assert_allclose(covariance[1], np.cov(twists.T), atol=2e-3)


def test_readings_of_equal_halves_count_as_the_nearer():
    """Scissors whose halves are alike, read the other way round; and some whose are not."""
    scissors = categories.get("scissors")
    truth = random_pose(4, 3)
    size = np.repeat(truth.size[:, :1], 2, 1)
    size[3, 1] *= [1.2, 1.0, 1.0]
    truth = dataclasses.replace(truth, size=size)
    (symmetry,) = scissors.symmetries
    other = apply_symmetry(truth, symmetry, scissors)
    rows = np.array([1, 3])
    estimate = jax.tree.map(np.array, truth)
    for name in vars(estimate):
        getattr(estimate, name)[rows] = getattr(other, name)[rows]
    found = fit_uncertainty.nearer_symmetry(estimate, truth, scissors)
    for name, values in vars(found).items():
        np.testing.assert_allclose(values[:3], getattr(estimate, name)[:3], atol=1e-6)
        np.testing.assert_allclose(values[3], getattr(truth, name)[3], atol=1e-6)


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_quantile_regression_is_the_linear_program(level):
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(300, 2))
    target = inputs @ [1.0, -0.5] + (1 + 0.5 * np.abs(inputs[:, 0])) * rng.standard_t(3, 300)
    found = fit_uncertainty.quantile_regression(inputs, target, level)
    design = np.column_stack([inputs, np.ones(300)])
    eye = np.eye(300)
    exact = linprog(
        np.concatenate([np.zeros(3), np.full(300, level), np.full(300, 1 - level)]),
        A_eq=np.hstack([design, eye, -eye]),
        b_eq=target,
        bounds=[(None, None)] * 3 + [(0, None)] * 600,
    )
    np.testing.assert_allclose(found, exact.x[:3], atol=0.02)
    assert abs((target < design @ found).mean() - level) < 0.02


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"low": [0.0]}, "calibration low must be finite numbers"),
        ({"state": [[float("nan")] * 13]}, "calibration state must be finite numbers"),
        ({"rotation": "no"}, "calibration lacks numbers for 'rotation'"),
    ],
)
def test_bad_sections_are_named(changes, message):
    with pytest.raises(CaperError, match=message):
        uncertainty.from_card(section(**changes), 2, "card")


class TestModel:
    """A network of random weights: as wrong as can be, and it must say so."""

    CONFIG = GeneratorConfig(instances=4, grid=16, num_points=64, noise=("none",))

    @pytest.fixture
    def folder(self, tmp_path):
        sizes = network()
        card = {"category": "box", "run": {"network": to_dict(sizes)}}
        write_model(tmp_path / "box", random_variables(BOX, sizes), card)
        return tmp_path / "box"

    def test_uncalibrated_models_say_nothing(self, folder):
        found = load("box", folder)(np.random.default_rng(0).normal(size=(64, 3)) + [0, 0, 2.0])
        assert found.rotation_std is found.state_std is None
        assert found.points_per_part.sum() == 64 and found.evidence.shape == (
            2,
            uncertainty.ALL_EVIDENCE,
        )

    def test_calibrate_makes_the_stated_region_hold_the_truth(
        self, folder, tmp_path, monkeypatch, capsys
    ):
        monkeypatch.setattr("caper_jax.config.TRAINING_DATA", self.CONFIG)
        # Other categories' objects take a minute to compile; test_plausibility has them.
        monkeypatch.setattr(
            fit_plausibility,
            "other_objects",
            lambda estimator, config, count, seed: fit_plausibility.walls(
                count, 64, 0.5, np.random.default_rng(seed)
            ),
        )
        monkeypatch.setattr(fit_plausibility, "_STEPS", 500)
        monkeypatch.setattr(fit_hypotheses, "_STEPS", 500)
        command = ["calibrate", "--category", "box", "--weights", str(folder), "--frames"]
        assert cli.main([*command, "20"]) == 2
        assert "320 frames or more, got 20" in capsys.readouterr().err
        assert cli.main([*command, "640"]) == 0
        estimator = load("box", folder)
        assert estimator.card["calibration"]["frames"] == 640
        assert estimator.card["plausibility"]["frames"] == 3 * 640
        assert {"plausibility", "hypotheses"} < set(estimator.variables["params"])
        assert estimator.card["hypotheses"]["frames"] == 960
        assert estimator.card["calibration"]["noise"] == ["none"]  # no camera to choose
        file = tmp_path / "box.h5"
        generate = ["generate", "--category", "box", "--split", "test", "--frames", "200"]
        generate += ["--grid", "16", "--points", "64", "--noise", "none", "--out", str(file)]
        assert cli.main(generate) == 0
        options = ["--data", str(file), "--format", "caper", "--weights", str(folder)]
        assert cli.main(["reproduce", "reliability", *options, "--out", str(tmp_path)]) == 0
        content = json.loads((tmp_path / "reliability.json").read_text())["categories"]["box"]
        for name, shares in content["shares"].items():
            values = list(shares.values())
            assert values == sorted(values)
            # Four shapes to fit on and four others to test: sizes are theirs alone.
            least = 0.4 if name.startswith("size") else 0.8
            assert least < shares["0.9"] < 0.98 + 0.02 * name.startswith("size"), name
        assert (tmp_path / "reliability_box.png").stat().st_size > 1000

    def test_calibration_leaves_clean_depth_out_where_there_are_cameras(self, folder):
        mixed = dataclasses.replace(self.CONFIG, noise=("none", "kinect", "gauss3mm"))
        found = fit_uncertainty.calibrate(load("box", folder), mixed, 320)
        alone = fit_uncertainty.calibrate(
            load("box", folder), dataclasses.replace(self.CONFIG, noise=("kinect",)), 320
        )
        assert found["noise"] == ["kinect"] and found == alone

    def test_object_scale_scales_lengths_only(self):
        sizes = network()
        variables, card = random_variables(BOX, sizes), {"calibration": section()}
        points = np.float32(np.random.default_rng(0).normal(size=(64, 3)) * 0.1 + [0, 0, 1.0])
        small = Estimator(BOX, sizes, variables, card)(points)
        large = Estimator(BOX.scaled(2.0), sizes, variables, card)(2 * points)
        np.testing.assert_allclose(small.rotation_std, 0.1 / uncertainty.RADIUS_3D, rtol=1e-5)
        np.testing.assert_allclose(large.rotation_std, small.rotation_std, rtol=1e-5)
        np.testing.assert_allclose(large.translation_std, 2 * small.translation_std, rtol=1e-5)
        np.testing.assert_allclose(
            small.translation_std, 0.2 / BOX.unit / uncertainty.RADIUS_3D, rtol=1e-5
        )
        np.testing.assert_allclose(small.state_std, 0.3 / uncertainty.RADIUS_1D, rtol=1e-5)
