"""Splits of a seed share neither instances nor views, whatever is written of them."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from caper_jax.cli import generate
from caper_jax.synthetic import frames, images, videos

VIDEOS = ("--videos", "1", "--frames-per-video", "2")


class Drawn(Exception):
    """Raised in place of drawing, with the arguments."""


def stop(*arguments, **_):
    raise Drawn(arguments)


@pytest.mark.parametrize(
    ("options", "owner", "name"),
    [
        ((), frames.Generator, "batch"),
        (VIDEOS, videos.VideoGenerator, "batch"),
        (("--images",), images, "render_image"),
        (("--layout", "artimage"), images, "render_still"),
        (("--layout", "pm-videos", *VIDEOS), images, "render_clip"),
    ],
)
def test_every_split_has_its_own_keys(options, owner, name, tmp_path, monkeypatch):
    monkeypatch.setattr(owner, name, stop)
    keys = {}
    for split in ("train", "val", "test"):
        out = tmp_path / split
        asked = ["--category", "laptop", "--split", split, "--seed", "7", "--out", str(out)]
        if "--videos" not in options:
            asked += ["--frames", "2"]
        with pytest.raises(Drawn) as drawn:
            generate.run(generate.parse([*asked, *options]))
        method = owner in (frames.Generator, videos.VideoGenerator)
        keys[split] = jax.random.key_data(drawn.value.args[0][1 if method else 0])
    # That of the published test sets.
    first = jax.random.fold_in(jax.random.key(7), 0)
    np.testing.assert_array_equal(keys["test"], jax.random.key_data(first))
    assert len({tuple(key.tolist()) for key in keys.values()}) == 3
