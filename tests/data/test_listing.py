"""Lists of frames: the text files of splits, and the order of names."""

import pytest
from _helpers.formats import FORMATS, write_root

from caper_jax.data.readers import open_dataset, splits_in
from caper_jax.data.readers.listing import list_splits, natural_order, read_list
from caper_jax.errors import CaperError


def test_natural_order():
    names = ["10", "9", "a10", "a9", "09", "a9b", "a"]
    assert sorted(names, key=natural_order) == [
        "09", "9", "10", "a", "a9", "a9b", "a10",
    ]  # fmt: skip


def test_only_lists_of_frames_are_splits(tmp_path):
    texts = {
        "train": "000001.json\n000002.json\n",
        "test": "scene6/000003_0",
        "val": "kitchen.json last.json",
        "none": "",
        "README": "\nReArtMix data\n000001.json\n",
        "notes": "100 frames of boxes",
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.txt").write_text(text)
    (tmp_path / "folder.txt").mkdir()
    assert list_splits(tmp_path) == ["none", "test", "train", "val"]


def test_a_mark_of_utf_8_belongs_to_no_name(tmp_path):
    (tmp_path / "a.txt").write_text("000001\n", encoding="utf-8-sig")
    assert read_list(tmp_path / "a.txt") == ["000001"]


@pytest.mark.parametrize("format", ["artimage", "pm-videos", "reart-videos", "reartmix"])
def test_lists_in_another_encoding_and_other_texts(tmp_path, format):
    root, category = write_root(format, tmp_path), FORMATS[format][0]
    path = next(tmp_path.glob("**/train.txt"))
    path.with_name("README.txt").write_text("Boxes and more\n")
    path.write_text(path.read_text(), encoding="utf-16")
    splits = splits_in(format, root, category)
    assert "train" in splits and "README" not in splits
    with pytest.raises(CaperError, match=r"train\.txt: not a text file in UTF-8"):
        open_dataset(format, root, category, "train")
