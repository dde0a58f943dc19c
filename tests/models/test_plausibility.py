"""Whether an estimate can be believed: the evidence by other means, the verdict, and its words."""

from __future__ import annotations

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from _helpers.tiny import network, random_variables
from scipy.special import logsumexp

from caper_jax import categories
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.cli import demo
from caper_jax.config import GeneratorConfig, to_dict
from caper_jax.data.clouds import cloud_from_depth
from caper_jax.data.images import read_depth, read_intrinsics, read_mask
from caper_jax.errors import CaperError
from caper_jax.estimator import load
from caper_jax.lie import se3, so3
from caper_jax.models import plausibility
from caper_jax.models.files import FITTED_FILES, read_model, write_model
from caper_jax.models.observation import observe
from caper_jax.models.plausibility import (
    FEW_POINTS,
    OTHER,
    PART,
    PLAUSIBLE,
    REASONS,
    SEVERAL,
    SIZE,
    TOO_LARGE,
    TOO_SMALL,
    BoxFit,
    PlausibilityClassifier,
    box_fit,
    implausible_because,
    judge,
    num_features,
    widening,
)
from caper_jax.models.refiner import StageEstimate
from caper_jax.training import fit_plausibility

BOX = categories.get("box")
NAMES = [name for name in categories.names() if name != "robotarm"]


def an_estimate(rng, batch=2):
    """Some boxes of the category's size, somewhere before the camera; network units."""
    mean = np.asarray(BOX.mean_size) * BOX.unit
    middle = np.asarray(BOX.mean_center) * BOX.unit
    root = se3.from_rt(so3.exp(jnp.asarray(rng.normal(size=(batch, 3)))), jnp.array([0.1, 0, 4.0]))
    return StageEstimate(
        root=root,
        axis=jnp.tile(jnp.array([[-1.0, 0.0, 0.0]]), (batch, 1, 1)),
        pivot=jnp.asarray(rng.normal(size=(batch, 1, 3)) * 0.2),
        state=jnp.asarray(rng.uniform(0, 1, (batch, 1))),
        size=jnp.asarray(np.tile(mean, (batch, 1, 1)) * 1.1),
        center=jnp.asarray(np.tile(middle, (batch, 1, 1))),
    )


def test_distances_are_those_of_trimesh():
    rng = np.random.default_rng(0)
    estimate = an_estimate(rng)
    points = rng.normal(0, 0.6, (2, 64, 3)).astype(np.float32) + np.float32([0.1, 0, 4.0])
    observed = observe(jnp.asarray(points) / BOX.unit, BOX)
    logits = rng.normal(size=(2, 64, 2)).astype(np.float32)
    fit = box_fit(estimate, logits, np.zeros((2, 2, 6), np.float32), observed, BOX)
    assert fit.features.shape == (2, num_features(2))

    cloud, share = np.asarray(observed.cloud)[:, ::2], np.asarray(jax.nn.softmax(logits))[:, ::2]
    arrays = (estimate.root, estimate.axis, estimate.pivot, estimate.state)
    parts = np.asarray(forward_kinematics(*arrays, BOX.joint_types, BOX.parents))
    boxes = np.asarray(BOX.mean_size), np.asarray(BOX.mean_center)
    low, high = (boxes[1] - boxes[0] / 2).min(0), (boxes[1] + boxes[0] / 2).max(0)
    diagonal = np.linalg.norm(high - low) * BOX.unit
    for b in range(2):
        signed = []
        for k in range(2):
            pose = parts[b, k] @ trimesh.transformations.translation_matrix(estimate.center[b, k])
            box = trimesh.creation.box(np.asarray(estimate.size)[b, k], pose)
            signed.append(trimesh.proximity.signed_distance(box, cloud[b]))  # inside is positive
        signed = np.stack(signed, -1)
        outside, surface = np.maximum(-signed, 0), np.abs(signed)
        of_own = (share[b] * outside).sum(-1)
        np.testing.assert_allclose(
            fit.features[b, 0], np.log(of_own.mean() / diagonal + 1e-3), atol=2e-3
        )
        nearest = surface.min(-1).mean() / diagonal
        np.testing.assert_allclose(fit.features[b, 6], np.log(nearest + 1e-3), atol=2e-3)
        of_part = (share[b] * surface).sum(0) / (share[b].sum(0) + 1) / diagonal
        np.testing.assert_allclose(fit.evidence[b, :, 0], np.log(of_part + 1e-3), atol=2e-3)


@pytest.mark.parametrize("factor", [0.2, 1.0, 5.0])
def test_the_size_of_a_cloud_grows_with_it(factor):
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.15, 0.15, (1, 256, 3)) + [0, 0, 0.8]
    sizes = [
        plausibility.log_size(observe(jnp.asarray(p, jnp.float32), BOX).cloud, BOX)
        for p in (points, factor * points)
    ]
    assert sizes[1] - sizes[0] == pytest.approx(np.log(factor), abs=0.05)


