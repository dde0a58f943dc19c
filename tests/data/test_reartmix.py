"""The ReArtMix reader: changed roots, and objects whose ground truth is known by construction."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from caper_jax.data.readers import open_dataset
from caper_jax.data.readers.reart import ReArtMixDataset
from caper_jax.data.types import pose_problems
from caper_jax.errors import CaperError


@pytest.fixture(scope="module")
def root(shared_data):
    return shared_data / "reartmix_box"


def copy_frame(root, folder, edit=None):
    """A root of one image, whose annotation ``edit`` may change."""
    for name in ("annotations", "depth"):
        (folder / name / "scene6").mkdir(parents=True)
    shutil.copy(root / "camera_intrinsic.json", folder)
    shutil.copy(root / "urdf_metas.json", folder)
    shutil.copy(root / "depth/scene6/000001.png", folder / "depth/scene6")
    annotation = json.loads((root / "annotations/scene6/000001.json").read_text())
    if edit is not None:
        edit(annotation)
    (folder / "annotations/scene6/000001.json").write_text(json.dumps(annotation))
    return folder


def test_links_and_instances_may_come_in_any_order(root, tmp_path):
    def shuffle(annotation):
        annotation["instances"].reverse()
        for instance in annotation["instances"]:
            instance["links"].reverse()

    shuffled = ReArtMixDataset(copy_frame(root, tmp_path, shuffle), "box")
    assert sorted(shuffled.names) == ["scene6/000001_0", "scene6/000001_1"]
    frame = shuffled[list(shuffled.names).index("scene6/000001_0")]
    first = open_dataset("reartmix", root, "box")[0]
    np.testing.assert_array_equal(frame.truth.rotation, first.truth.rotation)
    assert frame.name == first.name


def test_other_categories_are_left_out(root, tmp_path):
    def relabel(annotation):
        annotation["instances"][0]["category_id"] = 2

    assert list(ReArtMixDataset(copy_frame(root, tmp_path, relabel), "box").names) == [
        "scene6/000001_1"
    ]


def test_an_instance_without_depth_has_no_points(root, tmp_path):
    copy_frame(root, tmp_path)
    Image.fromarray(np.zeros((720, 1280), np.uint16)).save(tmp_path / "depth/scene6/000001.png")
    assert ReArtMixDataset(tmp_path, "box")[0].points.shape == (0, 3)


def halve(path):
    with Image.open(path) as image:
        image.resize((640, 360), Image.Resampling.NEAREST).save(path)


def test_depth_of_another_size_than_its_camera_or_annotation_is_named(root, tmp_path):
    copy_frame(root, tmp_path / "a")
    halve(tmp_path / "a/depth/scene6/000001.png")
    with pytest.raises(
        CaperError, match=r"1\.png: image of 640 x 360, but .* width 1280, height 720"
    ):
        ReArtMixDataset(tmp_path / "a", "box")[0]
    copy_frame(root, tmp_path / "b", lambda a: (a.pop("width"), a.pop("height")))
    assert len(ReArtMixDataset(tmp_path / "b", "box")[0].points) == 1024
    halve(tmp_path / "b/depth/scene6/000001.png")
    with pytest.raises(CaperError, match="made for 1280 x 720 images, this one is 640 x 360"):
        ReArtMixDataset(tmp_path / "b", "box")[0]


def set_transformation(value):
    def edit(annotation):
        annotation["instances"][0]["links"][0]["transformation"] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda a: a["instances"][0].update(urdf_id=77), "urdf_metas.json: .* id 77"),
        (lambda a: a["instances"][0]["links"].pop(), "instance 0: link_category_id must be 1 to 2"),
        (set_transformation(np.diag([1, 2, 1, 1]).tolist()), "scaled rotation, is off"),
        (lambda a: a.update(depth_path="scene6/000009.png"), r"000009\.png: no such file"),
    ],
)
def test_bad_annotations_are_named(root, tmp_path, edit, message):
    dataset = ReArtMixDataset(copy_frame(root, tmp_path, edit), "box")
    with pytest.raises(CaperError, match=message):
        dataset[0]


def test_annotations_of_another_kind_are_named(root, tmp_path):
    copy_frame(root, tmp_path, lambda a: a["instances"][0].pop("category_id"))
    with pytest.raises(CaperError, match=r"000001\.json: instances.0.category_id is missing"):
        ReArtMixDataset(tmp_path, "box")


def test_splits_and_categories_it_does_not_have(root, tmp_path):
    with pytest.raises(CaperError, match=r"no split 'test' \(no test\.txt\); it has all, train"):
        ReArtMixDataset(root, "box", "test")
    with pytest.raises(CaperError, match="unknown ReArtMix category 'laptop'"):
        ReArtMixDataset(root, "laptop")
    with pytest.raises(CaperError, match=r"no ReArtMix folder of 'box' \(it lacks annotations/\)"):
        ReArtMixDataset(tmp_path, "box")
    copy_frame(root, tmp_path)
    (tmp_path / "val.txt").write_text("scene6/000001_7\n")
    with pytest.raises(CaperError, match=r"val\.txt: names 'scene6/000001_7'"):
        ReArtMixDataset(tmp_path, "box", "val")


# Staplers, cutters and scissors: annotations composed by hand in the files' own frame, z up. The
# poses of the links are known there, so what must come out is checked in the camera.
MODELS = {
    "stapler": (2, range(10, 17)),
    "cutter": (3, range(20, 29)),
    "scissors": (5, range(40, 49)),
}


@pytest.fixture(scope="module")
def metas(root):
    content = json.loads((root / "urdf_metas.json").read_text())
    return {meta["id"]: meta for meta in content["urdf_metas"]}


def stored_boxes(meta):
    """[1+K, 2, 3] low and high of the whole and of the links, meters."""
    corners = np.array(meta["corner_pts"]).reshape(-1, 2, 3)
    return np.sort(corners, axis=1)


def root_pose(seed):
    """[s R | t] of a root, and s."""
    rng = np.random.default_rng(seed)
    scale, pose = rng.uniform(0.8, 1.18), np.eye(4)
    pose[:3, :3] = scale * Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.uniform(-0.2, 0.2, 3) + (0, 0, 0.8)
    return pose, scale


def moved(meta, amount):
    """[4, 4] motion of link 2 by ``amount`` about or along the axis as stored."""
    axis = np.array(meta["joint_rpy"][0])[[1, 2, 0]]
    axis /= np.linalg.norm(axis)
    motion = np.eye(4)
    if meta["joint_types"] == ["prismatic"]:
        motion[:3, 3] = amount * axis
    else:
        pivot = np.array(meta["joint_xyz"][0])[[1, 2, 0]]
        motion[:3, :3] = Rotation.from_rotvec(amount * axis).as_matrix()
        motion[:3, 3] = pivot - motion[:3, :3] @ pivot
    return motion


def read(root, folder, metas, category, model, amount):
    """Truth of one instance whose link 2 is ``amount`` from where the file stores it."""
    number, _ = MODELS[category]
    pose, _ = root_pose(model)
    links = [
        {"link_category_id": k, "transformation": matrix.tolist(), "segmentation": []}
        for k, matrix in ((1, pose), (2, pose @ moved(metas[model], amount)))
    ]
    instance = {"id": 3, "category_id": number, "urdf_id": model, "links": links}
    edit = {"depth_path": "scene6/000001.png", "instances": [instance]}
    copy_frame(root, folder, lambda annotation: (annotation.clear(), annotation.update(edit)))
    dataset = open_dataset("reartmix", folder, category)
    assert list(dataset.names) == ["scene6/000001_3"]
    truth = dataset[0].truth
    assert not pose_problems(truth, dataset.category)
    return truth


def way(truth, vector, part=0):
    return truth.rotation[part] @ np.asarray(vector, float)


def check_frame_count(truth, category, meta):
    """What no rest pose changes: joints, the root's box, the motion between the parts."""
    pose, scale = root_pose(meta["id"])
    turn = pose[:3, :3] / scale
    low, high = stored_boxes(meta)[1]
    if category != "scissors":  # turned by 10 deg, its box is only a bound
        center = truth.rotation[0] @ truth.box_center[0] + truth.translation[0]
        np.testing.assert_allclose(center, pose[:3, :3] @ (low + high) / 2 + pose[:3, 3], atol=1e-6)
        axes = np.abs(turn.T @ truth.rotation[0])
        np.testing.assert_allclose(axes @ truth.size[0], scale * (high - low), atol=1e-6)
    # The joint's line in the camera is that of the file.
    axis = np.array(meta["joint_rpy"][0])[[1, 2, 0]]
    across = np.cross(way(truth, truth.joint_axis[0]), turn @ axis / np.linalg.norm(axis))
    np.testing.assert_allclose(across, 0, atol=1e-6)
    pivot = np.array(meta["joint_xyz"][0])[[1, 2, 0]]
    found = truth.rotation[0] @ truth.joint_pivot[0] + truth.translation[0]
    np.testing.assert_allclose(found, pose[:3, :3] @ pivot + pose[:3, 3], atol=1e-6)
    # T_2 = T_1 J(state), with J from scipy, about the axis and pivot that came out.
    parts = np.tile(np.eye(4), (2, 1, 1))
    parts[:, :3, :3], parts[:, :3, 3] = truth.rotation, truth.translation
    joint = np.eye(4)
    if category == "cutter":
        joint[:3, 3] = truth.joint_state[0] * truth.joint_axis[0]
    else:
        rotation = Rotation.from_rotvec(truth.joint_state[0] * truth.joint_axis[0]).as_matrix()
        joint[:3, :3] = rotation
        joint[:3, 3] = truth.joint_pivot[0] - rotation @ truth.joint_pivot[0]
    np.testing.assert_allclose(parts[1], parts[0] @ joint, atol=2e-6)


