"""Tables of tracking, with trackers whose errors are known."""

from __future__ import annotations

import dataclasses
import json
import types
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from _helpers.frames import random_pose
from _helpers.quick import traced_jit
from _helpers.reproductions import cells, run
from _helpers.tiny import network, random_variables
from _helpers.tracks import BOX, KnownTracker, disturbed, track, write_videos
from scipy.spatial.transform import Rotation
from scipy.stats import linregress

from caper_jax import categories
from caper_jax.articulation.symmetry import apply_symmetry
from caper_jax.config import RegistrationConfig, TrackerConfig, to_dict
from caper_jax.models.files import write_model
from caper_jax.reproduce import data, motion, tracking
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import paper
from caper_jax.reproduce.report import error_rows
from caper_jax.tracker import Tracker

LAPTOP = categories.get("laptop")


@pytest.fixture
def known(tmp_path, monkeypatch):
    """Makes table4's box known: a file of videos and a tracker with given errors."""
    dataset = write_videos(tmp_path / "box.h5")
    monkeypatch.setattr(data, "find_model", lambda *_: types.SimpleNamespace(category=BOX, card={}))

    def use(degrees, share):
        tracker = KnownTracker(dataset, degrees, share)
        monkeypatch.setattr(tracking, "Tracker", lambda *_: tracker)
        return tracker

    use.arguments = ["--category", "box", "--data", str(tmp_path / "box.h5"), "--format", "caper"]
    return use


def test_the_truth_scores_perfectly_in_every_run(known, tmp_path, capsys):
    known(0.0, 0.0)
    assert run("table4", tmp_path / "out", *known.arguments, "--given-masks") == 0
    output = capsys.readouterr().out
    assert (tmp_path / "out" / "table4.md").read_text() in output
    for label in ("given", "estimated", "given, part masks given"):
        for part, figures in (
            ("base", ("4.60", "0.008", "87.3")),
            ("lid", ("4.70", "0.007", "80.1")),
        ):
            row = cells(output, "box", part, label)
            assert (row[0], row[3], row[7]) == figures
            assert row[1:3] == ["0.00", "0.00"] and row[5:7] == ["0.00", "0.00"]
            assert row[8:] == ["100.0", "100.0"]
        # Two videos of four frames; the first of each was a lost keyframe and does not count.
        assert cells(output, "box", label)[-1] != "-"
    content = json.loads((tmp_path / "out" / "table4.json").read_text())
    box = content["categories"]["box"]
    assert [one["frames"] for one in box["runs"]] == [6, 6, 6]
    assert [one["keyframes"] + one["lost"] for one in box["runs"]] == [0, 0, 0]
    assert [one["part_masks"] for one in box["runs"]] == ["predicted", "predicted", "given"]
    assert box["paper"]["assumed_diagonal_m"] == 0.279
    assert content["machine"]["cores"] >= 1
    assert "2 videos, 8 frames" in output and "object masks simulated" in output


def test_errors_stand_beside_the_papers_with_their_ratio(known, tmp_path, capsys):
    tracker = known(2.3, 0.01)
    assert run("table4", tmp_path, *known.arguments) == 0
    output = capsys.readouterr().out
    for label in ("given", "estimated"):
        row = cells(output, "box", "base", label)
        # 0.008 m of 0.279 m are 2.87 %.
        assert row[:7] == ["4.60", "2.30", "0.50", "0.008", "2.87", "1.00", "0.35"]
        assert row[8] == "100.0" and 0 < float(row[9]) < 100
        assert cells(output, "box", "lid", label)[2] == "0.49"
    # Each video: before, after the compiling call and, if the pose is given, with it.
    assert tracker.resets == 2 * [False, False, True] + 2 * [False, False]
    assert not any(tracker.labels)


def test_the_declared_symmetry_has_rows_of_its_own(tmp_path):
    """The other of a laptop's equivalent poses: wrong by far, and perfect up to symmetry."""
    dataset = write_videos(tmp_path / "laptop.h5", category=LAPTOP)
    videos = data.Videos(LAPTOP, dataset, dataset.videos(), "two videos")
    tracks = []
    for name in dataset.videos():
        truths = [frame.truth for frame in videos.frames(name)]
        truth = jax.tree.map(lambda *rows: np.stack(rows), *truths)
        (symmetry,) = LAPTOP.symmetries
        truth.size[:, 1] = truth.size[:, 0] @ np.abs(np.array(symmetry.rotation))
        tracks.append(track(name, truth, apply_symmetry(truth, symmetry, LAPTOP)))
    summary = tracking.summarize(tracks, videos, tracking.Condition())
    assert summary["frames"] == 6 and summary["mean_diagonal_m"] > 0
    figures = paper().tables["table6"].categories["laptop"]
    rows = error_rows("laptop", "given", summary, figures)
    assert [row[2] for row in rows] == 2 * ["given"] + 2 * ["given, up to symmetry"]
    assert float(rows[0][4]) > 10
    for row in rows[2:]:
        assert row[4] == row[8] == "0.00" and row[11:] == ["100.0", "100.0"]


