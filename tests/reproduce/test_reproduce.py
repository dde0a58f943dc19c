"""``caper reproduce``: the paper's figures, ours beside them, and the files that say so."""

from __future__ import annotations

import dataclasses
import importlib
import json
import types
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from _helpers import formats
from _helpers.frames import random_frames, random_pose
from _helpers.quick import quick_jit
from _helpers.reproductions import cells, run
from _helpers.tiny import network, random_variables
from _helpers.tracks import BOX, KnownTracker, disturbed, track, write_videos
from PIL import Image
from scipy.spatial.transform import Rotation
from scipy.stats import linregress

from caper_jax import categories, cli
from caper_jax.articulation.symmetry import apply_symmetry
from caper_jax.cli.reproduce import OPTIONS, REPRODUCTIONS
from caper_jax.config import GeneratorConfig, RegistrationConfig, TrackerConfig, to_dict
from caper_jax.data import hdf5
from caper_jax.errors import CaperError
from caper_jax.evaluation import protocol
from caper_jax.evaluation.metrics import object_diagonal
from caper_jax.models.files import write_model
from caper_jax.reproduce import (
    comparison,
    increments,
    jitter,
    keyframes,
    modes,
    runs,
    static,
    tracking,
    trainings,
    videos,
)
from caper_jax.reproduce import frames as frames_of_tables
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import OCCLUSION, TABLES
from caper_jax.reproduce.render import Curves, Table, markdown
from caper_jax.tracker import Tracker
from caper_jax.visualization.curves import write_curves

LAPTOP = categories.get("laptop")
SMALL = GeneratorConfig(instances=3, grid=24, num_points=64, noise=("none",))


@pytest.fixture
def known(tmp_path, monkeypatch):
    """Makes table4's box known: a file of videos and a tracker with given errors."""
    dataset = write_videos(tmp_path / "box.h5")
    monkeypatch.setattr(runs, "find_model", lambda *_: types.SimpleNamespace(category=BOX, card={}))

    def use(degrees, share):
        tracker = KnownTracker(dataset, degrees, share)
        monkeypatch.setattr(tracking, "Tracker", lambda *_: tracker)
        return tracker

    use.arguments = ["--category", "box", "--data", str(tmp_path / "box.h5"), "--format", "caper"]
    return use


class TestPaper:
    def test_figures_as_printed(self):
        box, drawer = TABLES["table4"].categories["box"], TABLES["table6"].categories["drawer"]
        assert (box.rotation_deg, box.translation_m) == ((4.6, 4.7), (0.008, 0.007))
        assert drawer.translation_m == (0.098, 0.170, 0.158, 0.153)
        assert TABLES["table6"].categories["dishwasher"].iou == (87.6, 72.1)
        assert TABLES["table5"].categories["robotarm"].rotation_deg[6] == 19.3
        assert TABLES["table10"].variants["none"]["robotarm"].translation_m[6] == 0.407
        assert TABLES["table9"].variants["euclidean"]["scissors"].rotation_deg == (10.6, 12.5)
        assert TABLES["table1"].categories["eyeglasses"].translation_m == (0.036, 0.103, 0.085)
        assert TABLES["table2"].categories["cutter"].iou == (97.2, 95.9)
        assert TABLES["table3"].categories["robotarm"].rotation_deg[0] == 0.04

    def test_tables_agree_where_they_show_the_same_run(self):
        for name, figures in TABLES["table9"].variants["lie"].items():
            same = TABLES["table4"].categories[name]
            assert figures == dataclasses.replace(same, iou=())
        arm = TABLES["table5"].categories["robotarm"]
        rounded = TABLES["table10"].variants["dynamic"]["robotarm"]
        np.testing.assert_allclose(rounded.rotation_deg, arm.rotation_deg, atol=0.081)
        assert rounded.translation_m == arm.translation_m

    @pytest.mark.parametrize("name", TABLES)
    def test_a_figure_for_every_part(self, name):
        table = TABLES[name]
        for found in (table.categories, *table.variants.values()):
            for category, figures in found.items():
                parts = len(figures.rotation_deg)
                assert len(figures.translation_m) == parts and len(figures.iou) in (0, parts)
                reart_drawer = category == "drawer" and table.dataset.startswith("ReArt")
                assert parts == (2 if reart_drawer else categories.get(category).num_parts)

    def test_relative_figures_name_their_diagonal(self):
        laptop = TABLES["table6"].categories["laptop"]
        np.testing.assert_allclose(laptop.translation_relative(), (0.0315, 0.029))