@pytest.mark.parametrize("model", MODELS["cutter"][1])
def test_cutters(root, tmp_path, metas, model):
    """Link 2 is pushed back by 30 mm from fully out; the tip is at -y in the files."""
    meta = metas[model]
    _, body, blade = stored_boxes(meta)
    pose, scale = root_pose(model)
    axis = np.array(meta["joint_rpy"][0])[[1, 2, 0]]
    axis /= np.linalg.norm(axis)
    out = (body[0, 1] - blade[0, 1]) / axis[1]
    truth = read(root, tmp_path, metas, "cutter", model, 0.03)
    check_frame_count(truth, "cutter", meta)
    assert 0.07 < out < 0.1
    assert truth.joint_state[0] == pytest.approx(scale * (out - 0.03), abs=1e-6)
    turn = pose[:3, :3] / scale
    np.testing.assert_allclose(way(truth, (1, 0, 0)), -turn[:, 1], atol=1e-6)
    np.testing.assert_allclose(way(truth, (0, 1, 0)), turn[:, 2], atol=1e-6)
    # Positive extends, along +x up to the error of the axis; at rest the tip is at the mouth.
    assert truth.joint_axis[0, 0] > 0.99
    ends = truth.box_center[:, 0] + truth.size[:, 0] / 2
    assert ends[0] == pytest.approx(ends[1], abs=1e-6)
    np.testing.assert_allclose(truth.size[1] / scale, np.ptp(blade, axis=0)[[1, 2, 0]], atol=1e-6)