def a_fit(log_size=0.0, distinct=1024, features=None):
    features = np.zeros((1, num_features(2)), np.float32) if features is None else features
    return BoxFit(features, None, np.float32([log_size]), np.int32([distinct]))


def test_without_a_classifier_size_and_number_of_points_decide():
    for fit, reason in (
        (a_fit(), PLAUSIBLE),
        (a_fit(np.log(5.0)), TOO_LARGE),
        (a_fit(np.log(0.2)), TOO_SMALL),
        (a_fit(distinct=99), FEW_POINTS),
        (a_fit(np.log(5.0), 50), FEW_POINTS),
    ):
        verdict = judge(fit, 1024, None)
        assert (verdict.reason[0], verdict.plausible[0]) == (reason, reason == PLAUSIBLE)
        assert verdict.score is None
    assert judge(a_fit(np.log(5.0)), 1024, None).size_ratio[0] == pytest.approx(5.0)


def test_the_classifier_weighs_right_against_all_else():
    features = np.random.default_rng(2).normal(size=(1, num_features(2))).astype(np.float32)
    params = PlausibilityClassifier().init(jax.random.key(0), features)["params"]
    params["Dense_2"]["bias"] = jnp.array([1.0, -1.0, 0.5, 0.2, -3.0])
    params |= {"log_size": jnp.log(jnp.array([0.5, 1.0, 2.0]))}
    logits = np.asarray(PlausibilityClassifier().apply({"params": params}, features))[0]
    score = logits[0] - logsumexp(logits[1:])
    for threshold in (score - 0.1, score + 0.1):
        params["threshold"] = jnp.float32(threshold)
        verdict = judge(a_fit(features=features), 1024, params)
        assert verdict.score[0] == pytest.approx(score - threshold, abs=1e-5)
        assert verdict.plausible[0] == (threshold < score)
        expected = PLAUSIBLE if threshold < score else 1 + logits[1:].argmax()
        assert verdict.reason[0] == expected
    # What is wrong and far from the usual size is wrong because of its size.
    params["threshold"] = jnp.float32(score + 0.1)
    params["log_size"] = jnp.log(jnp.array([0.1, 1.0, 10.0]))
    for ratio, reason in ((0.3, TOO_SMALL), (2.0, expected), (4.0, TOO_LARGE)):
        assert judge(a_fit(np.log(ratio), features=features), 1024, params).reason[0] == reason
    params["log_size"] = jnp.log(jnp.array([0.5, 1.0, 2.0]))
    # What a rule finds is implausible for the score as well.
    params["threshold"] = jnp.float32(-100.0)
    assert judge(a_fit(np.log(5.0), features=features), 1024, params).score[0] < 0


def test_deviations_grow_with_implausibility_alone():
    grown = np.asarray(widening(jnp.array([9.0, 0.1, 0.0, -1.0, -2.0, -50.0])))
    np.testing.assert_allclose(grown[:3], 1.0)
    np.testing.assert_allclose(grown[3:5], np.exp([1.0, 2.0]), rtol=1e-6)
    assert grown[4] < grown[5] < np.inf


@pytest.mark.parametrize(
    ("reason", "ratio", "said"),
    [
        (PLAUSIBLE, 1.0, ""),
        (TOO_LARGE, 5.1, "5.1 times too large for this category (box): images of the TUM kind"),
        (TOO_LARGE, 10.0, "--depth-scale 0.0001"),
        (TOO_SMALL, 0.1, "10.0 times too small"),
        (TOO_SMALL, 0.4, "check the unit of the depth (--depth-scale), or say so (--object-scale)"),
        (TOO_LARGE, 1000.0, "points must be meters"),
        (SIZE, 2.0, "2.0 times too large"),
        (SIZE, 1.1, "no object of this category (box) has this size and shape"),
        (OTHER, 1.0, "is it another object?"),
        (SEVERAL, 1.0, "more than one object"),
        (PART, 1.0, "only a part of the object (box)"),
        (FEW_POINTS, 1.0, "only 77 different points"),
    ],
)
def test_reasons_in_words(reason, ratio, said):
    result = SimpleNamespace(reason=np.int32(reason), size_ratio=ratio, distinct_points=77)
    text = implausible_because(result, BOX)
    assert said in text and "\n" not in text
    assert bool(text) == bool(REASONS[reason])


def a_frame(name):
    folder = demo.demo_folder() / f"{name}_1"
    depth, mask = read_depth(folder / "depth.png"), read_mask(folder / "mask.png")
    return cloud_from_depth(depth, mask, read_intrinsics(folder / "intrinsics.json")).points