def test_the_truth_scores_perfectly_in_every_run(known, tmp_path, capsys):
    known(0.0, 0.0)
    assert run("table4", tmp_path / "out", *known.arguments, "--given-masks") == 0
    output = capsys.readouterr().out
    assert (tmp_path / "out" / "table4.md").read_text() in output
    for label in ("given", "estimated", "given, part masks given"):
        for part, paper in (
            ("base", ("4.60", "0.008", "87.3")),
            ("lid", ("4.70", "0.007", "80.1")),
        ):
            row = cells(output, "box", part, label)
            assert (row[0], row[3], row[7]) == paper
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
    """The second reading of a laptop's truth is wrong by far, and perfect up to symmetry."""
    dataset = write_videos(tmp_path / "laptop.h5", category=LAPTOP)
    source = videos.Videos(LAPTOP, dataset, dataset.videos(), "two videos")
    tracks = []
    for name in dataset.videos():
        truths = [frame.truth for frame in source.frames(name)]
        truth = jax.tree.map(lambda *rows: np.stack(rows), *truths)
        (symmetry,) = LAPTOP.symmetries
        truth.size[:, 1] = truth.size[:, 0] @ np.abs(np.array(symmetry.rotation))
        tracks.append(track(name, truth, apply_symmetry(truth, symmetry, LAPTOP)))
    found = runs.summarize(tracks, source, runs.Condition())
    assert found["frames"] == 6 and found["mean_diagonal_m"] > 0
    rows = comparison.rows("laptop", "given", found, TABLES["table6"].categories["laptop"])
    assert [row[2] for row in rows] == 2 * ["given"] + 2 * ["given, up to symmetry"]
    assert float(rows[0][4]) > 10
    for row in rows[2:]:
        assert row[4] == row[8] == "0.00" and row[11:] == ["100.0", "100.0"]


