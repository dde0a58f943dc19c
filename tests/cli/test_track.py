"""``caper track``: what it reads, what it writes, the streams it follows, the mistakes it names."""

import io
import json
import os
import socket
import sys
import threading
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from _helpers.arm import ARM, arm_pose
from _helpers.depth_videos import write_video
from _helpers.frames import random_frames, random_pose
from PIL import Image

from caper_jax import categories, cli
from caper_jax.cli import realsense, track, track_videos
from caper_jax.config import TrackerConfig, override
from caper_jax.data import hdf5
from caper_jax.data.live import pack_frame, read_frames
from caper_jax.errors import CaperError
from caper_jax.evaluation.tracking import Track, format_tracks
from caper_jax.models import plausibility
from caper_jax.tracker import Tracker
from caper_jax.tracking.step import TrackResult
from caper_jax.visualization.track import evenly_spaced, write_states

BOX = categories.get("box")
POINTS = 64
SHIFT = np.float32(0.002)
CLOUD = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32) * 0.1 + [0, 0, 1]


class Scripted(Tracker):
    """Says of frame i of every video the i-th pose it was given, 2 mm too far away."""

    def __init__(self, pose, config):
        self.estimator = SimpleNamespace(
            category=BOX, network=SimpleNamespace(num_points=POINTS), variables=None
        )
        self.config, self.pose, self.given, self.starts = config, pose, [], 0
        self.reset()

    def reset(self, points=None, rotation=None, translation=None, labels=None):
        self.number = 0
        self.starts += points is not None

    def __call__(self, points, labels=None, gravity=None):
        index = self.number % len(self.pose.joint_state)
        pose = jax.tree.map(lambda array: array[index], self.pose)
        pose = pose.replace(translation=pose.translation + SHIFT * np.array([0, 0, 1], np.float32))
        missing = not self.observe(points).present
        self.given.append(labels)
        self.number += 1
        second, energy = self.number == 2, np.float32(0.01 * self.number)
        reason = np.int32(plausibility.FEW_POINTS if missing else plausibility.PLAUSIBLE)
        verdict = not missing, reason, np.float32(1.0), np.int32(0 if missing else POINTS)
        return TrackResult(pose, np.arange(POINTS) % 2, energy, second, second, missing, *verdict)