@pytest.mark.parametrize("model", MODELS["stapler"][1])
def test_staplers(root, tmp_path, metas, model):
    """Stored 150-160 deg open; 120 deg nearer to closed, 30-40 deg are left."""
    meta = metas[model]
    arm = stored_boxes(meta)[2]
    pose, scale = root_pose(model)
    truth = read(root, tmp_path, metas, "stapler", model, -np.radians(120))
    check_frame_count(truth, "stapler", meta)
    turn = pose[:3, :3] / scale
    np.testing.assert_allclose(way(truth, (0, 0, 1)), turn[:, 1], atol=1e-6)
    np.testing.assert_allclose(way(truth, (0, 1, 0)), turn[:, 2], atol=1e-6)
    assert np.radians(30) < truth.joint_state[0] < np.radians(42)
    assert truth.joint_axis[0, 0] < -0.99
    # Closed: the arm is a bar over the base, from the hinge to near the base's front.
    size, low = truth.size / scale, (truth.box_center - truth.size / 2) / scale
    high = low + size
    assert low[1, 1] > low[0, 1] + 0.005 and high[1, 1] > high[0, 1]
    assert -0.009 < high[1, 2] - high[0, 2] < 0.001
    assert 0.02 < size[1, 1] < 0.032 and 0.1 < size[1, 2] < 0.15
    # Leaning back by the stored angle, it has the bounds that the file gives it.
    stored = truth.joint_state[0] + np.radians(120)
    leaning = np.abs(Rotation.from_euler("x", -stored).as_matrix()) @ size[1]
    np.testing.assert_allclose(leaning, np.ptp(arm, axis=0)[[0, 2, 1]], atol=1e-5)


