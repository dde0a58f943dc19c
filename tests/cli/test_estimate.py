"""``caper estimate``: inputs it takes, outputs it writes, mistakes it names."""

import dataclasses
import json
import os

import jax
import numpy as np
import pytest
from _helpers.frames import random_pose
from PIL import Image
from scipy.spatial.transform import Rotation

from caper_jax import cli, estimator
from caper_jax.estimator import Prediction
from caper_jax.models import plausibility
from caper_jax.models.hypotheses import Hypotheses

CAMERA = {"fx": 300.0, "fy": 310.0, "cx": 79.5, "cy": 59.5}


def prediction(points, pose, reason=0):
    return Prediction(
        pose=pose,
        points=points,
        labels=np.arange(points.shape[1], dtype=np.int32)[None] % 2,
        confidence=np.array([[0.75, 0.5]], np.float32),
        degenerate=np.array([False]),
        points_per_part=np.array([[points.shape[1] - 3, 3]], np.int32),
        plausible=np.array([reason == 0]),
        reason=np.array([reason], np.int32),
        size_ratio=np.array([5.0], np.float32),
        distinct_points=np.array([points.shape[1]], np.int32),
        evidence=np.zeros((1, 2, 12), np.float32),
        plausibility=np.array([0.25], np.float32),
        rotation_std=np.radians(np.array([[1.25, 2.5]], np.float32)),
        translation_std=np.array([[0.004, 0.006]], np.float32),
        state_std=np.radians(np.array([[3.0]], np.float32)),
    )


