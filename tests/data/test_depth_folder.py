"""Folders of depth images and masks as videos."""

import os

import numpy as np
import pytest
from _helpers.depth_videos import write_video
from PIL import Image

from caper_jax.data.clouds import cloud_from_depth
from caper_jax.data.readers.depth_folder import DepthFolder, is_depth_folder
from caper_jax.errors import CaperError

MATRIX = np.array([[90.0, 0, 31.5], [0, 95.0, 23.5], [0, 0, 1]])


def test_frames_come_in_natural_order_with_their_clouds(tmp_path):
    home = write_video(tmp_path / "kitchen")
    data = DepthFolder(home, "laptop", num_points=100)
    assert list(data.names) == ["kitchen/f1", "kitchen/f2", "kitchen/f10"]
    assert data.videos() == {"kitchen": [0, 1, 2]} and len(data) == 3
    assert data.category.name == "laptop"
    for index, depth in enumerate((0.9, 0.8, 0.7)):
        frame = data[index]
        assert frame.points.shape == (100, 3) and frame.points.dtype == np.float32
        np.testing.assert_allclose(frame.points[:, 2], depth, rtol=1e-6)
        cloud = cloud_from_depth(frame.depth, frame.mask, MATRIX, 100)
        np.testing.assert_array_equal(frame.points, cloud.points)
        assert frame.truth is None and frame.labels is None
        np.testing.assert_array_equal(frame.intrinsics, MATRIX)
    fine = DepthFolder(home, "laptop", depth_scale=0.002)
    np.testing.assert_allclose(fine[0].points[:, 2], 1.8, rtol=1e-6)


def test_gravity_of_a_video_or_of_each_frame(tmp_path):
    home = write_video(tmp_path / "kitchen")
    assert DepthFolder(home, "laptop")[0].gravity is None
    (home / "gravity.json").write_text("[0, 3, 4]")
    data = DepthFolder(home, "laptop")
    for index in range(3):
        np.testing.assert_allclose(data[index].gravity, [0, 0.6, 0.8])
    (home / "gravity.json").write_text('{"f2": [0, 2, 0]}')
    data = DepthFolder(home, "laptop")
    assert data[0].gravity is None
    np.testing.assert_allclose(data[1].gravity, [0, 1, 0])
    for wrong in ("[0, 0, 0]", "[0, 1]", '"down"'):
        (home / "gravity.json").write_text(wrong)
        with pytest.raises(CaperError, match=r"gravity.json: gravity must be \[x, y, z\]"):
            DepthFolder(home, "laptop")[0]


def test_a_root_of_several_videos(tmp_path):
    write_video(tmp_path / "take10", ("a",))
    write_video(tmp_path / "take2", ("a", "b"))
    (tmp_path / "notes").mkdir()
    assert is_depth_folder(tmp_path) and is_depth_folder(tmp_path / "take2")
    assert not is_depth_folder(tmp_path / "notes") and not is_depth_folder(tmp_path / "absent")
    data = DepthFolder(tmp_path, "laptop")
    assert data.videos() == {"take2": [0, 1], "take10": [2]}
    assert list(data.names) == ["take2/a", "take2/b", "take10/a"]


def test_linked_videos_keep_their_own_names(tmp_path):
    """Their folders are both called rgbd."""
    root = tmp_path / "root"
    root.mkdir()
    for name, frames in (("kitchen", ("a", "b")), ("office", ("a",))):
        (root / name).symlink_to(write_video(tmp_path / name / "rgbd", frames))
    data = DepthFolder(root, "laptop")
    assert data.videos() == {"kitchen": [0, 1], "office": [2]}
    assert list(data.names) == ["kitchen/a", "kitchen/b", "office/a"]


@pytest.mark.parametrize(("here", "given"), [("", "."), ("depth", "..")])
def test_the_video_one_is_in_has_its_folders_name(tmp_path, monkeypatch, here, given):
    monkeypatch.chdir(write_video(tmp_path / "kitchen", ("a",)) / here)
    assert list(DepthFolder(given, "laptop").names) == ["kitchen/a"]


def test_frames_that_do_not_show_the_object_have_no_points(tmp_path):
    home = write_video(tmp_path / "kitchen", ("1", "2", "3", "4", "5"))
    (home / "mask" / "2.png").unlink()
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(home / "mask" / "3.png")
    few = np.zeros((48, 64), np.uint8)
    few[0, :15] = 1
    Image.fromarray(few).save(home / "mask" / "4.png")
    Image.fromarray(np.zeros((48, 64), np.uint16)).save(home / "depth" / "5.png")
    data = DepthFolder(home, "laptop")
    assert [len(data[index].points) for index in range(5)] == [1024, 0, 0, 0, 0]
    assert data[1].depth.shape == (48, 64)


def test_mistakes_are_named(tmp_path):
    def refuses(message):
        with pytest.raises(CaperError, match=message):
            DepthFolder(home, "laptop")

    home = tmp_path / "kitchen"
    refuses("kitchen: no such folder")
    home.mkdir()
    refuses("no video of depth images")
    write_video(home)
    os.rename(home / "mask" / "f2.png", home / "mask" / "m2.png")
    refuses(r"m2.png: has no depth image of this name")
    for path in (home / "mask").iterdir():
        path.unlink()
    refuses("mask: holds no mask")
    for path in (home / "depth").iterdir():
        path.unlink()
    refuses("depth: holds no depth image")
    home = write_video(tmp_path / "other")
    (home / "intrinsics.json").unlink()
    refuses(r"intrinsics\.json: no such file")


def test_broken_and_foreign_images_are_named_when_read(tmp_path):
    home = write_video(tmp_path / "kitchen")
    (home / "depth" / "f1.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    Image.fromarray(np.full((24, 32), 255, np.uint8)).save(home / "mask" / "f2.png")
    (home / "mask" / "f10.png").write_text("no image")
    data = DepthFolder(home, "laptop")
    for index, message in enumerate(("f1.png: ", "is 32 x 24 but its depth image 64 x 48", "f10")):
        with pytest.raises(CaperError, match=message):
            data[index]
