"""What all readers share: categories and splits of a root, objects, numbers of points, splits."""

import json

import pytest
from _helpers import roots
from _helpers.formats import FORMATS, write_root

from caper_jax.data.readers import OFFICIAL_SPLITS, categories_in, open_dataset, splits_in
from caper_jax.data.types import NoFramesError, validate
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


@pytest.fixture(params=FORMATS)
def format(request):
    return request.param


@pytest.fixture
def root(format, tmp_path):
    return write_root(format, tmp_path)


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


def test_points_per_frame_are_those_asked_for(root, format):
    dataset = open_dataset(format, root, FORMATS[format][0], num_points=300)
    assert dataset[0].points.shape == (256 if format == "caper" else 300, 3)


def test_official_splits(root, format):
    arguments = (format, root, FORMATS[format][0], SPLITS[format][-1])
    if format not in OFFICIAL_SPLITS:
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