@pytest.mark.parametrize("name", NAMES)
def test_shipped_models_believe_their_objects_and_no_others(name):
    """The demo's objects, in wrong units, those of the other categories, and a wall."""
    estimator, points = load(name), a_frame(name)
    wall = np.random.default_rng(3).uniform(-0.5, 0.5, (1024, 3)).astype(np.float32)
    wall = wall * np.ptp(points, axis=0).max() * [1, 1, 0] + points.mean(0)
    others = [a_frame(other) for other in NAMES if other != name]
    clouds = [points, 0.1 * points, 0.2 * points, 5 * points, 10 * points, wall, *others]
    # Not the estimator itself: it refuses what is farther than 50 m.
    found = jax.jit(estimator.function)(estimator.variables, np.stack(clouds).astype(np.float32))
    assert found.plausible[0] and found.plausibility[0] >= 0.5
    np.testing.assert_array_equal(found.plausible, found.reason == PLAUSIBLE)
    np.testing.assert_allclose(
        found.size_ratio[1:5] / found.size_ratio[0], [0.1, 0.2, 5, 10], rtol=0.1
    )
    assert not found.plausible[1:5].any()
    assert found.plausible[5:].mean() <= 0.25
    assert (np.asarray(found.rotation_std)[1:5] > 2 * found.rotation_std[0]).all()


class TestFit:
    """Networks of random weights, and the boxes and laptops that there are."""

    CONFIG = GeneratorConfig(instances=8, grid=16, num_points=64, noise=("none",))

    @pytest.fixture(scope="class")
    @classmethod
    def folder(cls, tmp_path_factory):
        sizes, folder = network(), tmp_path_factory.mktemp("fit") / "box"
        card = {"category": "box", "run": {"network": to_dict(sizes)}, "calibration": {}}
        write_model(folder, random_variables(BOX, sizes), card)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(categories, "names", lambda: ("box", "laptop"))
            patch.setattr(fit_plausibility, "_STEPS", 1000)
            fit_plausibility.add_plausibility(folder, "box", cls.CONFIG, frames=768)
        return folder

    def test_the_model_then_judges(self, folder):
        card, variables = read_model(folder)
        assert card["plausibility"]["frames"] == 768 and "calibration" not in card
        low, usual, high = variables["params"]["plausibility"]["log_size"]
        assert low < usual < high
        assert json.loads((folder / "model.json").read_text())["category"] == "box"
        estimator = load("box", folder)
        generator = fit_plausibility.Generator(BOX, self.CONFIG, "test")
        right = generator.batch(jax.random.key(1), 64).points
        wrong = np.asarray(right) * np.float32(5)
        assert estimator(right).plausible.mean() > 0.9
        assert estimator(wrong).plausible.mean() < 0.1

    def test_weights_written_again_leave_the_old_classifier_behind(self, folder, tmp_path):
        card, variables = read_model(folder)
        write_model(tmp_path / "other", variables, card)
        assert (tmp_path / "other" / FITTED_FILES["plausibility"]).is_file()
        del variables["params"]["plausibility"]
        write_model(tmp_path / "other", variables, card)
        assert not (tmp_path / "other" / FITTED_FILES["plausibility"]).exists()
        assert (
            load("box", tmp_path / "other")(
                np.zeros((64, 3)) + np.arange(64)[:, None] * 0.01 + 0.5
            ).plausibility
            is None
        )

    def test_a_damaged_classifier_is_named(self, folder, tmp_path):
        write_model(tmp_path / "box", *reversed(read_model(folder)))
        (tmp_path / "box" / FITTED_FILES["plausibility"]).write_bytes(b"no")
        with pytest.raises(CaperError, match=r"plausibility\.npz is damaged"):
            load("box", tmp_path / "box")

    def test_too_few_frames(self, folder):
        with pytest.raises(CaperError, match="384 frames or more, got 100"):
            fit_plausibility.add_plausibility(folder, "box", self.CONFIG, frames=100)


def test_wrong_clouds_are_wrong_in_the_way_they_say():
    rng = np.random.default_rng(4)
    walls = fit_plausibility.walls(5, 200, 0.4, rng).astype(np.float64)
    for wall in walls:
        smallest = np.linalg.svd(wall - wall.mean(0), compute_uv=False)[-1] / np.sqrt(200)
        assert smallest < 0.01 * wall[:, 2].mean()
    first = rng.normal(0, 0.1, (6, 300, 3)) + [0, 0, 1]
    both = fit_plausibility.side_by_side(first, first[:2] + [5.0, 0, 0], rng)
    assert both.shape == first.shape
    for cloud, own in zip(both, first, strict=True):
        shared = (np.abs(cloud[:, None] - own.astype(np.float32)).max(-1) < 1e-6).any(-1)
        assert 0.2 <= shared.mean() <= 0.8
        assert np.linalg.norm(cloud[~shared].mean(0) - own.mean(0)) < 1.0
    labels = np.tile(np.arange(300) % 3 == 0, (6, 1)).astype(int)
    alone = fit_plausibility.single_parts(first, labels, 2, 4, rng)
    assert len(alone) == 4
    for cloud, own, label in zip(alone, first, labels, strict=False):
        part = label[(np.abs(cloud[0] - own.astype(np.float32)).max(-1) < 1e-6).argmax()]
        assert len(np.unique(cloud, axis=0)) == (label == part).sum()
