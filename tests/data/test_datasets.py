"""What all readers share: categories and splits of a root, objects, numbers of points, splits."""

import json

import numpy as np
import pytest
from _helpers import roots
from _helpers.formats import FORMATS, write_root

from caper_jax.data import readers
from caper_jax.data.readers import categories_in, formats, open_dataset, reader_of, splits_in
from caper_jax.data.readers.base import DatasetReader, list_splits, natural_order, read_list
from caper_jax.data.types import Frame, NoFramesError, validate
from caper_jax.errors import CaperError

OBJECTS = {
    "artimage": ["101"] * 3 + ["102"] * 3,
    "caper": ["1", "2", "1"],
    "captra": ["101"] * 3 + ["102"] * 3,
    "pm-videos": ["101"] * 3 + ["102"] * 3,
    "reart-videos": ["5"] * 3,
    "reartmix": ["101", "102", "101"],
}
SPLITS = {
    "artimage": ["test", "train"],
    "caper": ["test"],
    "captra": ["train", "test"],
    "pm-videos": ["test", "train"],
    "reart-videos": ["train"],
    "reartmix": ["train"],
}


@pytest.fixture(scope="module", params=FORMATS)
def format(request):
    return request.param


@pytest.fixture(scope="module")
def root(format, tmp_path_factory):
    return write_root(format, tmp_path_factory.mktemp(format))


def test_a_root_tells_its_categories_and_splits(root, format):
    category, _ = FORMATS[format]
    assert categories_in(format, root) == [category]
    assert splits_in(format, root, category) == SPLITS[format]
    total = len(open_dataset(format, root, category))
    assert sum(len(open_dataset(format, root, category, s)) for s in SPLITS[format]) == total


def test_frames_name_their_object_and_keep_the_conventions(root, format):
    dataset = open_dataset(format, root, FORMATS[format][0])
    frames = [dataset[index] for index in range(len(dataset))]
    assert [frame.instance for frame in frames] == OBJECTS[format]
    for frame in frames:
        validate(frame, dataset.category)
    few = open_dataset(format, root, FORMATS[format][0], num_points=300)
    assert few[0].points.shape == (256 if format == "caper" else 300, 3)


def test_official_splits(root, format):
    arguments = (format, root, FORMATS[format][0], SPLITS[format][-1])
    if not reader_of(format).has_official_split:
        with pytest.raises(CaperError, match=f"format '{format}' has no official split"):
            open_dataset(*arguments, official_split=True)
    elif SPLITS[format][-1] == "train":
        assert len(open_dataset(*arguments, official_split=True)) == 3
    else:  # the objects are none of the official test set
        with pytest.raises(NoFramesError):
            open_dataset(*arguments, official_split=True)


def test_a_file_without_numbers_of_objects(tmp_path):
    path = roots.caper(tmp_path / "box.h5", instance=None)
    assert open_dataset("caper", path, "box")[0].instance is None


def test_several_categories_in_one_root(tmp_path):
    roots.artimage(tmp_path, roots.LAPTOP)
    roots.artimage(tmp_path, roots.BOX)
    roots.artimage(tmp_path, roots.DRAWER)
    (tmp_path / "stapler/train/annotations").mkdir(parents=True)  # none of it is there
    assert categories_in("artimage", tmp_path) == ["box", "drawer", "laptop"]


def test_categories_of_reartmix_are_those_that_images_show(tmp_path):
    """The list of models names all categories in every root."""
    roots.reartmix(tmp_path)
    path = tmp_path / "annotations/scene1/000001.json"
    content = json.loads(path.read_text())
    content["instances"][0]["category_id"] = 3
    path.write_text(json.dumps(content))
    assert categories_in("reartmix", tmp_path) == ["box", "cutter"]
    content["instances"][0]["category_id"] = 4  # drawers cannot be read
    path.write_text(json.dumps(content))
    assert categories_in("reartmix", tmp_path) == ["box"]


def test_roots_that_are_none(root, format, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    for place in (empty, tmp_path / "absent"):
        with pytest.raises(CaperError, match=rf"{place.name}: (holds no|no such)"):
            categories_in(format, place)
    with pytest.raises(CaperError, match=f"unknown format '{format}s'"):
        categories_in(f"{format}s", root)


class Clouds(DatasetReader):
    """A reader of one's own: <category>/<video>/<frame>.npy."""

    format = "clouds"
    mask_source = "none needed"
    labeled = False
    has_videos = True

    @classmethod
    def categories_in(cls, root):
        return [path.name for path in root.iterdir() if path.is_dir()]

    @classmethod
    def split_folder(cls, root, category):
        return root / category.name

    def list_frames(self):
        files = (self.root / self.category.name).glob("*/*.npy")
        return {f"{path.parent.name}/{path.stem}": path for path in sorted(files)}

    def read_frame(self, name, path):
        return Frame(name, np.load(path, allow_pickle=False))


def test_a_reader_of_ones_own(tmp_path, monkeypatch):
    monkeypatch.setattr(readers, "_READERS", dict(readers._READERS))
    readers.register_reader("clouds", Clouds)
    readers.register_reader("clouds", Clouds)
    with pytest.raises(CaperError, match="'clouds' is already registered"):
        readers.register_reader("clouds", reader_of("folder"))
    assert "clouds" in formats() and "clouds" in formats(videos=True)
    assert "clouds" not in formats(labeled=True)

    for name in ("a/1", "a/2", "b/1"):
        path = tmp_path / f"box/{name}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.full((20, 3), len(name), np.float32))
    (tmp_path / "box/train.txt").write_text("b/1\na/1\n")
    assert categories_in("clouds", tmp_path) == ["box"]
    assert splits_in("clouds", tmp_path, "box") == ["train"]
    dataset = open_dataset("clouds", tmp_path, "box")
    assert dataset.videos() == {"a": [0, 1], "b": [2]} and dataset.split == "all"
    validate(dataset[2], dataset.category)
    assert list(open_dataset("clouds", tmp_path, "box", "train").names) == ["b/1", "a/1"]
    with pytest.raises(CaperError, match=r"no split 'test' \(no test\.txt\); it has all, train"):
        open_dataset("clouds", tmp_path, "box", "test")
    with pytest.raises(NoFramesError):
        open_dataset("clouds", tmp_path, "laptop")


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
