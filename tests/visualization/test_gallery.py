"""The gallery: a picture of different instances in the parts' colors."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from caper_jax import categories, cli
from caper_jax.visualization import gallery
from caper_jax.visualization.scene import part_color


@pytest.fixture(scope="module")
def box():
    return gallery.render_instances(categories.get("box"), 3, "train", 0)


def test_instances_differ_and_stand_whole_on_white(box):
    assert box.shape == (3, gallery.TILE, gallery.TILE, 3)
    assert box.min() >= 0 and box.max() <= 1
    for edge in (box[:, 0], box[:, -1], box[:, :, 0], box[:, :, -1]):
        np.testing.assert_array_equal(edge, 1.0)
    covered = (box < 1).any(-1).mean((1, 2))
    assert (covered > 0.1).all()
    assert not np.array_equal(box[0], box[1]) and not np.array_equal(box[1], box[2])


def test_parts_have_their_colors(box):
    """Shading keeps the ratios of red, green and blue; a box shows both of its parts."""
    pixels = box[(box < 1).any(-1)]
    direction = pixels / np.linalg.norm(pixels, axis=-1, keepdims=True)
    for part in range(2):
        color = np.array(to_rgb(part_color(part)))
        close = direction @ (color / np.linalg.norm(color)) > 0.9999
        assert close.mean() > 0.05


def test_the_command_writes_rows_of_tiles(tmp_path, monkeypatch, capsys):
    tiles = np.full((2, gallery.TILE, gallery.TILE, 3), 0.5)
    monkeypatch.setattr(gallery, "render_instances", lambda *arguments: tiles)
    out = tmp_path / "new" / "some.png"
    assert (
        cli.main(["gallery", "--category", "box,laptop", "--instances", "2", "--out", str(out)])
        == 0
    )
    with Image.open(out) as picture:
        assert picture.width == 2 * gallery.TILE and picture.height > 2 * gallery.TILE
    assert cli.main(["gallery", "--category", "bxo", "--out", str(out)]) == 2
    assert "did you mean 'box'" in capsys.readouterr().err
