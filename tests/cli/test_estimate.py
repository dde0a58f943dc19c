"""``caper estimate``: inputs it takes, outputs it writes, mistakes it names."""

import json
import os

import jax
import numpy as np
import pytest
from _helpers.frames import random_pose
from PIL import Image

from caper_jax import cli, estimator
from caper_jax.estimator import Prediction

CAMERA = {"fx": 300.0, "fy": 310.0, "cx": 79.5, "cy": 59.5}


def prediction(points, pose):
    return Prediction(
        pose=pose,
        points=points,
        labels=np.arange(points.shape[1], dtype=np.int32)[None] % 2,
        confidence=np.array([[0.75, 0.5]], np.float32),
        degenerate=np.array([False]),
        points_per_part=np.array([[points.shape[1] - 3, 3]], np.int32),
        evidence=np.zeros((1, 2, 6), np.float32),
        rotation_std=np.radians(np.array([[1.25, 2.5]], np.float32)),
        translation_std=np.array([[0.004, 0.006]], np.float32),
        state_std=np.radians(np.array([[3.0]], np.float32)),
    )


@pytest.fixture
def seen(monkeypatch):
    """Replaces the estimator by one fixed pose; returns the clouds it is given."""
    clouds = []

    class Estimator:
        def __call__(self, points):
            clouds.append(np.asarray(points))
            return prediction(points, random_pose(1))

    monkeypatch.setattr("caper_jax.estimator.load", lambda *_: Estimator())
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
    result = json.loads((files / "pose.json").read_text())
    pose = jax.tree.map(lambda array: array[0], random_pose(1))
    assert result["category"] == "box" and result["parts"] == ["base", "lid"]
    assert result["units"] == {"length": "meters", "joint_state": ["degrees"]}
    assert "OpenCV" in result["frame"]
    assert result["points"] == {"available": 1999, "dropped": 1, "of_parts": [1021, 3]}
    assert result["hidden"] == [False, True]
    deviation = result["standard_deviation"]
    np.testing.assert_allclose(deviation["rotation_deg"], [1.25, 2.5], rtol=1e-6)
    np.testing.assert_allclose(deviation["translation"], [0.004, 0.006], rtol=1e-6)
    np.testing.assert_allclose(deviation["joint_state"], [3.0], rtol=1e-6)
    assert result["confidence"] == [0.75, 0.5]
    assert list(result["pose"]) == list(vars(pose))
    for key, expected in vars(pose).items():
        expected = np.degrees(expected) if key == "joint_state" else expected
        np.testing.assert_allclose(result["pose"][key], expected, rtol=1e-6)
    table = capsys.readouterr().out
    assert f"{np.degrees(pose.joint_state[0]):.1f}°" in table
    assert " ".join(f"{value:.3f}" for value in pose.translation[1]) in table
    assert "1999 points, 1 dropped" in table
    assert "confidence in the root's axes (0 to 1): x 0.75, z 0.50" in table
    assert "lid: standard deviation 2.5 deg, 6 mm" in table
    assert "base – lid: standard deviation 3.0°" in table
    assert "lid: hidden (3 points), known through its joint alone" in table
    assert max(map(len, table.splitlines())) <= 80


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
    monkeypatch.setattr("caper_jax.estimator.load", lambda *a: asked.append(a) or load(*a))
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
        ([*IMAGE], "--depth needs --mask or --box"),
        (["--depth", "depth.png", "--mask", "mask.png"], "--depth needs --intrinsics"),
        ([*IMAGE, "--mask", "absent.png"], "absent.png: no such file"),
        ([*IMAGE, "--mask", "mask.png", "--box", "1,2,3,4"], "not allowed with"),
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
        def __call__(self, points):
            pose = jax.tree.map(lambda array: array * np.nan, random_pose(1))
            return prediction(points, pose)

    monkeypatch.setattr("caper_jax.estimator.load", lambda *_: Lost())
    assert run("--points", "cloud.npy", "--json", "pose.json") == 2
    assert "no finite pose" in capsys.readouterr().err and not os.path.exists("pose.json")
