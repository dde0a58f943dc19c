"""The ReArtMix reader against ground truth that another program computed from the same files."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from caper_jax.data import open_dataset
from caper_jax.data.reartmix import ReArtMixDataset
from caper_jax.data.schema import validate
from caper_jax.errors import CaperError


@pytest.fixture(scope="module")
def root(shared_data):
    return shared_data / "reartmix_box"


@pytest.fixture(scope="module")
def dataset(root):
    return open_dataset("reartmix", root, "box")


@pytest.fixture(scope="module")
def frames(dataset):
    return [dataset[i] for i in range(len(dataset))]


def test_every_annotated_instance_is_a_frame(root, dataset):
    assert len(dataset) == 133
    assert (dataset.split, dataset.mask_source) == ("all", "annotated polygons")
    assert list(dataset.names) == np.load(root / "truth.npz")["box/name"].tolist()
    train = open_dataset("reartmix", root, "box", "train")
    assert list(train.names) == (root / "train.txt").read_text().split()


@pytest.mark.parametrize(
    ("field", "key", "sign", "tolerance"),
    [
        ("rotation", "R", 1, 1e-5),
        ("translation", "t", 1, 1e-5),
        ("size", "size", 1, 1e-4),
        ("box_center", "box_centre", 1, 1e-4),
        # The file's axis is the one about which the child turns by minus the state.
        ("joint_axis", "joint_axis", -1, 1e-5),
        ("joint_pivot", "joint_pivot", 1, 1e-4),
        ("joint_state", "joint_state", 1, 1e-5),
    ],
)
def test_ground_truth_agrees_with_an_independent_program(root, frames, field, key, sign, tolerance):
    expected = sign * np.load(root / "truth.npz")[f"box/{key}"]
    found = np.stack([getattr(frame.truth, field) for frame in frames])
    np.testing.assert_allclose(found, expected, atol=tolerance, rtol=0)


def test_frames_keep_the_conventions(dataset, frames):
    for frame in frames:
        validate(frame, dataset.category)
        assert frame.points.shape == (1024, 3)
        assert frame.visible.sum() == frame.mask.sum()


def test_points_lie_in_the_boxes_of_their_parts(frames):
    """Labels, depth, intrinsics and poses belong together: 99.8 % within 5 mm."""
    outside = []
    for frame in frames:
        pose = frame.truth
        rotation, shift = pose.rotation[frame.labels], pose.translation[frame.labels]
        local = np.einsum("nji,nj->ni", rotation, frame.points - shift)
        excess = np.abs(local - pose.box_center[frame.labels]) - pose.size[frame.labels] / 2
        outside.append(np.linalg.norm(np.maximum(excess, 0), axis=-1))
    assert np.mean(np.concatenate(outside) < 0.005) > 0.998


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


def test_links_and_instances_may_come_in_any_order(root, frames, tmp_path):
    def shuffle(annotation):
        annotation["instances"].reverse()
        for instance in annotation["instances"]:
            instance["links"].reverse()

    shuffled = ReArtMixDataset(copy_frame(root, tmp_path, shuffle), "box")
    assert sorted(shuffled.names) == ["scene6/000001_0", "scene6/000001_1"]
    frame = shuffled[list(shuffled.names).index("scene6/000001_0")]
    np.testing.assert_array_equal(frame.truth.rotation, frames[0].truth.rotation)
    assert frame.name == frames[0].name


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


def set_transformation(value):
    def edit(annotation):
        annotation["instances"][0]["links"][0]["transformation"] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda a: a["instances"][0].update(urdf_id=77), "instance 0: urdf_id 77 is not in"),
        (lambda a: a["instances"][0]["links"].pop(), "a link lacks 1"),
        (lambda a: a["instances"][0]["links"][0].pop("segmentation"), "lacks 'segmentation'"),
        (set_transformation(np.diag([1, 1, -1, 1]).tolist()), "determinant -1"),
        (set_transformation(np.diag([1, 2, 1, 1]).tolist()), "no scaled rotation"),
        (set_transformation([[1, 2]]), "must be 4x4"),
        (lambda a: a.update(depth_path="scene6/000009.png"), r"000009\.png: no such file"),
    ],
)
def test_bad_annotations_are_named(root, tmp_path, edit, message):
    dataset = ReArtMixDataset(copy_frame(root, tmp_path, edit), "box")
    with pytest.raises(CaperError, match=message):
        dataset[0]


def test_annotations_of_another_kind_are_named(root, tmp_path):
    copy_frame(root, tmp_path, lambda a: a["instances"][0].pop("category_id"))
    with pytest.raises(CaperError, match=r"000001\.json: no ReArtMix annotation.*'category_id'"):
        ReArtMixDataset(tmp_path, "box")


def test_splits_and_categories_it_does_not_have(root, tmp_path):
    with pytest.raises(CaperError, match=r"no split 'test' \(no test\.txt\); it has all, train"):
        ReArtMixDataset(root, "box", "test")
    with pytest.raises(CaperError, match="unknown ReArtMix category 'laptop'"):
        ReArtMixDataset(root, "laptop")
    with pytest.raises(CaperError, match=r"no ReArtMix folder \(it lacks annotations/\)"):
        ReArtMixDataset(tmp_path, "box")
    copy_frame(root, tmp_path)
    (tmp_path / "val.txt").write_text("scene6/000001_7\n")
    with pytest.raises(CaperError, match=r"val\.txt: names 'scene6/000001_7'"):
        ReArtMixDataset(tmp_path, "box", "val")
