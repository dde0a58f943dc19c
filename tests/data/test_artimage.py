"""The ArtImage reader: roots of one frame, changed."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from caper_jax import categories
from caper_jax.data.readers import open_dataset
from caper_jax.data.readers.artimage import ArtImageDataset
from caper_jax.errors import CaperError


@pytest.fixture(scope="module")
def root(shared_data):
    return shared_data / "artimage_sample"


def test_frames_can_be_read_from_several_threads(root):
    dataset = ArtImageDataset(root, "laptop")
    with ThreadPoolExecutor(4) as pool:
        parallel = list(pool.map(dataset.__getitem__, range(len(dataset))))
    again = ArtImageDataset(root, "laptop")
    for index, one in enumerate(parallel):
        assert one.name == again[index].name
        np.testing.assert_array_equal(one.points, again[index].points)
        np.testing.assert_array_equal(one.truth.rotation, again[index].truth.rotation)


def copy_root(root, folder, edit=None, name="laptop"):
    """A root of frame 000000, whose annotation ``edit`` may change."""
    home = folder / name
    shutil.copytree(root / name / "urdf", home / "urdf")
    shutil.copy(root / "camera_intrinsic.json", folder)
    for kind in ("annotations", "depth", "category_mask"):
        (home / "train" / kind).mkdir(parents=True)
    for kind in ("depth", "category_mask"):
        shutil.copy(root / name / "train" / kind / "000000.png", home / "train" / kind)
    annotation = json.loads((root / name / "train/annotations/000000.json").read_text())
    if edit is not None:
        edit(annotation)
    (home / "train/annotations/000000.json").write_text(json.dumps(annotation))
    (home / "train.txt").write_text("000000.json\n")
    return folder


@pytest.fixture(scope="module")
def first(root):
    return ArtImageDataset(root, "laptop")[0]


def links(annotation):
    return annotation["instances"][0]["links"]


def assert_same_truth(found, expected, tolerance=1e-5):
    for field in vars(expected):
        np.testing.assert_allclose(
            getattr(found, field), getattr(expected, field), atol=tolerance, rtol=0, err_msg=field
        )


def test_links_may_come_in_any_order_and_without_state(root, first, tmp_path):
    def edit(annotation):
        links(annotation).reverse()
        links(annotation)[0].pop("state")

    assert_same_truth(
        ArtImageDataset(copy_root(root, tmp_path, edit), "laptop")[0].truth, first.truth
    )


def test_depth_in_three_channels(root, first, tmp_path):
    copy_root(root, tmp_path)
    path = tmp_path / "laptop/train/depth/000000.png"
    depth = np.asarray(Image.open(path))
    color = np.stack([depth % 256, depth // 256, np.zeros_like(depth)], axis=-1)  # R, G, B
    Image.fromarray(color.astype(np.uint8)).save(path)
    np.testing.assert_array_equal(ArtImageDataset(tmp_path, "laptop")[0].depth, first.depth)


def test_an_image_without_depth_has_no_points(root, tmp_path):
    copy_root(root, tmp_path)
    path = tmp_path / "laptop/train/depth/000000.png"
    Image.fromarray(np.zeros((640, 640), np.uint16)).save(path)
    assert ArtImageDataset(tmp_path, "laptop")[0].points.shape == (0, 3)


def test_the_official_split_goes_by_object_and_list(root, tmp_path):
    copy_root(root, tmp_path)
    copied = ArtImageDataset(tmp_path, "laptop", "train", official_split=True)
    assert list(copied.names) == ["000000"]
    path = tmp_path / "laptop/train/annotations/000000.json"
    text, official = path.read_text(), categories.get("laptop").datasets["artimage"].test_objects[0]
    path.write_text(text.replace('"urdf_id": 913329', f'"urdf_id": {official}'))
    assert path.read_text() != text
    with pytest.raises(CaperError, match="split 'train' holds no frame"):
        ArtImageDataset(tmp_path, "laptop", "train", official_split=True)
    # There is no test.txt: the objects alone decide.
    assert len(ArtImageDataset(tmp_path, "laptop", "test", official_split=True)) == 1
    with pytest.raises(CaperError, match="official split of artimage has train and test of"):
        ArtImageDataset(tmp_path, "laptop", official_split=True)
    with pytest.raises(CaperError, match="'reartmix' has no official split"):
        open_dataset("reartmix", tmp_path, "box", "test", official_split=True)


def set_transformation(value):
    def edit(annotation):
        links(annotation)[1]["transformation"] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda a: a["instances"][0].update(urdf_id=77), "no object 77"),
        (lambda a: links(a).pop(), r"000000\.json: link_category_id must be 0 to 1"),
        (lambda a: links(a)[0].pop("transformation"), "link 0: transformation is missing"),
        (set_transformation(np.diag([1, 1, -1, 1]).tolist()), "determinant -1"),
        (set_transformation(np.diag([2, 2, 2, 1]).tolist()), "must carry no scale"),
        (lambda a: links(a)[1].update(state=0.1297), "state of link 1 is 0.1297, but .* 7.432 deg"),
        (lambda a: a.update(depth_path="depth/000009.png"), r"000009\.png: no such file"),
        (lambda a: a.update(width=320), "640 x 640, but .* width 320"),
        (lambda a: a["instances"].append(a["instances"][0]), r"000000\.json: instances .* 1 item"),
    ],
)
def test_bad_annotations_are_named(root, tmp_path, edit, message):
    dataset = ArtImageDataset(copy_root(root, tmp_path, edit), "laptop")
    with pytest.raises(CaperError, match=message):
        dataset[0]


URDF = "913329/mobility_for_unity_align.urdf"


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (URDF, "revolute", "prismatic", r"joints .* are .*prismatic.*laptop has"),
        (URDF, 'axis xyz="0 1 0"', 'axis xyz="0 1"', "joint 'joint_1', axis .* got '0 1'"),
        (
            URDF,
            'axis xyz="0 1 0"',
            'axis xyz="0 0 0"',
            "'joint_1', axis: .* is no direction",
        ),
        (URDF, 'axis xyz="0 1 0"', 'axis xyz="0 0 1"', "axis of joint 1 lies across"),
        (URDF, "<axis", "<axes", "axis of joint 1 lies across"),  # x, as in any URDF
        (URDF, "</robot>", "", "broken XML"),
        (URDF, 'name="joint_1"', 'name="hinge"', "must tell which link it moves"),
        ("rest_state.json", '"state": -0.6', '"angle": -0.6', "913329, part 1: state is missing"),
        ("rest_state.json", "-0.600276771", '"shut"', "913329, part 1: state .* got 'shut'"),
        ("913329/part_point_sample/1.xyz", "0", "zero", r"1\.xyz: lines must hold three numbers"),
    ],
)
def test_bad_models_are_named(root, tmp_path, file, old, new, message):
    path = copy_root(root, tmp_path) / "laptop/urdf" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(CaperError, match=message):
        ArtImageDataset(tmp_path, "laptop")[0]


def test_missing_files_are_named(root, tmp_path):
    copy_root(root, tmp_path)
    for nothing in ("\n", "# x y z\n"):
        (tmp_path / "laptop/urdf/913329/part_point_sample/0.xyz").write_text(nothing)
        with pytest.raises(CaperError, match=r"0\.xyz: holds no points"):
            ArtImageDataset(tmp_path, "laptop")[0]
    (tmp_path / "laptop/urdf/913329/part_point_sample/0.xyz").unlink()
    with pytest.raises(CaperError, match=r"0\.xyz: no such file"):
        ArtImageDataset(tmp_path, "laptop")[0]
    (tmp_path / "laptop/train.txt").write_text("000000.json 000007.json 000008.json")
    with pytest.raises(CaperError, match=r"train\.txt: names '000007\.json'.*2 such lines"):
        ArtImageDataset(tmp_path, "laptop", "train")
    with pytest.raises(CaperError, match=r"no split 'val' \(no val\.txt\); it has all, train"):
        ArtImageDataset(tmp_path, "laptop", "val")
    with pytest.raises(CaperError, match=r"lacks box/train/\); it holds laptop"):
        ArtImageDataset(tmp_path, "box")
    (tmp_path / "camera_intrinsic.json").unlink()
    with pytest.raises(CaperError, match=r"camera_intrinsic\.json: no such file"):
        ArtImageDataset(tmp_path, "laptop")
