"""Tables of trained variants: what is trained, measured and said. Nothing is trained here."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from _helpers.frames import random_frames
from _helpers.reproductions import cells, run
from _helpers.tiny import network, random_variables
from _helpers.tracks import KnownTracker, disturbed, write_videos
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.config import override
from caper_jax.data import hdf5
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation import protocol
from caper_jax.reproduce import ablations, root_pose
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import paper
from caper_jax.training import train as training

LAPTOP = categories.get("laptop")


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """Pretends to train; every kind's estimates are the truth, rotated by its own angle about x.

    Gives the arguments that name the data, the kinds trained, and the angles.
    """
    hdf5.write(tmp_path / "laptop.h5", category=LAPTOP, split="test", **random_frames(5, 100))
    runs: list[tuple[str, tuple[str, ...], int]] = []
    degrees: dict[str, float] = {}

    def train(category, label, changes, seed, options):
        runs.append((label, tuple(changes), seed))
        return SimpleNamespace(network=network(), card={"steps": 3000}, label=label)

    def predictor(estimator):
        def predict(frames, points):
            return disturbed(protocol.truth_predictor(frames, points), degrees[estimator.label])

        return predict

    monkeypatch.setattr(ablations, "train", train)
    monkeypatch.setattr(ablations, "model_predictor", predictor)
    monkeypatch.setattr(root_pose, "model_predictor", predictor)
    monkeypatch.setattr(root_pose, "root_predictor", predictor)
    monkeypatch.setattr(root_pose, "stage_one", lambda estimator: estimator)
    data = ["--category", "laptop", "--data", str(tmp_path / "laptop.h5"), "--format", "caper"]
    return SimpleNamespace(data=data, runs=runs, degrees=degrees)


def test_every_change_is_a_setting_of_a_run():
    config = training.preset("fast", "laptop")
    everything = {**ablations.VARIANTS, **root_pose.INPUTS, **root_pose.ROTATIONS}
    for name, changes in everything.items():
        changed = override(config, *changes)
        assert (changed == config) == (name in ("full", "whole", "decoupled"))
    both = override(config, *ablations.VARIANTS["efficientcaper"]).network
    assert (both.vertical_correction, both.joints) == (False, "direct")


def test_each_run_has_its_kind_seed_and_budget(tmp_path, monkeypatch):
    started = []

    def train(config, directory, initial):
        assert initial is None
        started.append((config, directory))
        return SimpleNamespace(finished=len(started) < 2)

    monkeypatch.setattr(ablations.training, "train", train)
    monkeypatch.setattr(ablations, "load", lambda *_: SimpleNamespace(network=None, card={}))
    options = Options(out=tmp_path, steps=7, settings=("training.batch_size=3",))
    change = ("network.increment=euclidean",)
    with pytest.raises(CaperError, match="box_euclidean_7steps_seed2 holds a finished run"):
        ablations.train("box", "euclidean", change, 2, options)
    with pytest.raises(KeyboardInterrupt):
        ablations.train("box", "lie", (), 0, options)
    (first, folder), (second, other) = started
    assert first.network == dataclasses.replace(second.network, increment="euclidean")
    assert (first.training.steps, first.training.minutes, first.training.seed) == (7, None, 2)
    assert first.training.batch_size == 3
    assert (folder.name, other.name) == ("box_euclidean_7steps_seed2", "box_lie_7steps_seed0")


def test_ablations_stand_beside_each_other_and_the_paper(trained, tmp_path, capsys):
    trained.degrees |= {
        "full": 1.0,
        "no_vertical_correction": 2.0,
        "direct_joints": 3.0,
        "efficientcaper": 4.0,
    }
    assert run("ablations", tmp_path, "--seeds", "1", *trained.data) == 0
    output = capsys.readouterr().out
    assert [label for label, _, _ in trained.runs] == list(trained.degrees)
    full = cells(output, "laptop", "base", "full", "0")
    assert full[:4] == ["3.1", "1.00 / 1.00", "3.15", "0.00 / 0.00"]
    assert cells(output, "laptop", "base", "no vertical correction", "0")[0] == "-"
    lid = cells(output, "laptop", "lid", "efficientcaper", "0")
    assert lid[:2] == ["4.0", "4.00 / 4.00"]
    assert lid[4:] == ["0.00 / 0.00", "0.0 / 0.0", "0.00 / 0.00 deg"]
    content = json.loads((tmp_path / "ablations.json").read_text())["categories"]["laptop"]
    error = content["variants"]["direct joints"][0]["parts"][0]["rotation_deg"]["mean"]
    assert error == pytest.approx(3.0, abs=1e-3)


def summary(rotation, translation):
    """Of one part, as ``summarize_tracks`` has it."""
    values = {"rotation_deg": rotation, "translation_relative": translation}
    return {"parts": [{"name": "base", **{key: {"mean": v} for key, v in values.items()}}]}


def test_means_spreads_and_differences_of_increments():
    lie = (summary(4.0, 0.02), summary(5.0, 0.03), summary(6.0, 0.04))
    euclidean = (summary(7.0, 0.02), summary(7.0, 0.02), summary(10.0, 0.02))
    figures = paper().tables["table9"].variants["lie"]["box"]
    (row,) = ablations.increment_rows("box", "lie", lie, figures)
    assert row[3:] == ["4.6", "5.00 ± 1.00", "0.008", "2.87", "3.00 ± 1.00"]
    (row,) = ablations.increment_rows("box", "lie", lie[:1], figures)
    assert row[4] == "4.00 ± -"
    (row,) = ablations.difference_rows("box", {"lie": lie, "euclidean": euclidean})
    # sqrt((1 + 3) / 3) and sqrt(1 / 3).
    assert (row[4], row[7]) == ("3.00 ± 1.15", "-1.00 ± 0.58")


def test_increments_are_tracked_by_the_network_alone(trained, tmp_path, monkeypatch, capsys):
    dataset = write_videos(tmp_path / "box.h5")

    def make(estimator, config):
        assert config.registration.steps == 0
        return KnownTracker(dataset, 4.0 if estimator.label == "lie" else 5.0, 0.0)

    monkeypatch.setattr(ablations, "Tracker", make)
    data = ["--data", str(tmp_path / "box.h5"), "--format", "caper"]
    assert run("table9", tmp_path, "--category", "box", "--seeds", "2", *data) == 0
    assert trained.runs == [
        (kind, (f"network.increment={kind}",), seed)
        for kind in ("lie", "euclidean")
        for seed in (0, 1)
    ]
    output = capsys.readouterr().out
    assert cells(output, "box", "base", "lie")[:2] == ["4.6", "4.00 ± 0.00"]
    assert cells(output, "box", "lid", "euclidean - lie")[1] == "1.00 ± 0.00"
    assert "box, lie: 3,000, 3,000 training steps" in output


def test_table_seven_tells_inputs_apart(trained, tmp_path, capsys):
    trained.degrees |= {"root": 5.0, "full": 2.5}
    assert run("table7", tmp_path, "--seeds", "2", *trained.data) == 0
    output = capsys.readouterr().out
    assert [seed for label, _, seed in trained.runs if label == "root"] == [0, 1]
    assert cells(output, "laptop", "root", "1") == ["3.8", "5.00 / 5.00", "4.35", "0.00 / 0.00"]
    assert cells(output, "laptop", "whole", "0")[:2] == ["2.9", "2.50 / 2.50"]


def test_figure_eleven_splits_the_error_by_axis(trained, tmp_path, capsys):
    trained.degrees |= {"direct": 6.0, "full": 1.5}
    assert run("figure11", tmp_path, "--seeds", "1", *trained.data) == 0
    row = cells(capsys.readouterr().out, "laptop", "direct", "0")
    # Rotated about x: all of it is pitch, and every axis but x is off by it.
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
        SimpleNamespace(rotation=rotation.as_matrix()[:, None].astype(np.float32))
        for rotation in (estimate, truth)
    ]
    np.testing.assert_allclose(root_pose.error_angles(*poses), angles, atol=1e-3)


def test_stage_one_sees_the_root_alone_where_there_is_enough_of_it():
    shown = []

    def estimator(points):
        shown.append(points)
        return SimpleNamespace(pose=None)

    points = np.random.default_rng(0).uniform(0.5, 1.0, (100, 3)).astype(np.float32)
    few, many = np.ones(100, int), np.ones(100, int)
    few[:10], many[:60] = 0, 0
    frames = [SimpleNamespace(name="f", points=points, labels=labels) for labels in (few, many)]
    root_pose.root_predictor(estimator)(frames, np.stack([points[:64], points[:64]]))
    np.testing.assert_array_equal(shown[0][0], points[:64])
    assert set(map(tuple, shown[0][1])) <= set(map(tuple, points[:60]))
    frames[0].labels = None
    with pytest.raises(CaperError, match="'f'"):
        root_pose.root_predictor(estimator)(frames, np.stack([points[:64]] * 2))


def test_stage_one_alone_is_the_uncorrected_root():
    config = network("fast", pool_first=True)
    whole = Estimator(LAPTOP, config, random_variables(LAPTOP, config))
    alone = root_pose.stage_one(whole)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (2, 64, 3)) + [0, 0, 0.7]
    one, other = (
        jax.jit(model.function)(model.variables, model.sampled(points)) for model in (whole, alone)
    )
    np.testing.assert_allclose(one.confidence, other.confidence, atol=1e-6)
    assert not np.allclose(one.pose.rotation, other.pose.rotation, atol=1e-3)
    assert np.abs(other.evidence[..., 2:4] - other.evidence[0, 0, 2]).max() < 1e-3  # no increment
