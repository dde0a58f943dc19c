"""Tables of models that lack an idea of the paper: what is trained, measured and said."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from _helpers.frames import random_frames
from _helpers.reproductions import cells, run
from _helpers.tiny import network, random_variables
from _helpers.tracks import disturbed
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.config import override
from caper_jax.data import hdf5
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation import protocol
from caper_jax.reproduce import ablations, root_pose, trainings
from caper_jax.reproduce.render import Scatter
from caper_jax.training import train as training
from caper_jax.visualization.plots import write_scatter

LAPTOP = categories.get("laptop")


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """Pretends to train; every kind's estimates are the truth, turned by its own angle about x.

    Gives the arguments that name the data, the kinds asked for, and the angles.
    """
    hdf5.write(tmp_path / "laptop.h5", category=LAPTOP, split="test", **random_frames(6, 100))
    asked: list[tuple[str, tuple[str, ...], int]] = []
    degrees: dict[str, float] = {}

    def train(category, label, changes, seed, options):
        asked.append((label, tuple(changes), seed))
        return SimpleNamespace(network=network(), card={"steps": 3000}, label=label)

    def predictor(estimator):
        def predict(frames, points):
            return disturbed(protocol.truth_predictor(frames, points), degrees[estimator.label])

        return predict

    monkeypatch.setattr(trainings, "trained", train)
    monkeypatch.setattr(ablations, "model_predictor", predictor)
    monkeypatch.setattr(root_pose, "model_predictor", predictor)
    monkeypatch.setattr(root_pose, "root_predictor", predictor)
    monkeypatch.setattr(root_pose, "stage_one", lambda estimator: estimator)
    data = ["--category", "laptop", "--data", str(tmp_path / "laptop.h5"), "--format", "caper"]
    return SimpleNamespace(data=data, asked=asked, degrees=degrees)


def test_every_change_is_a_setting_of_a_run():
    config = training.preset("fast", "laptop")
    everything = {**ablations.VARIANTS, **root_pose.INPUTS, **root_pose.ROTATIONS}
    for name, changes in everything.items():
        changed = override(config, *changes)
        assert (changed == config) == (name in ("full", "whole", "decoupled"))
    both = override(config, *ablations.VARIANTS["efficientcaper"]).network
    assert (both.vertical_correction, both.joints) == (False, "direct")


def test_ablations_stand_beside_each_other_and_the_paper(trained, tmp_path, capsys):
    trained.degrees |= {
        "full": 1.0,
        "no_vertical_correction": 2.0,
        "direct_joints": 3.0,
        "efficientcaper": 4.0,
    }
    assert run("ablations", tmp_path, "--seeds", "1", *trained.data) == 0
    output = capsys.readouterr().out
    assert [label for label, _, _ in trained.asked] == list(trained.degrees)
    full = cells(output, "laptop", "base", "full", "0")
    assert full[:4] == ["3.1", "1.00 / 1.00", "3.15", "0.00 / 0.00"]
    assert cells(output, "laptop", "base", "no vertical correction", "0")[0] == "-"
    lid = cells(output, "laptop", "lid", "efficientcaper", "0")
    assert lid[:2] == ["4.0", "4.00 / 4.00"]
    assert lid[4:] == ["0.00 / 0.00", "0.0 / 0.0", "0.00 / 0.00 deg"]
    content = json.loads((tmp_path / "ablations.json").read_text())["categories"]["laptop"]
    found = content["variants"]["direct joints"][0]["parts"][0]["rotation_deg"]["mean"]
    assert found == pytest.approx(3.0, abs=1e-3)


def test_table_seven_tells_inputs_apart(trained, tmp_path, capsys):
    trained.degrees |= {"root": 5.0, "full": 2.5}
    assert run("table7", tmp_path, "--seeds", "2", *trained.data) == 0
    output = capsys.readouterr().out
    assert [seed for label, _, seed in trained.asked if label == "root"] == [0, 1]
    assert cells(output, "laptop", "root", "1") == ["3.8", "5.00 / 5.00", "4.35", "0.00 / 0.00"]
    assert cells(output, "laptop", "whole", "0")[:2] == ["2.9", "2.50 / 2.50"]


def test_figure_eleven_splits_the_error_by_axis(trained, tmp_path, capsys):
    trained.degrees |= {"direct": 6.0, "full": 1.5}
    assert run("figure11", tmp_path, "--seeds", "1", *trained.data) == 0
    row = cells(capsys.readouterr().out, "laptop", "direct", "0")
    # Turned about x: all of it is pitch, and every axis but x is off by it.
    assert row[:3] == ["0.00 / 0.00", "6.00 / 6.00", "0.00 / 0.00"]
    off = ["0.00 / 0.00" if axis == "x" else "6.00 / 6.00" for axis in LAPTOP.directions]
    assert row[3:] == [*off, "6.00 / 6.00"]
    assert (tmp_path / "figure11_laptop.png").stat().st_size > 10_000


def test_error_angles_are_those_that_scipy_composes():
    rng = np.random.default_rng(0)
    angles = rng.uniform(-80, 80, (20, 3))
    estimate = Rotation.random(20, rng=rng)
    truth = estimate * Rotation.from_euler("YXZ", angles, degrees=True)
    poses = [
        SimpleNamespace(rotation=turn.as_matrix()[:, None].astype(np.float32))
        for turn in (estimate, truth)
    ]
    np.testing.assert_allclose(root_pose.error_angles(*poses), angles, atol=1e-3)


def test_stage_one_sees_the_root_alone_where_there_is_enough_of_it():
    seen = []

    def estimator(points):
        seen.append(points)
        return SimpleNamespace(pose=None)

    points = np.random.default_rng(0).uniform(0.5, 1.0, (100, 3)).astype(np.float32)
    few, many = np.ones(100, int), np.ones(100, int)
    few[:10], many[:40] = 0, 0
    frames = [SimpleNamespace(name="f", points=points, labels=labels) for labels in (few, many)]
    root_pose.root_predictor(estimator)(frames, np.stack([points[:64], points[:64]]))
    np.testing.assert_array_equal(seen[0][0], points[:64])
    assert set(map(tuple, seen[0][1])) <= set(map(tuple, points[:40]))
    frames[0].labels = None
    with pytest.raises(CaperError, match="'f' does not say which points"):
        root_pose.root_predictor(estimator)(frames, np.stack([points[:64]] * 2))


def test_stage_one_alone_is_the_uncorrected_root():
    config = network("fast", pool_first=True)
    whole = Estimator(LAPTOP, config, random_variables(LAPTOP, config))
    alone = root_pose.stage_one(whole)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (2, 64, 3)) + [0, 0, 0.7]
    one, other = whole(points.astype(np.float32)), alone(points.astype(np.float32))
    np.testing.assert_allclose(one.confidence, other.confidence, atol=1e-6)
    assert not np.allclose(one.pose.rotation, other.pose.rotation, atol=1e-3)
    assert np.abs(other.evidence[..., 2:4] - other.evidence[0, 0, 2]).max() < 1e-6  # no increment


def test_scatter_keeps_what_lies_beyond_its_axes(tmp_path):
    values = np.append(np.linspace(-1, 1, 200), 1e6)
    panels = {"one": (values, values, values), "other": (values, -values, values)}
    write_scatter(tmp_path / "s.png", Scatter("title", "x", "y", "color", panels))
    assert (tmp_path / "s.png").stat().st_size > 10_000