@pytest.fixture
def scripted(monkeypatch):
    """Replaces the models; gives the trackers that were asked for."""
    made = []

    def load(category, weights, config, object_scale, camera_roll):
        made.append(Scripted(random_pose(5), override(TrackerConfig(), *config)))
        return made[-1]

    monkeypatch.setattr("caper_jax.tracker.load_tracker", load)
    return made


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Two labeled videos of 5 frames, the same but for their names, and single frames."""
    monkeypatch.chdir(tmp_path)
    frames = random_frames(5, POINTS)
    twice = jax.tree.map(lambda array: np.concatenate([array, array]), frames)
    facts = {"category": BOX, "split": "test"}
    number = np.arange(10)
    hdf5.write("videos.h5", **facts, **twice, video=3 + 4 * (number // 5), frame=number % 5)
    hdf5.write("single.h5", **facts, **frames)
    return tmp_path


def run(*arguments):
    return cli.main(["track", "--category", "box", *arguments])


def test_a_labeled_file(files, scripted, capsys):
    assert run("--data", "videos.h5", "--start", "truth", "--out", "a/b") == 0
    output = capsys.readouterr().out
    assert max(map(len, output.splitlines())) <= 80
    assert "box: 2 videos, 10 frames" in output
    assert "start: truth; keyframes: dynamic, energy above 0.03 or 12 % unmatched" in output
    assert "object masks: simulated; part masks: predicted" in output
    out = files / "a" / "b"
    names = [stem + end for stem in ("00003", "00007") for end in (".jsonl", ".png", "_states.png")]
    assert sorted(os.listdir(out)) == sorted([*names, "metrics.json"])
    for name in names:
        if name.endswith(".png"):
            with Image.open(out / name) as image:
                assert min(image.size) > 300
    lines = (out / "00007.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    assert [record["name"] for record in records] == [f"{number:06d}" for number in range(5, 10)]
    assert [record["keyframe"] for record in records] == [False, True, False, False, False]
    pose = random_pose(5)
    for index, record in enumerate(records):
        for part, found in enumerate(record["parts"]):
            assert found["name"] == BOX.parts[part]
            np.testing.assert_allclose(found["rotation"], pose.rotation[index, part], atol=1e-6)
            shifted = pose.translation[index, part] + [0, 0, 0.002]
            np.testing.assert_allclose(found["translation"], shifted, atol=1e-6)
            np.testing.assert_allclose(found["size"], pose.size[index, part], atol=1e-6)
        state = record["joints"][0]["state"]
        assert state == pytest.approx(np.degrees(pose.joint_state[index, 0]), abs=1e-4)
    metrics = json.loads((out / "metrics.json").read_text())
    for part in metrics["parts"]:
        assert part["translation_m"]["mean"] == pytest.approx(0.002, rel=1e-3)
        assert part["rotation_deg"]["mean"] == pytest.approx(0.0, abs=0.05)
    assert metrics["frames"] == 8 and metrics["videos"] == 2 and metrics["keyframes"] == 2
    assert metrics["start"] == "truth" and metrics["part_masks"] == "predicted"
    assert metrics["format"] == "caper" and metrics["tracker"]["policy"] == "dynamic"
    assert scripted[0].starts == 2 and scripted[0].given == [None] * 12


def test_videos_masks_and_settings_are_chosen(files, scripted, capsys):
    settings = ["--tracker.policy", "fixed", "--tracker.interval=4", "--tracker.threshold", "0.5"]
    settings += ["--tracker.registration.steps=0", "--set", "tracker.kalman=false"]
    choice = ["--video", "00007", "--given-masks", "--out", "out"]
    assert run("--data", "videos.h5", *choice, *settings) == 0
    (tracker,) = scripted
    config = tracker.config
    assert (config.policy, config.interval, config.threshold) == ("fixed", 4, 0.5)
    assert config.registration.steps == 0 and not config.kalman
    expected = random_frames(5, POINTS)["labels"]
    np.testing.assert_array_equal(tracker.given[1:], expected)
    assert tracker.starts == 0
    assert sorted(os.listdir("out")) == [
        "00007.jsonl", "00007.png", "00007_states.png", "metrics.json",
    ]  # fmt: skip
    assert json.loads((files / "out" / "metrics.json").read_text())["part_masks"] == "given"
    output = capsys.readouterr().out
    assert "part masks: given" in output and "keyframes: fixed, every 4 frames" in output
    assert run("--data", "videos.h5", "--videos", "1", "--out", "first") == 0
    assert sorted(os.listdir("first"))[0] == "00003.jsonl" and len(os.listdir("first")) == 4


def test_a_folder_has_no_truth_and_may_lose_the_object(files, scripted, capsys):
    home = write_video(files / "kitchen")
    (home / "mask" / "f2.png").unlink()
    (files / "out").mkdir()
    (files / "out" / "metrics.json").write_text("{}")  # of an earlier run, on data with truth
    assert run("--data", "kitchen", "--out", "out") == 0
    assert sorted(os.listdir("out")) == ["kitchen.jsonl", "kitchen.png", "kitchen_states.png"]
    text = (files / "out" / "kitchen.jsonl").read_text()
    records = [json.loads(line) for line in text.splitlines()]
    assert [record["name"] for record in records] == ["kitchen/f1", "kitchen/f2", "kitchen/f10"]
    assert [record["lost"] for record in records] == [False, True, False]
    output = capsys.readouterr().out
    assert "object masks: mask images" in output and "errors" not in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data", "videos.h5"], "--data needs --out"),
        (["--data", "absent.h5", "--out", "o"], "absent.h5: no such file"),
        (["--data", ".", "--out", "o"], "--data .: give --format, one of caper"),
        (["--data", "single.h5", "--out", "o"], "holds single frames, no videos"),
        (["--data", ".", "--format", "reartmix", "--out", "o"], "unknown format of videos"),
        (["--data", "videos.h5", "--video", "00004", "--out", "o"], "did you mean '00007'"),
        (["--data", "videos.h5", "--out", "videos.h5"], "videos.h5 is a file; give a folder"),
        (["--data", "videos.h5", "--tracker.policy", "never", "--out", "o"], "dynamic"),
        (["--data", "videos.h5", "--tracker.phi", "1", "--out", "o"], "phi"),
        (["--data", "videos.h5", "--set", "phi=1", "--out", "o"], "tracker"),
        (["--data", "videos.h5", "--depth-scale", "1", "--out", "o"], "goes with --format folder"),
        (["--data", ".", "--format", "folder", "--split", "test", "--out", "o"], "has no splits"),
        (["--live", "-", "--out", "o"], "--out goes with --data, not --live"),
        (["--live", "-", "--given-masks"], "--given-masks goes with --data"),
        (["--live", "-", "--start", "truth"], "a stream has no ground truth"),
        (["--live", "here"], "give HOST:PORT"),
        (["--live", "localhost:99999"], "give HOST:PORT"),
        (["--live", "-", "--data", "videos.h5"], "--data, videos, or --live"),
        ([], "--data, videos, or --live"),
    ],
)
def test_mistakes_are_one_line_and_code_2(files, scripted, capsys, arguments, message):
    before = sorted(os.listdir())
    assert run(*arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.out == ""
    assert captured.err.splitlines()[-1].startswith("caper track: error: ")
    assert not scripted and sorted(os.listdir()) == before


def test_truth_and_masks_that_the_data_lack_are_named(files, scripted, capsys):
    write_video(files / "kitchen")
    for option, message in (
        (["--start", "truth"], "'kitchen/f1' has no ground truth"),
        (["--given-masks"], "'kitchen/f1' has no part labels"),
    ):
        assert run("--data", "kitchen", "--out", "out", *option) == 2
        assert message in capsys.readouterr().err


class TestLive:
    """Streams of clouds."""

    def feed(self, monkeypatch, content):
        stream = io.BytesIO(content)
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=stream, isatty=lambda: False))

    def test_records_are_what_the_tracker_says(self, monkeypatch, capsys):
        tracker = Scripted(random_pose(5), TrackerConfig())
        clouds = [CLOUD, np.zeros((0, 3)), CLOUD + np.array([0.01, 0, 0])]
        self.feed(monkeypatch, b"".join(pack_frame(c, 7 + n) for n, c in enumerate(clouds)))
        monkeypatch.setattr("caper_jax.tracker.load_tracker", lambda **_: tracker)
        tracker(CLOUD)  # what came before is forgotten
        assert run("--live", "-") == 0
        captured = capsys.readouterr()
        records = [json.loads(line) for line in captured.out.splitlines()]
        tracker.reset()
        results = [tracker(cloud.astype(np.float32)) for cloud in clouds]
        assert [record["name"] for record in records] == [7, 8, 9]
        assert [record["lost"] for record in records] == [bool(r.lost) for r in results]
        assert records[1]["lost"] and all(record["skipped"] == 0 for record in records)
        for record, result in zip(records, results, strict=True):
            _, lid = record["parts"]
            np.testing.assert_allclose(lid["rotation"], result.pose.rotation[1], atol=1e-6)
            np.testing.assert_allclose(lid["translation"], result.pose.translation[1], atol=1e-6)
        assert "3 frames tracked" in captured.err and "0 skipped" in captured.err

    def test_a_fault_comes_after_the_frames_before_it(self, scripted, monkeypatch, capsys):
        for content, message in (
            (pack_frame(1000 * CLOUD, 12), "frame 12: "),
            (b"nonsense nonsense", "frame 1 of the stream begins with"),
        ):
            self.feed(monkeypatch, pack_frame(CLOUD, 11) + content)
            assert run("--live", "-") == 2
            captured = capsys.readouterr()
            assert [json.loads(line)["name"] for line in captured.out.splitlines()] == [11]
            assert message in captured.err and "1 frames tracked" in captured.err

    def test_a_terminal_is_no_stream(self, scripted, monkeypatch, capsys):
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
        assert run("--live", "-") == 2
        assert "that is a terminal" in capsys.readouterr().err

    def test_every_frame_of_a_socket_is_tracked_or_counted(self, scripted, capsys):
        with socket.create_server(("localhost", 0)) as server:

            def serve():
                connection, _ = server.accept()
                with connection:
                    for number in range(40):
                        connection.sendall(pack_frame(CLOUD, number))

            thread = threading.Thread(target=serve)
            thread.start()
            assert run("--live", f"localhost:{server.getsockname()[1]}") == 0
            thread.join()
        records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        numbers = [record["name"] for record in records]
        assert numbers == sorted(set(numbers)) and numbers[-1] == 39
        assert len(records) + sum(record["skipped"] for record in records) == 40

    def test_a_stream_can_be_left_while_the_sender_pauses(self):
        with socket.create_server(("localhost", 0)) as server:

            def follow():
                with track.open_stream(f"localhost:{server.getsockname()[1]}") as frames:
                    next(iter(frames))

            thread = threading.Thread(target=follow, daemon=True)
            thread.start()
            connection, _ = server.accept()
            with connection:
                connection.sendall(pack_frame(CLOUD, 0))
                thread.join(10)
                assert not thread.is_alive()

    def test_nobody_listening_is_named(self, scripted, capsys):
        with socket.create_server(("localhost", 0)) as server:
            port = server.getsockname()[1]
        assert run("--live", f"localhost:{port}") == 2
        message = capsys.readouterr().err
        # Compiled before it connects.
        assert message.startswith("ready\n") and "cannot connect" in message

    def test_the_summary_of_an_empty_stream(self, scripted, capsys):
        track.track_stream(Scripted(random_pose(1), TrackerConfig()), iter(()))
        assert "0 frames tracked" in capsys.readouterr().err


class TestReport:
    """Records and tables of any category."""

    def track(self, name, reasons=(0, 0, 0)):
        pose = jax.tree.map(lambda array: np.stack([array] * 3), arm_pose())
        marks = np.array([True, False, False])
        energy = np.array([2.0, 0.01, 0.02])
        return Track(
            name=name,
            frames=["a", "b", "c"],
            pose=pose,
            truth=pose,
            energy=energy,
            keyframe=marks,
            estimated=marks,
            lost=~marks,
            plausible=np.array(reasons) == 0,
            reason=np.array(reasons),
            size_ratio=np.ones(3),
            distinct_points=np.full(3, 60),
            seconds=np.ones(3) * 0.02,
        )

    def test_long_names_keep_the_table_narrow(self):
        arguments = (ARM, TrackerConfig(policy="none"), "estimator", "masks", "predicted", None)
        text = format_tracks([self.track("x" * 90 + "/tail"), self.track("short")], *arguments)
        lines = text.splitlines()
        assert max(map(len, lines)) <= 100
        assert lines[-2].split()[0].endswith("/tail")
        assert lines[-1].split() == ["short", "3", "1", "1", "2", "20.0"]

    def test_implausible_frames_are_counted_and_explained(self):
        arguments = (ARM, TrackerConfig(), "estimator", "masks", "predicted", None)
        reasons = (0, plausibility.FEW_POINTS, plausibility.SEVERAL)
        text = format_tracks([self.track("one", reasons), self.track("two")], *arguments)
        joined = " ".join(text.split())
        assert "one: 2 implausible frames, the first is b: only 60 different points" in joined
        assert "two: " not in joined and max(map(len, text.splitlines())) <= 80

    def test_curves_of_both_kinds_of_joints(self, tmp_path):
        for threshold in (0.03, None):
            path = write_states(tmp_path / "states.png", self.track("$a_b$"), ARM, threshold)
            with Image.open(path) as image:
                assert image.size[0] > 800

    def test_evenly_spaced(self):
        assert evenly_spaced(1) == [0] and evenly_spaced(5) == [0, 1, 2, 3, 4]
        chosen = evenly_spaced(100, 12)
        assert len(chosen) == 12 and (chosen[0], chosen[-1]) == (0, 99)
        assert set(np.diff(chosen)) == {9}

    def test_file_names_are_safe_and_never_shared(self):
        names = ["a/b", "a b", "A-B", "../..", "a-b_states", "küche"]
        stems = track_videos.file_stems(names)
        assert stems == ["a-b", "a-b-2", "A-B-3", "video", "a-b_states-2", "küche"]


class TestRealSense:
    """The feeder, with a camera that is none."""

    ARGUMENTS = ("--box", "45,35,105,85", "--width", "160", "--height", "120", "--frames", "2")

    @pytest.fixture
    def camera(self, monkeypatch):
        """A block on a table in the first image, the table alone in the second."""
        depth = np.full((120, 160), 8000, np.uint16)
        block = depth.copy()
        block[40:80, 50:100] = 7800
        images = [block, depth]

        def wait():
            if not images:
                raise RuntimeError("Frame didn't arrive within 5000")
            image = images.pop(0)
            return SimpleNamespace(get_depth_frame=lambda: SimpleNamespace(get_data=lambda: image))

        camera = SimpleNamespace(fx=300.0, fy=310.0, ppx=79.5, ppy=59.5)
        stream = SimpleNamespace(get_intrinsics=lambda: camera)
        sensor = SimpleNamespace(get_depth_scale=lambda: 1e-4)
        profile = SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
            get_stream=lambda _: SimpleNamespace(as_video_stream_profile=lambda: stream),
        )
        pipeline = SimpleNamespace(
            start=lambda _: profile, wait_for_frames=wait, stop=lambda: images.append("stopped")
        )
        module = SimpleNamespace(
            pipeline=lambda: pipeline,
            config=lambda: SimpleNamespace(enable_stream=lambda *_: None),
            stream=SimpleNamespace(depth="depth"),
            format=SimpleNamespace(z16="z16"),
        )
        monkeypatch.setitem(sys.modules, "pyrealsense2", module)
        return SimpleNamespace(images=images, pipeline=pipeline)

    def test_what_stands_on_the_table_is_sent(self, camera, capsysbinary):
        assert realsense.main(self.ARGUMENTS) == 0
        first, second = read_frames(io.BytesIO(capsysbinary.readouterr().out))
        assert (first.sequence, second.sequence) == (0, 1)
        np.testing.assert_allclose(first.points[:, 2], 0.78, rtol=1e-5)
        u = first.points[:, 0] / first.points[:, 2] * 300 + 79.5
        v = first.points[:, 1] / first.points[:, 2] * 310 + 59.5
        assert u.min() > 49.9 and u.max() < 99.1 and v.min() > 39.9 and v.max() < 79.1
        assert second.points.shape == (0, 3)

    def test_mistakes_are_named(self, camera, capsysbinary, monkeypatch):
        with pytest.raises(CaperError, match="is empty in 160 x 120 pixels"):
            realsense.main(["--box", "160,0,170,9", "--width", "160", "--height", "120"])
        with pytest.raises(CaperError, match="the camera stopped sending"):
            realsense.main(self.ARGUMENTS[:-2])
        assert camera.images == ["stopped"]

        def absent(_):
            raise RuntimeError("No device connected")

        camera.pipeline.start = absent
        with pytest.raises(CaperError, match=r"no RealSense camera gives depth .*No device"):
            realsense.main(self.ARGUMENTS)
        monkeypatch.setitem(sys.modules, "pyrealsense2", None)
        with pytest.raises(CaperError, match="pip install pyrealsense2"):
            realsense.main(self.ARGUMENTS)
