"""Models, frames and videos that tables are measured with."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from _helpers import formats
from _helpers.quick import quick_jit
from _helpers.tiny import network, random_variables

from caper_jax import categories, cli
from caper_jax.config import GeneratorConfig, to_dict
from caper_jax.data import hdf5
from caper_jax.errors import CaperError
from caper_jax.models.files import write_model
from caper_jax.reproduce import data
from caper_jax.reproduce.options import Options

BOX, LAPTOP = categories.get("box"), categories.get("laptop")
SMALL = GeneratorConfig(instances=3, grid=24, num_points=64, noise=("none",))


def options(weights, *category):
    return Options(out=weights, weights=weights, category=category)


def test_a_folder_of_models_or_one_of_them(tmp_path):
    config = network()
    card = {"category": "laptop", "run": {"network": to_dict(config)}}
    write_model(tmp_path / "laptop", random_variables(LAPTOP, config), card)
    for weights in (tmp_path, tmp_path / "laptop"):
        assert data.find_model("laptop", options(weights)).category is LAPTOP
        assert data.find_model("box", options(weights)) is None
    assert list(data.find_models(options(tmp_path))) == ["laptop"]
    with pytest.raises(CaperError, match="no model of box"):
        data.find_models(options(tmp_path, "laptop", "box"))
    with pytest.raises(CaperError, match="nothing: neither a model directory"):
        data.find_model("laptop", options(tmp_path / "nothing"))


def test_models_have_the_object_scale_of_the_options(tmp_path, monkeypatch):
    loaded = []
    monkeypatch.setattr(data, "load", lambda *arguments: loaded.append(arguments))
    data.find_model("laptop", replace(options(None), object_scale=4.5))
    assert loaded == [("laptop", None, 4.5)]


def test_frames_are_those_of_generate_and_drawn_once(tmp_path, monkeypatch):
    small = replace(SMALL, measure_visibility=True)
    monkeypatch.setattr(jax, "jit", quick_jit)
    draw = partial(data.generated_frames, tmp_path, LAPTOP, 3, config=small)
    first, description = draw()
    assert "3 generated frames, noise none, seed 0, of 3 test instances" in description
    file = tmp_path / "own.h5"
    generate = ["generate", "--category", "laptop", "--frames", "3", "--instances", "3"]
    generate += ["--grid", "24", "--points", "64", "--noise", "none", "--out", str(file)]
    assert cli.main(generate) == 0
    own = hdf5.Hdf5Dataset(file, "laptop", "test")
    for mine, other in zip(first, own, strict=True):
        assert mine.name == other.name
        np.testing.assert_array_equal(mine.points, other.points)
    monkeypatch.setattr(data, "collect_frames", None)  # calling it would fail
    again, _ = draw()
    np.testing.assert_array_equal(again[2].points, first[2].points)


def test_videos_are_drawn_once(tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "jit", quick_jit)
    draw = partial(data.generated_videos, tmp_path, LAPTOP, "still", 2, 3, config=SMALL)
    first = draw()
    assert list(first.index.values()) == [[0, 1, 2], [3, 4, 5]]
    assert first.dataset.split == "test" and first.dataset.attributes["mode"] == "still"
    assert "2 generated videos of 3 frames, mode still (camera and root" in first.description
    states = [frame.truth.joint_state[0] for frame in first.frames("00001")]
    assert np.ptp(states) == 0
    drawn = []
    monkeypatch.setattr(hdf5, "write", lambda path, **_: drawn.append(path.name))
    monkeypatch.setattr(data, "collect_videos", lambda *_: {})
    again = draw()
    assert drawn == []
    np.testing.assert_array_equal(again.dataset[5].points, first.dataset[5].points)
    # Shapes that have changed since: the file is not of these arguments any more.
    monkeypatch.setattr(data, "fingerprint", lambda _: 1)
    draw()
    with pytest.raises(CaperError, match=r"seed1\.h5"):
        draw(seed=1)
    assert drawn == [f"laptop_still_none_2x3x64_seed{seed}.h5" for seed in (0, 1)]


def test_videos_of_a_public_layout_and_frames_that_are_none(tmp_path):
    (tmp_path / "pm").mkdir()
    root = formats.write_root("pm-videos", tmp_path / "pm")
    videos = data.dataset_videos("pm-videos", root, LAPTOP, None, 1)
    ((name, index),) = videos.index.items()
    names = [videos.dataset.names[i] for i in index]
    assert [frame.name for frame in videos.frames(name)] == names
    assert all(frame.startswith(name) for frame in names)
    assert data.dataset_videos("pm-videos", root, BOX, None, None) is None
    single = formats.write_root("caper", tmp_path)
    with pytest.raises(CaperError, match="single frames, no videos, of box"):
        data.dataset_videos("caper", single, BOX, None, None)
