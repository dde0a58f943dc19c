"""Mistakes in annotations of the public layouts are named, wherever a reader meets them."""

import json

import pytest
import roots

from caper_jax.data.links import polygon_labels
from caper_jax.data.reartmix import ReArtMixDataset
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