def test_categories_without_model_or_data_are_named_and_not_invented(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(runs, "shipped_weights", lambda: tmp_path)
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
    monkeypatch.setattr(
        runs, "find_model", lambda *_: types.SimpleNamespace(category=LAPTOP, card={})
    )
    data = ["--data", str(tmp_path / "box.h5"), "--format", "caper"]
    assert run("table6", tmp_path / "out", "--category", "laptop", *data) == 0
    assert cells(capsys.readouterr().out, "laptop", "lid", "no data")[0] == "5.00"


class TestStatic:
    """Tables of single frames, with an estimator that knows the truth, or almost."""

    @pytest.fixture
    def known(self, tmp_path, monkeypatch):
        """Frames of a box, and the arguments that name them."""
        hdf5.write(
            tmp_path / "box.h5",
            category=BOX,
            split="test",
            visibility=np.tile([0.9, 0.15], (5, 1)),
            **random_frames(5, 1500),
        )
        fake = types.SimpleNamespace(category=BOX, network=network())
        monkeypatch.setattr(runs, "find_model", lambda *_: fake)
        monkeypatch.setattr(static, "model_predictor", lambda _: protocol.truth_predictor)
        return ["--category", "box", "--data", str(tmp_path / "box.h5"), "--format", "caper"]

    def test_the_truth_scores_perfectly(self, known, tmp_path, capsys):
        assert run("table2", tmp_path / "out", *known) == 0
        output = capsys.readouterr().out
        means, spreads = output.split("**All errors")
        row = cells(means, "box", "lid", "as labeled")
        assert row[:9] == ["1.50", "0.00", "0.00", "0.012", "4.30", "0.00", "0.00", "90.1", "100.0"]
        assert cells(spreads, "box", "lid", "as labeled", "0.00 / 0.00")[:3] == [
            *("0.0", "0.0 / 0.0", "100.0 / 100.0")
        ]
        assert "5 frames of" in output and "0 failures" in output
        content = json.loads((tmp_path / "out" / "table2.json").read_text())
        assert content["categories"]["box"]["frames"] == 5
        assert run("table2", tmp_path / "out", *known, "--frames", "2") == 0
        assert "2 frames of" in capsys.readouterr().out

    def test_a_failure_counts_with_the_distance_over_the_diagonal(
        self, known, tmp_path, capsys, monkeypatch
    ):
        def fails(frames, points):
            pose = protocol.truth_predictor(frames, points)
            return dataclasses.replace(pose, rotation=np.full_like(pose.rotation, np.nan))

        monkeypatch.setattr(static, "model_predictor", lambda _: fails)
        assert run("table2", tmp_path, *known) == 0
        output = capsys.readouterr().out
        assert "5 failures" in output
        assert cells(output, "box", "lid", "as labeled", "180.00 / 180.00")[0] == "100.0"
        found = json.loads((tmp_path / "table2.json").read_text())["categories"]["box"]["parts"]
        truth = random_frames(5, 1500)["pose"]
        share = np.linalg.norm(truth.translation, axis=-1) / object_diagonal(truth)[:, None]
        assert [part["rotation_deg"]["mean"] for part in found] == [180.0, 180.0]
        relative = [part["translation_relative"]["mean"] for part in found]
        np.testing.assert_allclose(relative, share.mean(0), rtol=1e-4)

    def test_parts_are_sorted_by_what_is_hidden(self, known, tmp_path, capsys):
        assert run("table8", tmp_path, *known) == 0
        output = capsys.readouterr().out
        for share, count, turn in (
            *(("0-40 %", "5", "0.00"), ("40-80 %", "0", "-"), ("80-100 %", "5", "0.00")),
        ):
            assert cells(output, "box", share)[:3] == [count, "-", turn]
        assert OCCLUSION[0.8, 1.0] == (2.0, 0.095)

    @pytest.mark.parametrize(
        ("name", "finds"), [("table1", "find_model"), ("reliability", "need_models")]
    )
    def test_models_are_scaled_as_asked(self, name, finds, tmp_path, capsys, monkeypatch):
        def refuse(*arguments):
            raise CaperError(f"asked at scale {arguments[-1]}")

        monkeypatch.setattr(runs, finds, refuse)
        assert run(name, tmp_path, "--category", "laptop", "--object-scale", "4.5") == 2
        assert "asked at scale 4.5" in capsys.readouterr().err

    def test_frames_are_those_of_generate_and_drawn_once(self, tmp_path, monkeypatch):
        small = dataclasses.replace(SMALL, num_points=64, measure_visibility=True)
        monkeypatch.setattr(jax, "jit", quick_jit)
        draw = partial(frames_of_tables.generated_frames, tmp_path, LAPTOP, 3, config=small)
        first, description = draw()
        assert "3 generated frames, noise none, seed 0, of 3 test instances" in description
        file = tmp_path / "own.h5"
        generate = ["generate", "--category", "laptop", "--frames", "3", "--instances", "3"]
        generate += ["--grid", "24", "--points", "64", "--noise", "none", "--out", str(file)]
        assert cli.main(generate) == 0
        own = hdf5.Hdf5Dataset(file, "laptop", "test")
        for mine, other in zip(first, own, strict=True):
            assert mine.name == other.name
            np.testing.assert_array_equal(mine.points, other.points)
        monkeypatch.setattr(frames_of_tables, "collect_frames", None)  # would be called in vain
        again, _ = draw()
        np.testing.assert_array_equal(again[2].points, first[2].points)


class TestModels:
    @pytest.fixture
    def folder(self, tmp_path):
        config = network()
        card = {"category": "laptop", "run": {"network": to_dict(config)}}
        write_model(tmp_path / "models" / "laptop", random_variables(LAPTOP, config), card)
        return tmp_path / "models"

    def test_a_folder_of_models_or_one_of_them(self, folder):
        for weights in (folder, folder / "laptop"):
            assert runs.find_model("laptop", weights).category is LAPTOP
            assert runs.find_model("box", weights) is None
        assert list(runs.need_models((), folder)) == ["laptop"]
        with pytest.raises(CaperError, match="no model of box"):
            runs.need_models(("laptop", "box"), folder)
        with pytest.raises(CaperError, match="neither a model directory nor a folder of them"):
            runs.find_model("laptop", folder.parent / "nothing")

    def test_jitter_from_videos_to_report(self, folder, tmp_path, capsys, monkeypatch):
        """The one compiled tracker; its weights are random, so only the plumbing is looked at."""
        dataset = write_videos(tmp_path / "laptop.h5", category=LAPTOP)
        asked = []

        def draw(*arguments):
            asked.append(arguments)
            return videos.Videos(LAPTOP, dataset, dataset.videos(), "two videos")

        monkeypatch.setattr(runs, "generated_videos", draw)
        config = TrackerConfig(registration=RegistrationConfig(gaussians=32))
        monkeypatch.setattr(runs, "config_for", lambda _: config)
        monkeypatch.setattr(jax, "jit", quick_jit)
        options = ["--weights", str(folder), "--network-alone", "--seed", "5", "--videos", "7"]
        options += ["--noise", "none"]
        assert run("jitter", tmp_path, *options) == 0
        clean = dataclasses.replace(videos.TEST_DATA, noise=("none",))
        assert asked == [(tmp_path / "videos", LAPTOP, "still", 7, 30, 5, clean)]
        output = capsys.readouterr().out
        for label in ("given", "estimated"):
            row = cells(output, "laptop", "base", label)
            assert len(row) == 8 and all(float(cell) >= 0 for cell in row)
        assert "laptop: two videos" in output and "without registration" in output
        found = json.loads((tmp_path / "jitter.json").read_text())["categories"]["laptop"]
        assert set(found) == {
            *("frame_by_frame", "tracked, first pose given", "tracked, first pose estimated")
        }
        # Random frames, each estimated by itself.
        assert found["frame_by_frame"][0]["shift_m"] > 0.01


def test_generated_videos_are_drawn_once(tmp_path, monkeypatch):
    draw = partial(videos.generated_videos, tmp_path, LAPTOP, "still", 3, 4, config=SMALL)
    first = draw()
    assert list(first.index.values()) == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]
    assert first.dataset.split == "test" and first.dataset.attributes["mode"] == "still"
    assert "3 generated videos of 4 frames, mode still (camera and root" in first.description
    states = [frame.truth.joint_state[0] for frame in first.frames("00001")]
    assert np.ptp(states) == 0
    drawn = []
    monkeypatch.setattr(videos.hdf5, "write", lambda path, **_: drawn.append(path))
    monkeypatch.setattr(videos, "collect_videos", lambda *_: {})
    again = draw()
    assert drawn == []
    np.testing.assert_array_equal(again.dataset[5].points, first.dataset[5].points)
    # Shapes that have changed since: the file is not of these arguments any more.
    monkeypatch.setattr(videos, "fingerprint", lambda _: 1)
    draw()
    with pytest.raises(CaperError, match=r"seed1\.h5: no such file"):
        draw(seed=1)
    names = [f"laptop_still_none_3x4x64_seed{seed}.h5" for seed in (0, 1)]
    assert [path.name for path in drawn] == names


