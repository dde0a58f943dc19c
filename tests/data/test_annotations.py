"""Mistakes in annotations of the public layouts are named, wherever a reader meets them."""

import json

import pytest
from _helpers import roots
from _helpers.formats import FORMATS, write_root

from caper_jax.data.readers import open_dataset
from caper_jax.data.readers.annotated import polygon_labels, split_transformation
from caper_jax.data.readers.reartmix import ReArtMixDataset
from caper_jax.errors import CaperError


@pytest.mark.parametrize(
    ("polygons", "message"),
    [
        (None, "segmentation of part 0 must be a list of polygons"),
        ([1, 2, 3, 4, 5, 6], "segmentation of part 0 must be a list of polygons"),
        ([[1, 2, 3, 4, 5]], "odd number of coordinates"),
        ([[1, 2, 3, 4, "5", 6]], "part 0 must hold pixels, got '5'"),
        ([[1, 2, 3, 4, float("nan"), 6]], "part 0 must hold pixels, got nan"),
        ([[1, 2, 3, 4, 10**400, 6]], "part 0 must hold pixels, got 1000"),
    ],
)
def test_polygons(polygons, message):
    with pytest.raises(CaperError, match=f"file: .*{message}"):
        polygon_labels([{"segmentation": polygons}], (8, 8), "file")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"instances": None}, "instances must be a list of objects, got None"),
        ({"instances": [5]}, "instances must be a list of objects, got another list"),
        ({"instances": [{"id": 0, "category_id": 1, "urdf_id": 5, "links": 3}]}, "links must be"),
        ({"instances": [{"id": 0, "category_id": 1, "urdf_id": 5, "links": ["a"]}]}, "links must"),
        ({"depth_path": None}, "depth_path must be text, got None"),
    ],
)
@pytest.mark.parametrize("format", ["artimage", "pm-videos", "reart-videos", "reartmix"])
def test_values_of_another_type(tmp_path, format, change, message):
    root = write_root(format, tmp_path)
    path = next(tmp_path.glob("**/000000.json"))
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(CaperError, match=rf"000000\.json: {message}"):
        open_dataset(format, root, FORMATS[format][0])[0]


def test_a_transformation_of_endless_numbers():
    with pytest.raises(CaperError, match="file: transformation must be 4x4 finite numbers"):
        split_transformation([[10**400] * 4] * 4, "file")


@pytest.mark.parametrize(
    ("ids", "message"),
    [((1, 1), "2 instances have the id 1"), ((0, "x"), "must be an integer, got 'x'")],
)
def test_instances_need_ids_of_their_own(tmp_path, ids, message):
    """Without, one of them would go missing unseen."""
    path = roots.reartmix(tmp_path) / "annotations/scene1/000001.json"
    annotation = json.loads(path.read_text())
    instance = annotation["instances"][0]
    annotation["instances"] = [instance | {"id": number} for number in ids]
    path.write_text(json.dumps(annotation))
    with pytest.raises(CaperError, match=rf"000001\.json: .*{message}"):
        ReArtMixDataset(tmp_path, "box")
