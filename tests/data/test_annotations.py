"""Mistakes in annotations of the public layouts are named, wherever a reader meets them."""

import json

import pytest
from _helpers import roots
from _helpers.formats import FORMATS, write_root

from caper_jax.data.readers import open_dataset
from caper_jax.data.readers.reart import ReArtMixDataset
from caper_jax.errors import CaperError

LAYOUTS = ["artimage", "pm-videos", "reart-videos", "reartmix"]


def edit_first(folder, edit):
    """Changes annotation 000000 of a root."""
    path = next(folder.glob("**/000000.json"))
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("format", LAYOUTS)
def test_values_of_another_type(tmp_path, format):
    root = write_root(format, tmp_path)
    instance = {"id": 0, "category_id": 1, "urdf_id": 5}
    kept = next(tmp_path.glob("**/000000.json")).read_text()
    for changes, field in (
        ({"instances": None}, "instances"),
        ({"instances": [5]}, "instances.0"),
        ({"instances": [instance | {"links": 3}]}, "0.links"),
        ({"instances": [instance | {"links": ["a"]}]}, "0.links.0"),
        ({"instances": [instance | {"urdf_id": "../a", "links": []}]}, "urdf_id"),
        ({"depth_path": None}, "depth_path"),
    ):
        next(tmp_path.glob("**/000000.json")).write_text(json.dumps(json.loads(kept) | changes))
        with pytest.raises(CaperError, match=rf"000000\.json: .*{field} "):
            open_dataset(format, root, FORMATS[format][0])[0]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("segmentation", None, "segmentation "),
        ("segmentation", [1, 2, 3, 4, 5, 6], r"segmentation\.0 "),
        ("segmentation", [[1, 2, 3, 4, 5]], r"segmentation\.0 .*odd"),
        ("segmentation", [[1, 2, 3, 4, "5", 6]], r"segmentation\.0\.4 .*'5'"),
        ("segmentation", [[1, 2, 3, 4, float("nan"), 6]], r"segmentation\.0\.4 .*nan"),
        ("segmentation", [[1, 2, 3, 4, 10**400, 6]], r"segmentation\.0\.4 "),
        ("transformation", [[10**400] * 4] * 4, "transformation must be 4 x 4 finite numbers"),
        ("transformation", "none", "transformation must be 4 x 4 finite numbers"),
    ],
)
def test_links_that_cannot_be(tmp_path, field, value, message):
    root = roots.reartmix(tmp_path)
    edit_first(tmp_path, lambda content: content["instances"][0]["links"][1].update({field: value}))
    with pytest.raises(CaperError, match=rf"000000\.json, instance 0, link 1: {message}"):
        ReArtMixDataset(root, "box")[0]


@pytest.mark.parametrize("ids", [(1, 1), (0, "x")])
def test_instances_need_ids_of_their_own(tmp_path, ids):
    """Without, one of them would go missing unseen."""

    def renumber(content):
        content["instances"] = [content["instances"][0] | {"id": number} for number in ids]

    root = roots.reartmix(tmp_path)
    edit_first(tmp_path, renumber)
    with pytest.raises(CaperError, match=r"000000\.json: .*\bid\b"):
        ReArtMixDataset(root, "box")