def test_categories_without_model_or_data_are_named_and_not_invented(tmp_path, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(data, "shipped_weights", lambda: tmp_path)
        assert run("table5", tmp_path / "out") == 0
        output = capsys.readouterr().out
        row = cells(output, "robotarm", "link 6", "no model")
        assert row == ["19.30", "-", "-", "0.139", "12.64", "-", "-", "-", "-", "-"]
        content = json.loads((tmp_path / "out" / "table5.json").read_text())
        assert content["categories"]["robotarm"]["missing"] == "no model"
        assert run("table10", tmp_path / "out") == 0
        output = capsys.readouterr().out
        assert cells(output, "robotarm", "base", "none: no model")[0] == "0.30"
        assert not list((tmp_path / "out").glob("*.png"))

    write_videos(tmp_path / "box.h5")
    model = types.SimpleNamespace(category=LAPTOP, card={})
    monkeypatch.setattr(data, "find_model", lambda *_: model)
    arguments = ["--data", str(tmp_path / "box.h5"), "--format", "caper"]
    assert run("table6", tmp_path / "out", "--category", "laptop", *arguments) == 0
    assert cells(capsys.readouterr().out, "laptop", "lid", "no data")[0] == "5.00"


def test_only_without_keyframes_nothing_comes_to_the_rescue():
    options = Options(out=Path("out"), network_alone=True)
    estimator = types.SimpleNamespace(card={"tracker": {"damping": 0.5}})
    configs = {
        policy: tracking.policy_config(policy, estimator, options) for policy in ("none", "fixed")
    }
    assert configs["none"].policy == "none" and configs["none"].patience > 10**6
    assert configs["fixed"].patience == tracking.tracker_config(estimator, options).patience < 10
    assert all(config.registration.steps == 0 for config in configs.values())
    assert all(config.damping == 0.5 for config in configs.values())


def test_slopes_are_those_of_the_videos():
    rng = np.random.default_rng(0)
    frames = np.arange(1, 30)
    errors = rng.normal(size=(5, 29)) + rng.normal(size=(5, 1)) * frames
    slopes = [linregress(frames, row).slope for row in errors]
    fitted = tracking.slope(frames, errors)
    assert fitted["slope"] == pytest.approx(linregress(frames, errors.mean(0)).slope)
    assert fitted["standard_error"] == pytest.approx(np.std(slopes, ddof=1) / 5**0.5)
    assert tracking.slope(frames, errors[:1])["standard_error"] is None


def test_table_ten_with_errors_that_grow_by_known_steps(known, tmp_path, capsys, monkeypatch):
    """0.1 and 0.3 degrees per frame: 0.2 in the mean, with a standard error of 0.1."""
    tracks = []
    for number, step in enumerate((0.1, 0.3)):
        truth = random_pose(11, number)
        rotations = Rotation.from_euler("x", step * np.arange(11)[:, None], degrees=True)
        rotation = truth.rotation @ rotations.as_matrix()[:, None]
        tracks.append(track(str(number), truth, replace(truth, rotation=rotation)))
    monkeypatch.setattr(tracking, "Tracker", lambda *_: None)
    monkeypatch.setattr(tracking, "track_all", lambda *_: tracks)
    assert run("table10", tmp_path, *known.arguments) == 0
    output = capsys.readouterr().out
    assert cells(output, "box", "none", "lid") == ["20.000 ± 10.000", "0.000 ± 0.000"]
    assert (tmp_path / "table10_box_rotation.png").stat().st_size > 1000
    content = json.loads((tmp_path / "table10.json").read_text())["categories"]["box"]
    growth = content["policies"]["fixed"]["growth"]
    rotation = growth["parts"]["lid"]["rotation_deg"]
    assert growth["frames"] == list(range(1, 11))
    np.testing.assert_allclose(rotation["mean"], 0.2 * np.arange(1, 11), atol=1e-4)
    assert rotation["slope"] == pytest.approx(0.2, abs=1e-5)
    assert rotation["standard_error"] == pytest.approx(0.1, abs=1e-5)


def test_jitter_is_the_change_from_frame_to_frame():
    """Parts that jump to and fro by 2 degrees and 1 % of the diagonal after the first frame."""
    truth = random_pose(1, 3)
    truth = replace(truth, **{key: np.repeat(value, 6, 0) for key, value in vars(truth).items()})
    far = disturbed(truth, 2.0, 0.01)
    odd = np.arange(6) % 2 == 1
    pose = jax.tree.map(
        lambda a, b: np.where(odd.reshape(-1, *[1] * (a.ndim - 1)), a, b), far, truth
    )
    pose.rotation[0] = pose.rotation[0] @ Rotation.from_euler("y", 1.0).as_matrix()
    (base, lid) = motion.measure_jitter([pose], [truth], BOX)
    assert lid["rotation_change_deg"] == pytest.approx(2.0, abs=1e-4)
    shift = np.linalg.norm(far.translation[1, 1] - truth.translation[1, 1])
    assert lid["translation_change_m"] == pytest.approx(shift, rel=1e-5)
    assert base["rotation_error_deg"] == pytest.approx(2.0 * 3 / 5, abs=1e-3)
    still = motion.measure_jitter([truth], [truth], BOX)
    assert [part["rotation_change_deg"] for part in still] == [0.0, 0.0]
    row = motion.jitter_rows("box", "given", [lid], [{**lid, "rotation_change_deg": 4.0}])[0]
    assert row[:6] == ["box", "lid", "given", "2.000", "4.000", "0.500"]


def test_jitter_from_videos_to_report(tmp_path, capsys, monkeypatch):
    """A tracker that is traced, not compiled: only the plumbing is looked at."""
    config = network()
    card = {"category": "laptop", "run": {"network": to_dict(config)}}
    write_model(tmp_path / "models" / "laptop", random_variables(LAPTOP, config), card)
    dataset = write_videos(tmp_path / "laptop.h5", category=LAPTOP)
    requests = []

    def draw(*arguments):
        requests.append(arguments)
        return data.Videos(LAPTOP, dataset, dataset.videos(), "two videos")

    monkeypatch.setattr(data, "generated_videos", draw)
    config = TrackerConfig(registration=RegistrationConfig(gaussians=32))
    monkeypatch.setattr(tracking, "config_for", lambda _: config)
    monkeypatch.setattr(jax, "jit", traced_jit)
    options = ["--weights", str(tmp_path / "models"), "--network-alone"]
    options += ["--seed", "5", "--videos", "7", "--noise", "none"]
    assert run("jitter", tmp_path, *options) == 0
    clean = dataclasses.replace(data.VIDEO_DATA, noise=("none",))
    assert requests == [(tmp_path / "videos", LAPTOP, "still", 7, 30, 5, clean)]
    output = capsys.readouterr().out
    for label in ("given", "estimated"):
        row = cells(output, "laptop", "base", label)
        assert len(row) == 8 and all(float(cell) >= 0 for cell in row)
    assert "laptop: two videos" in output and "without registration" in output
    content = json.loads((tmp_path / "jitter.json").read_text())["categories"]["laptop"]
    assert set(content) == {
        *("frame_by_frame", "tracked, first pose given", "tracked, first pose estimated")
    }
    # Random frames, each estimated by itself.
    assert content["frame_by_frame"][0]["translation_change_m"] > 0.01


def test_modes_are_compared_by_their_ratio():
    def summary(rotation, translation, iou):
        values = {"rotation_deg": rotation, "translation_relative": translation, "iou_full": iou}
        part = {"name": "base", **{key: {"mean": value} for key, value in values.items()}}
        return {"parts": [part]}

    summaries = {
        "paper": summary(1, 0.01, 0.5),
        "cam": summary(2, 0.02, 0.5),
        "hard": summary(3, 0.05, 0.25),
    }
    assert motion.mode_rows("box", summaries) == [
        [
            *("box", "base", "1.00", "2.00", "3.00", "1.50", "1.00", "2.00", "5.00", "2.50"),
            *("50.0", "50.0", "25.0", "0.50"),
        ]
    ]


def test_the_tracker_of_a_table_is_the_library_s():
    assert tracking.Tracker is motion.Tracker is Tracker