@pytest.mark.parametrize("model", MODELS["scissors"][1])
def test_scissors(root, tmp_path, metas, model):
    """Stored 90 deg apart; link 2 turned by 40 deg towards link 1, 50 deg are left."""
    meta = metas[model]
    assert meta["joint_rpy"][0][0] < -0.99  # so this is +z for the blades
    truth = read(root, tmp_path, metas, "scissors", model, -np.radians(40))
    check_frame_count(truth, "scissors", meta)
    assert truth.joint_state[0] == pytest.approx(np.radians(30), abs=1e-5)
    pose, scale = root_pose(model)
    turn = pose[:3, :3] / scale
    # The tips: link 1's along +y of the files, link 2's along +x of its own frame.
    second = turn @ moved(meta, -np.radians(40))[:3, :3]
    cos, sin = np.cos(np.radians(10)), np.sin(np.radians(10))
    np.testing.assert_allclose(way(truth, (cos, 0, sin)), turn[:, 1], atol=1e-6)
    # A tilted axis takes the second blade a little out of the plane.
    assert way(truth, (cos, 0, -sin), part=1) @ second[:, 0] > 0.99
    assert truth.joint_axis[0, 1] > 0.99
    # Handles reach at least as far as blades, but for one model by two millimeters.
    _, one, two = stored_boxes(meta)
    assert -one[0, 1] > one[1, 1] - 0.0015 and -two[0, 0] > two[1, 0] - 0.0025


def test_an_axis_stored_the_other_way_round_is_the_same_joint(root, tmp_path, metas):
    model = metas[12]
    expected = read(root, tmp_path / "a", metas, "stapler", 12, -1.9)
    flipped = dict(model, joint_rpy=(-np.array(model["joint_rpy"])).tolist())
    folder = tmp_path / "b"
    read(root, folder, metas, "stapler", 12, -1.9)
    (folder / "urdf_metas.json").write_text(json.dumps({"urdf_metas": [flipped]}))
    truth = open_dataset("reartmix", folder, "stapler")[0].truth
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(truth, name), value)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ({"joint_rpy": [[0.0, 0.0, 1.0]]}, "joint axis .* lies across"),
        ({"joint_types": ["prismatic"]}, "but stapler has 2 parts with"),
        (
            {"corner_pts": [[[[0, 0, 0]], [[1, 1, 1]]]] * 2 + [[[[0, -1, 0]], [[0.1, 0.9, 0.5]]]]},
            "no closed stapler has the boxes",
        ),
    ],
)
def test_models_unlike_the_others_are_named(root, tmp_path, metas, edit, message):
    read(root, tmp_path, metas, "stapler", 10, 0.0)
    content = {"urdf_metas": [metas[10] | edit]}
    (tmp_path / "urdf_metas.json").write_text(json.dumps(content))
    with pytest.raises(CaperError, match=f"model 10: .*{message}"):
        open_dataset("reartmix", tmp_path, "stapler")[0]


def test_categories_that_do_not_fit():
    with pytest.raises(CaperError, match=r"drawers with one drawer each \(2 parts\).*box, cutter"):
        ReArtMixDataset(".", "drawer")
