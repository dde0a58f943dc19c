"""The ReArt-Videos reader on a root made from the same measured box as a ReArtMix frame."""

import json
import pickle
import shutil

import numpy as np
import pytest
from _helpers import roots

from caper_jax.data.readers import open_dataset
from caper_jax.data.readers.reart import ReArtMixDataset, ReArtVideosDataset
from caper_jax.data.types import validate
from caper_jax.errors import CaperError

SOURCE = "scene6/000001"


def surface(corners):
    """Points whose box has these corners [2, 3]."""
    low, high = np.array(corners)
    inside = np.random.default_rng(0).uniform(low, high, (40, 3))
    return np.concatenate([[low, high], inside])


def make_root(mixed, folder, edit=None, joint="base_link_link1_joint"):
    """One instance of a ReArtMix frame as the only one of a video; the model as clouds and URDF."""
    annotation = json.loads((mixed / f"annotations/{SOURCE}.json").read_text())
    annotation["instances"] = annotation["instances"][:1]
    instance = annotation["instances"][0]
    annotation["depth_path"] = "box/00000/000001.png"
    metas = json.loads((mixed / "urdf_metas.json").read_text())["urdf_metas"]
    meta = next(m for m in metas if m["id"] == instance["urdf_id"])
    data, home = folder / "Data", folder / "URDF/box" / str(instance["urdf_id"])
    for path in (data / "new_anno_test/box/00000", data / "new_anno_test/flag/box", home):
        path.mkdir(parents=True)
    (data / "depth/box/00000").mkdir(parents=True)
    shutil.copy(mixed / f"depth/{SOURCE}.png", data / "depth" / annotation["depth_path"])
    shutil.copy(mixed / "camera_intrinsic.json", data)
    if edit is not None:
        edit(annotation)
    (data / "new_anno_test/box/00000/000001.json").write_text(json.dumps(annotation))
    (data / "new_anno_test/flag/box/train.txt").write_text("000001.json\n")
    clouds = [surface(c) for c in np.reshape(meta["corner_pts"], (-1, 2, 3))]
    (home / "model_pts.pkl").write_bytes(pickle.dumps(clouds))
    xyz, axis = (" ".join(map(str, meta[key][0])) for key in ("joint_xyz", "joint_rpy"))
    (home / "mobility_for_unity_align.urdf").write_text(
        f'<robot><joint name="{joint}" type="revolute"><origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        '<parent link="base_link"/><child link="link1"/></joint></robot>'
    )
    return folder


@pytest.fixture(scope="module")
def mixed(shared_data):
    return shared_data / "reartmix_box"


@pytest.fixture(scope="module")
def expected(mixed):
    dataset = ReArtMixDataset(mixed, "box")
    return dataset[list(dataset.names).index(f"{SOURCE}_0")]


def renumber(annotation):
    for link in annotation["instances"][0]["links"]:
        link["link_category_id"] -= 1
        link["state"] = 0.5  # radians in these files; the transformations decide


@pytest.mark.parametrize("edit", [None, renumber])
@pytest.mark.parametrize("joint", ["base_link_link1_joint", "base|revolute|link1"])
def test_the_frame_is_that_of_reartmix(mixed, expected, tmp_path, edit, joint):
    """Links counted from 0 or from 1, joints named either way."""
    dataset = open_dataset("reart-videos", make_root(mixed, tmp_path, edit, joint), "box", "train")
    assert list(dataset.names) == ["00000/000001"]
    assert dataset.videos() == {"00000": [0]}
    frame = dataset[0]
    validate(frame, dataset.category)
    for field in vars(expected.truth):
        np.testing.assert_allclose(
            getattr(frame.truth, field), getattr(expected.truth, field), atol=1e-6, err_msg=field
        )
    np.testing.assert_array_equal(frame.points, expected.points)
    np.testing.assert_array_equal(frame.labels, expected.labels)


def test_the_official_split_goes_by_object(mixed, tmp_path):
    def rename(annotation):
        annotation["instances"][0]["urdf_id"] = 7

    make_root(mixed, tmp_path, rename)
    assert len(ReArtVideosDataset(tmp_path, "box", "train", official_split=True)) == 1
    with pytest.raises(CaperError, match="split 'test' holds no frame"):
        ReArtVideosDataset(tmp_path, "box", "test", official_split=True)
    with pytest.raises(CaperError, match=r"train and test of .*, not 'all'"):
        ReArtVideosDataset(tmp_path, "box", official_split=True)


def test_frames_without_leading_zeros_come_in_the_order_of_time(tmp_path):
    root = roots.reart_videos(tmp_path)
    for path in (root / "Data/new_anno_test/box/00000").iterdir():
        path.rename(path.with_name(f"{int(path.stem) + 9}.json"))
    dataset = ReArtVideosDataset(root, "box")
    assert list(dataset.names) == ["00000/9", "00000/10", "00000/11"]
    assert dataset.videos() == {"00000": [0, 1, 2]}


def test_depth_of_another_size_than_its_annotation_is_named(mixed, tmp_path):
    make_root(mixed, tmp_path, lambda annotation: annotation.update(width=640, height=360))
    with pytest.raises(CaperError, match=r"1\.png: image of 1280 x 720, but .* says width 640"):
        ReArtVideosDataset(tmp_path, "box")[0]


def test_mistakes_are_named(mixed, tmp_path):
    make_root(mixed, tmp_path)
    flags = tmp_path / "Data/new_anno_test/flag/box"
    with pytest.raises(CaperError, match="no split 'test'"):
        ReArtVideosDataset(tmp_path, "box", "test")
    (flags / "test.txt").write_text("000009.json\n")
    with pytest.raises(CaperError, match=r"test\.txt: names '000009\.json'"):
        ReArtVideosDataset(tmp_path, "box", "test")
    with pytest.raises(CaperError, match="unknown ReArt-Videos category 'laptop'"):
        ReArtVideosDataset(tmp_path, "laptop")
    with pytest.raises(CaperError, match=r"lacks Data/new_anno_test/box/"):
        ReArtVideosDataset(tmp_path / "Data", "box")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([np.zeros((3, 3))] * 2, "holds 2 clouds"),
        ([np.zeros((3, 3)), np.zeros((3, 2)), np.zeros((3, 3))], r"cloud 1 has shape \(3, 2\)"),
        ([np.zeros((3, 3)), np.full((3, 3), np.nan), np.zeros((3, 3))], "cloud 1 has NaN"),
        ([np.zeros((3, 3)), np.zeros((0, 3)), np.zeros((3, 3))], r"cloud 1 has shape \(0, 3\)"),
        (print, "asks for builtins.print"),
    ],
)
def test_bad_models_are_named(mixed, tmp_path, content, message):
    make_root(mixed, tmp_path)
    path = next(tmp_path.glob("URDF/box/*/model_pts.pkl"))
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(CaperError, match=rf"model_pts\.pkl: .*{message}"):
        ReArtVideosDataset(tmp_path, "box")[0]
