"""Tables of studies: what is measured, compared and said. Nothing is trained here."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from _helpers.frames import random_frames
from _helpers.reproductions import cells, run
from _helpers.tiny import network
from _helpers.tracks import KnownTracker, disturbed, write_videos
from scipy.spatial.transform import Rotation

from caper_jax import categories, cli
from caper_jax.data import hdf5
from caper_jax.errors import CaperError
from caper_jax.evaluation.loading import stack
from caper_jax.reproduce import study_measure, study_run
from caper_jax.training.train_many import MemberResult

LAPTOP = categories.get("laptop")


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """Pretends to train: a model's estimates are the truth, turned about x by its own angle.

    Gives the arguments that name the data; ``degrees`` is called with a training and its network in
    use; ``diverged`` are names of members that do not end; ``members`` what was trained.
    """
    path = tmp_path / "laptop.h5"
    hdf5.write(path, category=LAPTOP, split="test", **random_frames(5, 100))
    dataset = hdf5.Hdf5Dataset(path)
    truth = stack([dataset[index].truth for index in range(5)])
    members = {}
    of = SimpleNamespace(
        data=["--data", str(path), "--format", "caper"], diverged=set(), degrees=None
    )

    def train_many(configs, directory, initial):
        members.update(configs)
        return [
            MemberResult(
                name,
                config,
                directory / name,
                name not in of.diverged,
                9 if name in of.diverged else None,
            )
            for name, config in configs.items()
        ]

    def load(category, folder):
        name = str(folder).split("/runs/")[1]
        return SimpleNamespace(
            category=categories.get(category),
            variables=np.array([members[name].training.seed]),
            card={},
            name=name,
        )

    def estimate_all(variables, clouds, category, used):
        (config,) = {
            c.network: c
            for c in members.values()
            if c.network.joints == used.joints and c.network.rotation == used.rotation
        }.values()
        angles = [of.degrees(config, used, seed) for seed in variables[:, 0].tolist()]
        return stack([disturbed(truth, angle) for angle in angles])

    monkeypatch.setattr(study_run, "train_many", train_many)
    monkeypatch.setattr(study_measure, "load", load)
    monkeypatch.setattr(study_measure, "_estimate_all", estimate_all)
    of.members = members
    return of


STUDY = """
title = "Heads"
baseline = "voting"
categories = ["laptop"]
seeds = 3
[variants.voting]
[variants.direct.network]
joints = "direct"
[variants.once.estimate]
refine_steps = 0
"""


def ablate(tmp_path, *options, text=STUDY):
    path = tmp_path / "heads.toml"
    path.write_text(text)
    out = tmp_path / "out"
    return cli.main(["ablate", "--config", str(path), "--out", str(out), *options]), out


def test_variants_stand_beside_the_baseline_with_intervals(trained, tmp_path, monkeypatch, capsys):
    hdf5_frames(monkeypatch, tmp_path)
    spread = {0: 0.0, 1: 0.3, 2: 0.1}

    def degrees(config, used, seed):
        common = 2.0 + seed  # what a seed is worth to every variant alike
        if used.joints == "direct":
            return common + 1.0 + spread[seed]
        return common + (0.5 if used.refine_steps == 0 else 0.0)

    trained.degrees = degrees
    code, out = ablate(tmp_path)
    assert code == 0
    output = capsys.readouterr().out
    assert len(trained.members) == 6  # the third variant uses the models of the first
    assert cells(output, "laptop", "voting", "3")[0] == "3.00 ± 1.00"
    assert cells(output, "laptop", "direct", "3")[0] == "4.13 ± 1.06"
    label = "root rotation, median [deg]"
    # t(2) = 4.303, deviation of 1.0, 1.3, 1.1: 0.153.
    assert cells(output, "laptop", "direct", label) == [
        *("+1.13 *", "+0.75 to +1.51", "0.006", "3")
    ]
    assert cells(output, "laptop", "once", label)[:2] == ["+0.50 *", "+0.50 to +0.50"]
    lines = [json.loads(line) for line in (out / "heads.jsonl").read_text().splitlines()]
    assert [(line["variant"], line["seed"]) for line in lines] == [
        (variant, seed) for variant in ("voting", "direct", "once") for seed in range(3)
    ]
    assert lines[4]["parts"][0]["rotation_deg"]["mean"] == pytest.approx(4.3, abs=1e-3)
    found = json.loads((out / "heads.json").read_text())["categories"]["laptop"]
    assert found["against_baseline"]["direct"][label]["pairs"] == 3
    assert (out / "heads_differences.png").stat().st_size > 10_000


def hdf5_frames(monkeypatch, tmp_path):
    """Measures on the frames of the fixture instead of generated ones."""
    from caper_jax.reproduce import ablations

    dataset = hdf5.Hdf5Dataset(tmp_path / "laptop.h5")
    monkeypatch.setattr(ablations, "open_frames", lambda *_: (dataset, "five frames"))


def test_a_diverged_member_is_named_and_its_pair_left_out(trained, tmp_path, monkeypatch, capsys):
    hdf5_frames(monkeypatch, tmp_path)
    trained.diverged.add("laptop/direct_3000steps_seed1")
    trained.degrees = lambda config, used, seed: 1.0 + seed
    assert ablate(tmp_path)[0] == 0
    output = capsys.readouterr().out
    assert cells(output, "laptop", "direct", "2")[0] == "2.00 ± 1.41"
    label = "root rotation, median [deg]"
    assert cells(output, "laptop", "direct", label)[0] == "+0.00"
    assert "laptop/direct_3000steps_seed1 diverged by step 9" in output


def test_settings_of_the_command_line_are_those_of_all_trainings(trained, tmp_path, monkeypatch):
    hdf5_frames(monkeypatch, tmp_path)
    trained.degrees = lambda *_: 1.0
    options = ["--seeds", "1", "--steps", "50", "--preset", "fast", "--training.batch-size", "4"]
    assert ablate(tmp_path, *options)[0] == 0
    assert list(trained.members) == ["laptop/fast_50steps_seed0", "laptop/direct_50steps_seed0"]
    for config in trained.members.values():
        assert (config.training.steps, config.training.batch_size) == (50, 4)
        assert config.network.num_points == 1024


def test_ablations_stand_beside_the_paper(trained, tmp_path, capsys):
    trained.degrees = lambda config, used, seed: 4.0 if used.joints == "direct" else 1.0
    few = [*trained.data, "--category", "laptop", "--seeds", "1", "--frames", "5"]
    with pytest.MonkeyPatch.context() as patch:
        only(patch, "full", "direct joints")
        assert run("ablations", tmp_path, *few) == 0
    output = capsys.readouterr().out
    assert cells(output, "laptop", "base", "full") == ["3.1", "0.063", "3.15"]
    assert cells(output, "laptop", "lid", "efficientcaper")[0] == "4.0"
    assert cells(output, "laptop", "direct joints", "1")[:2] == ["4.00 ± -", "4.00 ± -"]


def only(patch, *variants):
    """Leaves these variants of a study that ships."""
    from dataclasses import replace

    from caper_jax.reproduce import ablations, study

    def read(source):
        found = study.read_study(source)
        return replace(found, variants={name: found.variants[name] for name in variants})

    patch.setattr(ablations, "read_study", read)


def test_figure_eleven_splits_the_error_by_axis(trained, tmp_path, capsys):
    trained.degrees = lambda config, used, seed: 6.0 if used.rotation == "quaternion" else 1.5
    data = [*trained.data, "--category", "laptop", "--seeds", "2", "--frames", "5"]
    assert run("figure11", tmp_path, *data) == 0
    row = cells(capsys.readouterr().out, "laptop", "direct", "2")
    # Turned about x: all of it is pitch, and every axis but x is off by it.
    shown = [cell.split(" ")[0] for cell in row]
    assert shown[:6] == ["6.00", "6.00", "0.00", "0.00", "6.00", "0.00"]
    assert shown[6:] == ["0.00" if axis == "x" else "6.00" for axis in LAPTOP.directions]
    assert (tmp_path / "figure11_laptop.png").stat().st_size > 10_000


def test_increments_are_tracked_by_the_network_alone(trained, tmp_path, monkeypatch, capsys):
    dataset = write_videos(tmp_path / "box.h5")

    def make(estimator, config):
        assert config.registration.steps == 0
        return KnownTracker(dataset, 4.0 if estimator.network.increment == "lie" else 5.0, 0.0)

    def estimator(category, used, variables, card):
        return SimpleNamespace(category=category, network=used, card=card)

    monkeypatch.setattr(study_measure, "Tracker", make)
    monkeypatch.setattr(study_measure, "Estimator", estimator)
    data = ["--data", str(tmp_path / "box.h5"), "--format", "caper"]
    assert run("table9", tmp_path, "--category", "box", "--seeds", "2", *data) == 0
    kinds = [config.network.increment for config in trained.members.values()]
    assert kinds == ["lie", "lie", "euclidean", "euclidean"]
    output = capsys.readouterr().out
    assert cells(output, "box", "lie", "2")[:2] == ["4.00 ± 0.00", "4.00 ± 0.00"]
    label = "root rotation, mean [deg]"
    assert cells(output, "box", "euclidean increments", label)[:2] == ["+1.00 *", "+1.00 to +1.00"]
    assert cells(output, "box", "base", "lie")[0] == "4.6"


def test_error_angles_are_those_that_scipy_composes():
    rng = np.random.default_rng(0)
    angles = rng.uniform(-80, 80, (20, 3))
    estimate = Rotation.random(20, rng=rng)
    truth = estimate * Rotation.from_euler("YXZ", angles, degrees=True)
    poses = [
        SimpleNamespace(rotation=rotation.as_matrix()[:, None].astype(np.float32))
        for rotation in (estimate, truth)
    ]
    np.testing.assert_allclose(study_measure.error_angles(*poses), angles, atol=1e-3)


def test_stage_one_sees_the_root_alone_where_there_is_enough_of_it():
    points = np.random.default_rng(0).uniform(0.5, 1.0, (100, 3)).astype(np.float32)
    few, many = np.ones(100, int), np.ones(100, int)
    few[:10], many[:60] = 0, 0
    frames = [SimpleNamespace(name="f", points=points, labels=labels) for labels in (few, many)]
    one, other = (study_measure._cloud(frame, 64, "root") for frame in frames)
    np.testing.assert_array_equal(one, study_measure.cloud_of(frames[0], 64))
    assert set(map(tuple, other)) <= set(map(tuple, points[:60]))
    frames[0].labels = None
    with pytest.raises(CaperError, match="'f'"):
        study_measure._cloud(frames[0], 64, "root")


def test_all_models_of_a_network_are_estimated_at_once(monkeypatch):
    """By one program; every model's poses are those of the estimator."""
    from _helpers.tiny import random_variables

    from caper_jax.estimator import Estimator

    config = network("fast", pool_first=True)
    models = [random_variables(LAPTOP, config, seed) for seed in (0, 1)]
    rng = np.random.default_rng(0)
    clouds = (rng.uniform(-0.1, 0.1, (3, 64, 3)) + [0, 0, 0.7]).astype(np.float32)
    stacked = study_measure.jax.tree.map(lambda *leaves: np.stack(leaves), *models)
    poses = study_measure._estimate_all(stacked, clouds, LAPTOP, config)
    for number, variables in enumerate(models):
        alone = Estimator(LAPTOP, config, variables)(clouds).pose
        np.testing.assert_allclose(poses.rotation[number], alone.rotation, atol=1e-4)
        np.testing.assert_allclose(poses.joint_state[number], alone.joint_state, atol=1e-4)
