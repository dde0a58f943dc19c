"""Models, frames and videos that tables are measured with."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from _helpers import formats
from _helpers.frames import random_frames
from _helpers.tiny import network, random_variables

from caper_jax import categories, cli
from caper_jax.config import GeneratorConfig, to_dict
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


@pytest.fixture
def drawn(monkeypatch):
    """What is drawn (category, data, split, seeds, number), the same random frames each time."""
    calls = []

    def draw(generator, seed, count, size=None, title=None):
        of_shapes = getattr(generator, "seed", seed)  # that of videos keeps its shapes alone
        facts = generator.category, generator.config, generator.split, of_shapes, seed, count
        calls.append(facts)
        frames = count * getattr(generator, "frames", 1)
        video, frame = np.divmod(np.arange(frames), frames // count)
        fields = random_frames(frames, generator.config.num_points)
        return fields if frames == count else {**fields, "video": video, "frame": frame}

    monkeypatch.setattr(data, "collect_frames", draw)
    monkeypatch.setattr(data, "collect_videos", draw)
    monkeypatch.setattr("caper_jax.synthetic.frames.collect_frames", draw)
    return calls


def test_frames_are_those_of_generate_and_drawn_once(tmp_path, drawn):
    small = replace(SMALL, measure_visibility=True)
    draw = partial(data.generated_frames, tmp_path, LAPTOP, 3, config=small)
    first, description = draw()
    assert "3 generated frames, noise none, seed 0, of 3 test instances" in description
    again, _ = draw()
    assert drawn == [(LAPTOP, small, "test", 0, 0, 3)]
    np.testing.assert_array_equal(again[2].points, first[2].points)
    generate = ["generate", "--category", "laptop", "--frames", "3", "--instances", "3"]
    generate += ["--grid", "24", "--points", "64", "--noise", "none"]
    assert cli.main([*generate, "--out", str(tmp_path / "own.h5")]) == 0
    assert drawn[1] == drawn[0]


def test_videos_are_drawn_once(tmp_path, drawn, monkeypatch):
    draw = partial(data.generated_videos, tmp_path, LAPTOP, "still", 2, 3, config=SMALL)
    first, again = draw(), draw()
    assert list(first.index.values()) == [[0, 1, 2], [3, 4, 5]]
    assert first.dataset.split == "test" and first.dataset.attributes["mode"] == "still"
    assert "2 generated videos of 3 frames, mode still (camera and root" in first.description
    assert drawn == [(LAPTOP, SMALL, "test", 0, 0, 2)]
    np.testing.assert_array_equal(again.dataset[5].points, first.dataset[5].points)
    # Shapes that have changed since: the file is not of these arguments any more.
    monkeypatch.setattr(data, "fingerprint", lambda _: 1)
    draw()
    draw(seed=1)
    assert [call[3:] for call in drawn[1:]] == [(0, 0, 2), (1, 1, 2)]


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
