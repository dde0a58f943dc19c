"""The PM-Videos reader: the order of frames, lines that name them, the part that moves."""

import json
import shutil

import numpy as np
import pytest
from _helpers import roots

from caper_jax.data.readers import open_dataset
from caper_jax.data.readers.artimage import PmVideosDataset
from caper_jax.data.readers.base import group_videos
from caper_jax.errors import CaperError


@pytest.fixture(scope="module")
def root(shared_data):
    return shared_data / "pm_videos_sample"


def test_videos_are_ordered_and_tell_what_moves(root):
    dataset = open_dataset("pm-videos", root, "laptop")
    videos = dataset.videos()
    assert videos == {"00000": list(range(30)), "00001": list(range(30, 60))}
    assert {dataset.moving_part(index) for index in (0, 29, 30, 59)} == {1}
    for indices in videos.values():
        states = [dataset[index].truth.joint_state[0] for index in indices[::6]]
        assert (np.diff(states) > 0).all()


def test_videos_of_unsorted_names():
    assert group_videos(["b/2", "a/1", "b/1"]) == {"b": [2, 0], "a": [1]}


def test_frames_without_leading_zeros_come_in_the_order_of_time(tmp_path):
    names = [f"{video}/{frame}" for video in (2, 10) for frame in range(12)]
    assert group_videos(names[::-1])["2"] == list(range(23, 11, -1))
    root = roots.pm_videos(tmp_path)
    for folder in (root / "laptop/train").iterdir():
        for path in (folder / "annotations").iterdir():
            path.rename(path.with_name(f"{int(path.stem) + 8}.json"))
    assert list(PmVideosDataset(root, "laptop").names) == [
        "00000/8", "00000/9", "00000/10", "00001/11", "00001/12", "00001/13",
    ]  # fmt: skip


def copy_root(root, folder, edit=None):
    """Two videos that hold frames of the same file names; ``edit`` changes the first."""
    home = folder / "laptop"
    shutil.copytree(root / "laptop/urdf", home / "urdf")
    shutil.copy(root / "camera_intrinsic.json", folder)
    for video in ("00000", "00007"):
        for kind, suffix in (("annotations", "json"), ("depth", "png"), ("category_mask", "png")):
            target = home / "train" / video / kind
            target.mkdir(parents=True)
            for number in ("000000", "000001"):
                shutil.copy(root / f"laptop/train/00000/{kind}/{number}.{suffix}", target)
    if edit is not None:
        path = home / "train/00000/annotations/000000.json"
        annotation = json.loads(path.read_text())
        edit(annotation)
        path.write_text(json.dumps(annotation))
    return folder


def test_lines_name_frames_of_any_video_or_of_one(root, tmp_path):
    copy_root(root, tmp_path)
    listed = tmp_path / "laptop/train.txt"
    listed.write_text("000001.json\n")
    assert list(PmVideosDataset(tmp_path, "laptop", "train").names) == [
        "00000/000001",
        "00007/000001",
    ]
    listed.write_text("00007/000001.json\n")
    dataset = PmVideosDataset(tmp_path, "laptop", "train")
    assert list(dataset.names) == ["00007/000001"]
    assert dataset.videos() == {"00007": [0]}
    assert dataset[0].name == "00007/000001"
    listed.write_text("000009.json\n")
    with pytest.raises(CaperError, match=r"train\.txt: names '000009\.json'"):
        PmVideosDataset(tmp_path, "laptop", "train")


@pytest.mark.parametrize("value", [2, -1, "lid"])
def test_a_moving_part_that_is_none_is_named(root, tmp_path, value):
    dataset = PmVideosDataset(
        copy_root(root, tmp_path, lambda a: a.update(sort_part=value)), "laptop"
    )
    with pytest.raises(CaperError, match=r"000000\.json: sort_part"):
        dataset.moving_part(0)


def test_a_moving_part_may_be_left_out(root, tmp_path):
    dataset = PmVideosDataset(copy_root(root, tmp_path, lambda a: a.pop("sort_part")), "laptop")
    assert (dataset.moving_part(0), dataset.moving_part(1)) == (None, 1)


def test_another_layout_is_named(shared_data):
    with pytest.raises(CaperError, match="split 'all' holds no frame"):
        PmVideosDataset(shared_data / "artimage_sample", "laptop")
    with pytest.raises(CaperError, match="no pm-videos folder of 'box'"):
        PmVideosDataset(shared_data / "artimage_sample", "box")