def test_videos_of_a_public_layout_and_frames_that_are_none(tmp_path):
    (tmp_path / "pm").mkdir()
    root = formats.write_root("pm-videos", tmp_path / "pm")
    found = videos.dataset_videos("pm-videos", root, LAPTOP, None, 1)
    ((name, index),) = found.index.items()
    assert [frame.name for frame in found.frames(name)] == [found.dataset.names[i] for i in index]
    assert all(frame.startswith(name) for frame in map(found.dataset.names.__getitem__, index))
    assert videos.dataset_videos("pm-videos", root, BOX, None, None) is None
    single = formats.write_root("caper", tmp_path)
    with pytest.raises(CaperError, match="holds single frames, no videos, of box"):
        videos.dataset_videos("caper", single, BOX, None, None)


class TestKeyframes:
    def test_only_without_keyframes_nothing_comes_to_the_rescue(self):
        options = Options(out=Path("out"), network_alone=True)
        estimator = types.SimpleNamespace(card={"tracker": {"damping": 0.5}})
        configs = {
            policy: keyframes.policy_config(policy, estimator, options)
            for policy in ("none", "fixed")
        }
        assert configs["none"].policy == "none" and configs["none"].patience > 10**6
        assert configs["fixed"].patience == runs.tracker_config(estimator, options).patience < 10
        assert all(config.registration.steps == 0 for config in configs.values())
        assert all(config.damping == 0.5 for config in configs.values())

    def test_slopes_are_those_of_the_videos(self):
        rng = np.random.default_rng(0)
        frames = np.arange(1, 30)
        errors = rng.normal(size=(5, 29)) + rng.normal(size=(5, 1)) * frames
        slopes = [linregress(frames, row).slope for row in errors]
        found = keyframes.slope(frames, errors)
        assert found["slope"] == pytest.approx(linregress(frames, errors.mean(0)).slope)
        assert found["standard_error"] == pytest.approx(np.std(slopes, ddof=1) / 5**0.5)
        assert keyframes.slope(frames, errors[:1])["standard_error"] is None

    def test_errors_that_grow_by_known_steps(self):
        """0.1 and 0.3 degrees per frame: 0.2 in the mean, with a standard error of 0.1."""
        tracks = []
        for number, step in enumerate((0.1, 0.3)):
            truth = random_pose(11, number)
            turns = Rotation.from_euler("x", step * np.arange(11)[:, None], degrees=True)
            rotation = truth.rotation @ turns.as_matrix()[:, None]
            tracks.append(track(str(number), truth, dataclasses.replace(truth, rotation=rotation)))
        growth = keyframes.error_growth(tracks, BOX)
        turn = growth["parts"]["lid"]["rotation_deg"]
        assert growth["frames"] == list(range(1, 11))
        np.testing.assert_allclose(turn["mean"], 0.2 * np.arange(1, 11), atol=1e-4)
        assert turn["slope"] == pytest.approx(0.2, abs=1e-5)
        assert turn["standard_error"] == pytest.approx(0.1, abs=1e-5)
        rows = keyframes.growth_rows("box", "none", growth)
        assert rows[1] == ["box", "none", "lid", "20.000 ± 10.000", "0.000 ± 0.000"]


