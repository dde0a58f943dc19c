"""Scenes, pictures, the page and tables."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from _helpers.arm import ARM, AXIS, PIVOT, ROOT, STATE, arm_pose, part_poses
from matplotlib.figure import Figure
from PIL import Image

from caper_jax import categories, cli
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.cli import demo
from caper_jax.errors import CaperError
from caper_jax.estimator import Prediction
from caper_jax.visualization import picture
from caper_jax.visualization import scene as scenes
from caper_jax.visualization.page import write_page
from caper_jax.visualization.picture import write_picture
from caper_jax.visualization.plots import save_figure
from caper_jax.visualization.scene import Scene, format_scene

# A deep tree with both joint types: the third joint sits on the second link.
INTRINSICS = np.array([[300.0, 0.0, 100.0], [0.0, 310.0, 80.0], [0.0, 0.0, 1.0]])


def arm_scene(**changes) -> Scene:
    """Points on the corners and middles of the boxes, over a slanted background."""
    pose = arm_pose()
    corners = scenes.box_corners(pose)
    points = np.concatenate([corners, (corners + corners.mean(1, keepdims=True)) / 2], axis=1)
    labels = np.repeat(np.arange(3, dtype=np.int32), 16)
    depth = np.linspace(0.7, 1.4, 160 * 200, dtype=np.float32).reshape(160, 200)
    depth[:20] = 0
    mask = np.zeros((160, 200), bool)
    mask[60:120, 60:150] = True
    scene = Scene(
        "frame 1",
        ARM,
        points.reshape(-1, 3).astype(np.float32),
        labels,
        pose,
        arm_pose(STATE + (0.05, 0.01)),
        depth,
        mask,
        INTRINSICS,
    )
    return replace(scene, **changes)


@pytest.fixture(scope="module")
def page_text(tmp_path_factory: pytest.TempPathFactory) -> str:
    name = 'a "frame" </script><b>'
    path = tmp_path_factory.mktemp("page") / "new" / "index.html"
    write_page(path, [arm_scene(name=name), arm_scene(truth=None)], "Title & <more>")
    return path.read_text("utf-8")


def read_png(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def page_data(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found
    return json.loads(found.group(1))


def test_projected_box_edges_are_those_of_the_solid():
    pose = arm_pose()
    pixels = scenes.project(scenes.box_corners(pose), INTRINSICS)
    for part, matrix in enumerate(part_poses(STATE)):
        edges = set()
        for axis in range(3):  # four parallel edges along each axis of the box
            for u in (-0.5, 0.5):
                for v in (-0.5, 0.5):
                    ends = []
                    for w in (-0.5, 0.5):
                        point = pose.box_center[part] + np.roll([w, u, v], axis) * pose.size[part]
                        image = INTRINSICS @ (matrix @ [*point, 1.0])[:3]
                        ends.append(tuple(np.round(image[:2] / image[2], 6)))
                    edges.add(frozenset(ends))
        drawn = {
            frozenset(tuple(np.round(pixels[part, end], 6)) for end in edge)
            for edge in scenes.BOX_EDGES
        }
        assert len(edges) == 12
        assert drawn == edges


def test_edges_at_the_farthest_corner_are_hidden():
    corners = scenes.CORNER_SIGNS * (0.1, 0.2, 0.3)
    hidden = scenes.hidden_edges(corners, eye=np.array([2.0, -1.5, 1.0]))
    farthest = int(np.argmin(corners @ [2.0, -1.5, 1.0]))
    assert hidden.tolist() == [farthest in edge for edge in scenes.BOX_EDGES]
    assert not scenes.hidden_edges(corners, eye=np.array([0.0, 0.0, 5.0]))[
        [index for index, (a, b) in enumerate(scenes.BOX_EDGES) if corners[[a, b], 2].min() > 0]
    ].any()


def test_joint_segments_are_the_lines_that_the_joint_leaves_in_place():
    parts = part_poses(STATE)
    segments = scenes.joint_segments(arm_pose(), ARM)
    # Points of a revolute axis do not move when the child does.
    relative = parts[1] @ np.linalg.inv(parts[0])
    for end in segments[0]:
        np.testing.assert_allclose((relative @ [*end, 1.0])[:3], end, atol=1e-12)
    pivot = (parts[0] @ [*PIVOT[0], 1.0])[:3]
    direction = np.diff(segments[0], axis=0)[0]
    direction /= np.linalg.norm(direction)
    np.testing.assert_allclose(np.cross(pivot - segments[0, 0], direction), 0, atol=1e-12)
    np.testing.assert_allclose(direction, parts[0, :3, :3] @ AXIS[0], atol=1e-12)
    # A prismatic axis points where a growing state moves the child: carried by the tilted link.
    further = part_poses(STATE + (0.0, 0.1))[2, :3, 3] - parts[2, :3, 3]
    slide = np.diff(segments[1], axis=0)[0]
    np.testing.assert_allclose(slide / np.linalg.norm(slide), further / 0.1, atol=1e-9)


def test_picture_shows_every_part_in_its_color(tmp_path: Path):
    path = write_picture(tmp_path / "new" / "picture.png", [arm_scene()])
    pixels = read_png(path).reshape(-1, 3)
    for part in range(3):
        color = [int(scenes.part_color(part)[at : at + 2], 16) for at in (1, 3, 5)]
        assert np.sum((pixels == color).all(-1)) > 50, ARM.parts[part]


@pytest.mark.parametrize(
    "changes",
    [
        {"truth": None, "depth": None, "mask": None, "intrinsics": None},
        {"mask": None},
        {"pose": replace(arm_pose(), translation=arm_pose().translation - (0.0, 0.0, 1.2))},
    ],
    ids=["cloud only", "no mask", "estimate behind the camera"],
)
def test_picture_and_page_of_odd_scenes(tmp_path: Path, changes: dict):
    scene = arm_scene(**changes)
    assert read_png(write_picture(tmp_path / "a.png", [scene])).shape[1] > 1000
    assert page_data(write_page(tmp_path / "a.html", [scene]).read_text("utf-8"))["scenes"]


def test_pictures_say_whether_there_was_an_image(tmp_path: Path, monkeypatch):
    drawn = []
    monkeypatch.setattr(picture, "save_figure", lambda figure, *_, **__: drawn.append(figure))
    write_picture(tmp_path / "a.png", [arm_scene()])
    cloud = {"truth": None, "depth": None, "mask": None, "intrinsics": None}
    write_picture(tmp_path / "a.png", [arm_scene(**cloud)])
    image, points = ([axes.get_title() for axes in figure.axes[:3]] for figure in drawn)
    assert image[:2] == ["Depth image and mask", "Estimate over the depth image"]
    assert points == ["Points by distance", "Estimate over the points", image[2]]


def test_page_loads_nothing_and_escapes_names(page_text: str):
    assert not re.search("https?:", page_text)
    code = re.sub(r'<script type="application/json".*?</script>', "", page_text, flags=re.S)
    assert not re.search(r"//[a-z]|<link|@import|url\(|\bsrc=|fetch\(|\bimport\b", code)
    assert page_text.count("</script>") == 2  # the data and the code
    assert "<title>Title &amp; &lt;more&gt;</title>" in page_text
    assert page_data(page_text)["scenes"][0]["name"] == 'a "frame" </script><b>'


def test_page_holds_points_sorted_by_part(page_text: str):
    first, second = page_data(page_text)["scenes"]
    points = np.frombuffer(base64.b64decode(first["points"]), "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(points, arm_scene().points)  # already in order of part
    assert first["counts"] == [16, 16, 16]
    assert first["image"].startswith("data:image/png;base64,")
    assert first["truth"] is not None
    assert second["truth"] is None
    low, high = first["joints"][1]["limits"]
    assert low <= 0.08 <= 0.09 <= high


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node to run the page's script")
def test_sliders_of_the_page_follow_forward_kinematics(page_text: str, tmp_path: Path):
    """The script moves boxes by joint changes; the oracle recomputes them from the new states."""
    states = STATE + (-1.1, 0.05)
    model = page_text.split("<script>")[1].split("// The camera, and")[0]
    script = tmp_path / "run.js"
    script.write_text(
        f"{model}\nconst scene = {json.dumps(page_data(page_text)['scenes'][0])};\n"
        f"const motions = partMotions(scene, {states.tolist()});\n"
        "console.log(JSON.stringify(scene.estimate.corners.map("
        "(corners, part) => corners.map((corner) => move(motions[part], corner)))));",
        "utf-8",
    )
    done = subprocess.run(["node", str(script)], capture_output=True, text=True, check=True)
    expected = scenes.box_corners(arm_pose(states))
    np.testing.assert_allclose(json.loads(done.stdout), expected, atol=5e-6)


def test_table_fits_80_columns_and_states_known_errors():
    pose = arm_pose()
    shifted = replace(pose, translation=pose.translation + (0.003, 0.0, 0.004))
    lines = format_scene(arm_scene(pose=shifted, truth=pose)).splitlines()
    assert max(map(len, lines)) <= 80
    errors = [line.split() for line in lines if line.startswith("  error")]
    assert errors[0][1:4] == ["5.0", "mm", "0.00°"]
    assert errors[3] == ["error", "0.00°", "0.0", "mm", "0.00°"]
    assert errors[4] == ["error", "0.00°", "-", "0.00", "cm"]
    assert "error" not in format_scene(arm_scene(truth=None))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": np.full((48, 3), np.nan)}, "points"),
        ({"labels": np.full(48, 3)}, "labels must be parts 0 to 2"),
        ({"labels": np.zeros(5, int)}, "labels"),
        ({"pose": replace(arm_pose(), joint_state=np.array([np.nan, 0]))}, "estimate joint_state"),
        ({"truth": replace(arm_pose(), size=np.zeros((2, 3)))}, "truth size"),
        ({"intrinsics": None}, "intrinsics"),
        ({"mask": np.zeros((3, 3), bool)}, "mask"),
    ],
)
def test_scene_names_what_is_wrong(changes: dict, message: str):
    with pytest.raises(CaperError, match=f"scene 'frame 1'.*{message}"):
        arm_scene(**changes)


def test_writing_needs_scenes_and_a_folder(tmp_path: Path):
    with pytest.raises(CaperError, match="at least one scene"):
        write_picture(tmp_path / "a.png", [])
    with pytest.raises(CaperError, match="at least one scene"):
        write_page(tmp_path / "a.html", [])
    (tmp_path / "file").write_text("")
    with pytest.raises(CaperError, match="cannot write"):
        write_page(tmp_path / "file" / "a.html", [arm_scene(truth=None)])
    with pytest.raises(CaperError, match="cannot write"):
        save_figure(Figure(), tmp_path / "file" / "a.png")
    with pytest.raises(CaperError, match=r"a\.nothing: Format"):
        save_figure(Figure(), tmp_path / "a.nothing")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_demo_writes_pictures_and_a_page_and_prints_errors(tmp_path, monkeypatch, capsys):
    """With an estimator that knows the truth: stored states are degrees, errors come out as 0."""
    monkeypatch.setattr(demo, "demo_folder", lambda: tmp_path / "frames")
    pose = box_pose(np.radians(40.0))
    for index in range(2):
        write_demo_frame(tmp_path / "frames" / f"box_{index}", pose)

    def estimator(points: np.ndarray) -> Prediction:
        assert points.dtype == np.float32
        return Prediction(
            pose=jax.tree.map(lambda array: np.asarray(array, np.float32)[None], pose),
            points=points[:, ::2],
            labels=np.zeros((1, points.shape[1] // 2), np.int32),
            confidence=np.ones((1, 2), np.float32),
            degenerate=np.zeros(1, bool),
            points_per_part=np.full((1, 2), 99, np.int32),
            plausible=np.ones(1, bool),
            reason=np.zeros(1, np.int32),
            size_ratio=np.ones(1, np.float32),
            distinct_points=np.full(1, 512, np.int32),
            evidence=np.zeros((1, 2, 12), np.float32),
        )

    monkeypatch.setattr("caper_jax.estimator.load", lambda category, **_: estimator)
    assert cli.main(["demo", "--out", str(tmp_path / "out")]) == 0
    captured = capsys.readouterr()
    assert max(map(len, captured.out.splitlines()[:-2])) <= 80
    assert captured.out.count("40.0°") == 2
    assert re.search(r"error +0\.0 mm +0\.00° +IoU 1\.00", captured.out)
    assert "ms per frame (median of 20)" in captured.out
    assert "21/21 (100 %)" in captured.err
    assert read_png(tmp_path / "out" / "box.png").size
    data = page_data((tmp_path / "out" / "index.html").read_text("utf-8"))
    assert [scene["name"] for scene in data["scenes"]] == ["box 0", "box 1"]

    (tmp_path / "frames" / "box_1" / "truth.json").write_text("{}")
    assert cli.main(["demo", "--out", str(tmp_path / "out")]) == 2
    assert "truth.json: no pose of box" in capsys.readouterr().err


def box_pose(angle: float) -> ArticulatedPose:
    category = categories.get("box")
    axis, pivot = np.array([[-1.0, 0.0, 0.0]]), np.array([[0.0, 0.02, -0.05]])
    with jax.enable_x64(True):
        state = np.array([angle])
        parts = np.asarray(
            forward_kinematics(ROOT, axis, pivot, state, category.joint_types, category.parents)
        )
    size, center = np.array(category.mean_size), np.array(category.mean_center)
    return ArticulatedPose(parts[:, :3, :3], parts[:, :3, 3], size, center, axis, pivot, state)


def write_demo_frame(folder: Path, pose: ArticulatedPose) -> None:
    folder.mkdir(parents=True)
    depth = np.full((120, 160), 900, np.uint16)
    Image.fromarray(depth).save(folder / "depth.png")
    mask = np.zeros((120, 160), np.uint8)
    mask[40:90, 50:120] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    camera = {"fx": 200.0, "fy": 200.0, "cx": 80.0, "cy": 60.0}
    (folder / "intrinsics.json").write_text(json.dumps(camera))
    truth = {key: np.asarray(value).tolist() for key, value in vars(pose).items()}
    truth["joint_state"] = np.degrees(pose.joint_state).tolist()
    (folder / "truth.json").write_text(json.dumps(truth))