@pytest.fixture
def seen(monkeypatch):
    """Replaces the estimator by one fixed pose; returns the clouds it is given."""
    clouds = []

    class Estimator:
        def __call__(self, points, gravity=None):
            clouds.append(np.asarray(points))
            return prediction(points, random_pose(1))

    monkeypatch.setattr("caper_jax.estimator.load", lambda *_, **__: Estimator())
    return clouds


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A block 2 cm high on a table seen from straight above, its mask, camera and cloud."""
    monkeypatch.chdir(tmp_path)
    depth = np.full((120, 160), 800, np.uint16)
    mask = np.zeros((120, 160), np.uint8)
    mask[40:80, 50:100] = 255
    depth[mask > 0] = 780
    depth[60, 70] = 0
    Image.fromarray(depth).save("depth.png")
    Image.fromarray(mask).save("mask.png")
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    np.save("cloud.npy", np.random.default_rng(0).normal(size=(700, 3)) * 0.1 + [0, 0, 1])
    return tmp_path


IMAGE = ["--depth", "depth.png", "--intrinsics", "camera.json"]


def run(*arguments):
    return cli.main(["estimate", "--category", "box", *arguments])


def test_pose_is_printed_and_written(files, seen, capsys):
    assert run(*IMAGE, "--mask", "mask.png", "--json", "pose.json") == 0
    (cloud,) = seen
    assert cloud.shape == (1, 1024, 3) and cloud.dtype == np.float32
    np.testing.assert_allclose(cloud[..., 2], 0.78, rtol=1e-6)
    record = json.loads((files / "pose.json").read_text())
    pose = jax.tree.map(lambda array: array[0], random_pose(1))
    assert record["category"] == "box" and record["name"] == "depth.png"
    assert record["points"] == {"available": 1999, "dropped": 1}
    assert record["confidence"] == [0.75, 0.5]
    base, lid = record["parts"]
    assert (base["name"], base["points"], base["hidden"]) == ("base", 1021, False)
    assert (lid["name"], lid["points"], lid["hidden"]) == ("lid", 3, True)
    assert lid["rotation_std_deg"] == pytest.approx(2.5)
    assert lid["translation_std"] == pytest.approx(0.006)
    np.testing.assert_allclose(lid["rotation"], pose.rotation[1], atol=1e-6)
    (joint,) = record["joints"]
    assert joint["state"] == pytest.approx(np.degrees(pose.joint_state[0]), rel=1e-5)
    assert joint["state_std"] == pytest.approx(3.0)
    table = capsys.readouterr().out
    assert f"{np.degrees(pose.joint_state[0]):.1f}°" in table
    assert " ".join(f"{value:.3f}" for value in pose.translation[1]) in table
    assert "1999 points, 1 dropped" in table
    assert "confidence in the root's axes (0 to 1): x 0.75, z 0.50" in table
    assert "lid: standard deviation 2.5 deg, 6 mm" in table
    assert "base – lid: standard deviation 3.0°" in table
    assert "lid: hidden (3 points), known through its joint alone" in table
    assert max(map(len, table.splitlines())) <= 80


def test_what_is_not_plausible_is_said_in_one_line(files, monkeypatch, capsys):
    class Doubting:
        def __call__(self, points, gravity=None):
            found = prediction(points, random_pose(1), plausibility.TOO_LARGE)
            labels = np.array(found.labels)
            labels[0, :7] = -1
            return found.replace(labels=labels)

    monkeypatch.setattr("caper_jax.estimator.load", lambda *_, **__: Doubting())
    outputs = ["--json", "pose.json", "--picture", "pose.png", "--page", "pose.html"]
    assert run(*IMAGE, "--mask", "mask.png", *outputs) == 0
    captured = capsys.readouterr()
    (warning,) = [line for line in captured.err.splitlines() if line.startswith("warning: ")]
    assert "5.0 times too large" in warning and "--depth-scale 0.0002" in warning
    assert "7 of 1024 points looked at lie alone, and were left out" in captured.out
    record = json.loads((files / "pose.json").read_text())
    assert record["plausible"] is False and warning.endswith(record["reason"])
    assert (record["size_ratio"], record["plausibility"]) == (5.0, 0.25)
    assert record["distinct_points"] == 1024
    assert "5.0 times too large" in (files / "pose.html").read_text()


def test_what_is_plausible_needs_no_warning(files, seen, capsys):
    assert run(*IMAGE, "--mask", "mask.png", "--json", "pose.json") == 0
    assert "warning" not in capsys.readouterr().err
    record = json.loads((files / "pose.json").read_text())
    assert record["plausible"] is True and record["reason"] is None


def test_other_readings_and_gravity(files, monkeypatch, capsys):
    """A second reading of 23 %, turned by a half turn about y, and one of 2 %."""
    turns = Rotation.from_euler("y", [[0], [180], [90]], degrees=True).as_matrix()
    told = []

    class Torn:
        def __call__(self, points, gravity=None):
            told.append(gravity)
            found = prediction(points, random_pose(1))
            pose = jax.tree.map(lambda leaf: np.repeat(leaf[:, None], 3, 1), found.pose)
            rotation = pose.rotation[0] @ turns[:, None]
            stated = Hypotheses(
                dataclasses.replace(pose, rotation=rotation[None].astype(np.float32)),
                np.array([[0.7, 0.23, 0.02]], np.float32),
                np.zeros((1, 3), np.int32),
            )
            size = np.full((1, 2, 3), 0.0042, np.float32)
            return dataclasses.replace(found, hypotheses=stated, size_std=size)

    monkeypatch.setattr("caper_jax.estimator.load", lambda *_, **__: Torn())
    outputs = ["--json", "pose.json", "--picture", "pose.png", "--page", "pose.html"]
    assert run(*IMAGE, "--mask", "mask.png", "--gravity", "0.1,1,0", *outputs) == 0
    assert told == [(0.1, 1.0, 0.0)]
    output = capsys.readouterr().out
    assert "probability that this is right: 70 %\n" in output
    assert "another reading, with 23 %: the base turned by 180 deg about its y axis\n" in output
    assert "2 %" not in output
    assert "of its size 4 x 4 x 4 mm" in output
    record = json.loads((files / "pose.json").read_text())
    assert [one["probability"] for one in record["hypotheses"]] == [0.7, 0.23, 0.02]
    second = np.array(record["hypotheses"][1]["parts"][0]["rotation"])
    first = np.array(record["parts"][0]["rotation"])
    np.testing.assert_allclose(first.T @ second, turns[1], atol=1e-5)
    np.testing.assert_allclose(record["parts"][1]["size_std"], 0.0042, rtol=1e-4)
    assert '"probability":0.23' in (files / "pose.html").read_text()
    assert run(*IMAGE, "--mask", "mask.png", "--gravity", "0,0,0") == 2
    assert "'0,0,0' is no direction" in capsys.readouterr().err
    assert run(*IMAGE, "--mask", "mask.png", "--gravity", "down") == 2
    assert "'down' is not x,y,z" in capsys.readouterr().err


def test_a_detection_box_takes_the_table_away(files, seen):
    assert run(*IMAGE, "--box", "45,35,105,85") == 0
    assert (seen[0][..., 2] < 0.79).all()
    x = seen[0][..., 0] / seen[0][..., 2] * CAMERA["fx"] + CAMERA["cx"]
    assert x.min() > 49 and x.max() < 100


def test_clouds_and_depth_scale(files, seen):
    assert run("--points", "cloud.npy") == 0
    points = np.load("cloud.npy").astype(np.float32)
    assert {tuple(p) for p in seen[0][0]} <= {tuple(p) for p in points}
    with Image.open("depth.png") as image:
        Image.fromarray(np.asarray(image) * np.uint16(10)).save("fine.png")
    assert run(*IMAGE, "--mask", "mask.png", "--depth", "fine.png", "--depth-scale", "1e-4") == 0
    np.testing.assert_allclose(seen[1][..., 2], 0.78, rtol=1e-6)


def test_objects_of_another_scale_and_cameras_that_are_not_level(files, seen, monkeypatch):
    asked = []
    load = estimator.load
    monkeypatch.setattr("caper_jax.estimator.load", lambda *a, **_: asked.append(a) or load(*a))
    assert run("--points", "cloud.npy", "--object-scale", "2.5") == 0
    assert run("--points", "cloud.npy", "--camera-roll", "180") == 0
    assert asked == [("box", None, 2.5, 0.0), ("box", None, 1.0, 180.0)]


def test_pictures_and_pages_are_written(files, seen):
    assert run(*IMAGE, "--mask", "mask.png", "--picture", "pose.png", "--page", "pose.html") == 0
    with Image.open("pose.png") as picture:
        assert picture.size[0] > 500
    assert "depth.png" in (files / "pose.html").read_text()
    assert run("--points", "cloud.npy", "--picture", "cloud.png") == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([*IMAGE], "--depth needs either --mask or --box"),
        (["--depth", "depth.png", "--mask", "mask.png"], "--depth needs --intrinsics"),
        ([*IMAGE, "--mask", "absent.png"], "absent.png: no such file"),
        ([*IMAGE, "--mask", "mask.png", "--box", "1,2,3,4"], "--mask or --box"),
        ([*IMAGE, "--box", "1,2,3"], "is not x1,y1,x2,y2"),
        ([*IMAGE, "--box", "200,1,300,9"], "is empty in the 160 x 120 image"),
        (["--points", "cloud.npy", "--mask", "mask.png"], "--mask goes with --depth"),
        (["--points", "cloud.npy", "--depth-scale", "1"], "--depth-scale goes with --depth"),
        (["--points", "camera.json"], "must be .npy or .ply"),
        ([*IMAGE, "--mask", "mask.png", "--json", "mask.png"], "would overwrite mask.png"),
        ([*IMAGE, "--mask", "mask.png", "--json", "a/b.json"], "the folder a does not exist"),
        ([*IMAGE, "--mask", "mask.png", "--json", "."], "is a folder"),
        (["--points", "cloud.npy", "--json", "o", "--picture", "o"], "would overwrite o"),
    ],
)
def test_mistakes_are_one_line_and_code_2(files, seen, capsys, arguments, message):
    before = sorted(os.listdir())
    assert run(*arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.out == ""
    assert captured.err.splitlines()[-1].startswith("caper estimate: error: ")
    assert not seen and sorted(os.listdir()) == before


def test_a_mask_of_another_size_is_named(files, seen, capsys):
    Image.fromarray(np.full((60, 80), 255, np.uint8)).save("small.png")
    assert run(*IMAGE, "--mask", "small.png") == 2
    assert "depth is 160 x 120 but mask is 80 x 60" in capsys.readouterr().err


def test_an_estimate_that_is_not_finite_is_an_error(files, seen, capsys, monkeypatch):
    class Lost:
        def __call__(self, points, gravity=None):
            pose = jax.tree.map(lambda array: array * np.nan, random_pose(1))
            return prediction(points, pose)

    monkeypatch.setattr("caper_jax.estimator.load", lambda *_, **__: Lost())
    assert run("--points", "cloud.npy", "--json", "pose.json") == 2
    assert "no finite pose" in capsys.readouterr().err and not os.path.exists("pose.json")