def test_trembling_is_the_change_from_frame_to_frame():
    """Parts that jump to and fro by 2 degrees and 1 % of the diagonal after the first frame."""
    truth = random_pose(1, 3)
    truth = dataclasses.replace(truth, **{k: np.repeat(v, 6, 0) for k, v in vars(truth).items()})
    far, near = disturbed(truth, 2.0, 0.01), truth
    odd = np.arange(6) % 2 == 1
    mixed = {}
    for field, value in vars(far).items():
        chosen = odd.reshape(-1, *[1] * (value.ndim - 1))
        mixed[field] = np.where(chosen, value, getattr(near, field))
    pose = dataclasses.replace(truth, **mixed)
    pose.rotation[0] = pose.rotation[0] @ Rotation.from_euler("y", 1.0).as_matrix()
    (base, lid) = jitter.tremble([pose], [truth], BOX)
    assert lid["turn_deg"] == pytest.approx(2.0, abs=1e-4)
    shift = np.linalg.norm(far.translation[1, 1] - truth.translation[1, 1])
    assert lid["shift_m"] == pytest.approx(shift, rel=1e-5)
    assert base["rotation_error_deg"] == pytest.approx(2.0 * 3 / 5, abs=1e-3)
    still = jitter.tremble([truth], [truth], BOX)
    assert [part["turn_deg"] for part in still] == [0.0, 0.0]
    row = jitter.jitter_rows("box", "given", [lid], [{**lid, "turn_deg": 4.0}])[0]
    assert row[:6] == ["box", "lid", "given", "2.000", "4.000", "0.500"]


def summary(turn, shift, iou=0.5):
    """Of one part, as ``summarize_tracks`` has it."""
    values = {"rotation_deg": turn, "translation_relative": shift, "iou_full": iou}
    return {"parts": [{"name": "base", **{key: {"mean": v} for key, v in values.items()}}]}


def test_modes_are_compared_by_their_ratio():
    found = {"paper": summary(1, 0.01), "cam": summary(2, 0.02), "hard": summary(3, 0.05, 0.25)}
    assert modes.mode_rows("box", found) == [
        [
            *("box", "base", "1.00", "2.00", "3.00", "1.50", "1.00", "2.00", "5.00", "2.50"),
            *("50.0", "50.0", "25.0", "0.50"),
        ]
    ]


class TestIncrements:
    LIE = (summary(4.0, 0.02), summary(5.0, 0.03), summary(6.0, 0.04))
    EUCLIDEAN = (summary(7.0, 0.02), summary(7.0, 0.02), summary(10.0, 0.02))

    def test_means_spreads_and_differences(self):
        paper = TABLES["table9"].variants["lie"]["box"]
        (row,) = increments.kind_rows("box", "lie", self.LIE, paper)
        assert row[3:] == ["4.6", "5.00 ± 1.00", "0.008", "2.87", "3.00 ± 1.00"]
        (row,) = increments.kind_rows("box", "lie", self.LIE[:1], paper)
        assert row[4] == "4.00 ± -"
        found = {"lie": self.LIE, "euclidean": self.EUCLIDEAN}
        (row,) = increments.difference_rows("box", found)
        # sqrt((1 + 3) / 3) and sqrt(1 / 3).
        assert (row[4], row[7]) == ("3.00 ± 1.15", "-1.00 ± 0.58")

    def test_each_run_has_its_kind_seed_and_budget(self, tmp_path, monkeypatch):
        started = []

        def train(config, directory, initial):
            assert initial is None
            started.append((config, directory))
            return types.SimpleNamespace(finished=len(started) < 2)

        monkeypatch.setattr(trainings.training, "train", train)
        monkeypatch.setattr(
            trainings, "load", lambda *_: types.SimpleNamespace(network=None, card={})
        )
        options = Options(out=tmp_path, steps=7, overrides=("training.batch_size=3",))
        change = ("network.increment=euclidean",)
        with pytest.raises(CaperError, match="finished run of another network"):
            trainings.trained("box", "euclidean", change, 2, options)
        with pytest.raises(KeyboardInterrupt):
            trainings.trained("box", "lie", (), 0, options)
        (first, folder), (second, other) = started
        assert first.network == dataclasses.replace(second.network, increment="euclidean")
        assert (first.training.steps, first.training.minutes, first.training.seed) == (7, None, 2)
        assert first.training.batch_size == 3
        assert (folder.name, other.name) == ("box_euclidean_7steps_seed2", "box_lie_7steps_seed0")

    def test_kinds_are_trained_and_tracked_by_the_network_alone(
        self, tmp_path, monkeypatch, capsys
    ):
        dataset = write_videos(tmp_path / "box.h5")
        asked = []

        def trained(category, kind, changes, seed, options):
            assert list(changes) == [f"network.increment={kind}"]
            asked.append((kind, seed))
            return types.SimpleNamespace(card={"steps": 1000 + seed}, kind=kind, seed=seed)

        def make(estimator, config):
            assert config.registration.steps == 0
            return KnownTracker(dataset, 4.0 if estimator.kind == "lie" else 5.0, 0.0)

        monkeypatch.setattr(trainings, "trained", trained)
        monkeypatch.setattr(increments, "Tracker", make)
        data = ["--data", str(tmp_path / "box.h5"), "--format", "caper"]
        assert run("table9", tmp_path, "--category", "box", "--seeds", "2", *data) == 0
        assert asked == [("lie", 0), ("lie", 1), ("euclidean", 0), ("euclidean", 1)]
        output = capsys.readouterr().out
        assert cells(output, "box", "base", "lie")[:2] == ["4.6", "4.00 ± 0.00"]
        assert cells(output, "box", "lid", "euclidean - lie")[1] == "1.00 ± 0.00"
        assert "box, lie: 1,000, 1,001 training steps" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table4", "--category", "laptop"], "unknown category of this table 'laptop'"),
        (["table4", "--category", "box", "--data", "x"], "--data needs --format"),
        (["table2", "--category", "box", "--data", "x"], "--data needs --format"),
        (["table2", "--category", "box", "--split", "train"], "--split goes with --data"),
        (["table4", "--category", "box", "--split", "train"], "--split goes with --data"),
        (["table3", "--noise", "fog"], "unknown data.noise entry 'fog'"),
        (
            ["table2", "--noise", "none", "--data", ".", "--format", "reartmix"],
            "--noise is of generated depth",
        ),
        (
            ["table4", "--category", "box", "--data", "x", "--format", "caper", "--mode", "cam"],
            "--mode is of generated videos",
        ),
        (["jitter", "--category", "box", "--frames", "2"], "--frames must be 3 or more"),
        (["jitter", "--category", "boxx"], "did you mean 'box'?"),
        (["table9", "--steps", "3", "--minutes", "2"], "--steps and --minutes exclude each other"),
        (["table6", "--weights", "nothing"], "neither a model directory nor a folder of them"),
        (["modes", "--weights", "nothing"], "neither a model directory nor a folder of them"),
    ],
)
def test_mistakes_are_named(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments[:1], tmp_path / "out", *arguments[1:]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_every_reproduction_can_be_asked_for():
    fields = {field.name for field in dataclasses.fields(Options)}
    assert set(OPTIONS) <= fields
    for reproduction in REPRODUCTIONS.values():
        assert set(reproduction.options) <= set(OPTIONS)
        module = importlib.import_module(f"caper_jax.reproduce.{reproduction.module}")
        assert callable(module.run)


def test_tables_are_readable_as_they_are():
    table = Table("Errors", ["part", "turn"], [["base", "1.00"], ["the lid", "12.00"]])
    report = types.SimpleNamespace(title="Table 0", tables=[table], facts=["one thing"])
    assert markdown(report).splitlines() == [
        *("# Table 0", "", "**Errors**", ""),
        "| part    |  turn |",
        "| ------- | ----: |",
        "| base    |  1.00 |",
        "| the lid | 12.00 |",
        *("", "- one thing"),
    ]


def test_curves_are_drawn(tmp_path):
    x = np.arange(50)
    lines = {"none": (x, 0.1 * x), "dynamic": (x, np.ones(50))}
    write_curves(tmp_path / "a.png", Curves("growth", "frame", "error [deg]", lines))
    with Image.open(tmp_path / "a.png") as image:
        colors = np.asarray(image.convert("RGB")).reshape(-1, 3)
    for wanted in ((31, 119, 180), (255, 127, 14)):  # matplotlib's first two colors
        assert (colors == wanted).all(1).sum() > 100


def test_the_tracker_of_a_table_is_the_library_s():
    assert tracking.Tracker is keyframes.Tracker is jitter.Tracker is Tracker
