"""``caper generate``: splits that share no views, and options that contradict each other."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from caper_jax import cli
from caper_jax.cli import generate
from caper_jax.synthetic import frames, images, videos

VIDEOS = ("--videos", "1", "--frames-per-video", "2")
PM_VIDEOS = ("--layout", "pm-videos", "--videos", "2")


class Drawn(Exception):
    """Raised in place of drawing, with the arguments."""


def stop(*arguments, **_):
    raise Drawn(arguments)


@pytest.mark.parametrize(
    ("options", "owner", "name"),
    [
        (("--instances", "4"), frames.Generator, "batch"),
        ((*VIDEOS, "--instances", "4"), videos.VideoGenerator, "batch"),
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--videos", "2", "--frames", "3"), "--videos and --frames exclude each other"),
        (("--mode", "cam"), "--mode is of videos: add --videos N"),
        (("--urdf", "no_such.urdf", "--points", "1"), "--points must be at least 16, got 1"),
        (("--layout", "artimage", "--noise", "kinekt"), "invalid choice 'kinekt'"),
        (("--images", "--frames", "1", "--grid", "96"), "--grid has no effect with --images"),
        (("--up", "z"), "--up belongs to --urdf"),
        (("--urdf", "x.urdf", "--images"), "--images and --urdf exclude each other"),
        (("--urdf", "x.urdf", "--front", "w"), "'w' is neither x, y, z"),
        (("--layout", "pm-videos"), "needs --videos"),
        (("--layout", "artimage", "--videos", "2"), "has no videos"),
        (("--layout", "artimage", "--images"), "--images and --layout exclude"),
        ((*PM_VIDEOS, "--mode", "cam"), "--layout and --mode exclude"),
        ((*PM_VIDEOS, "--frames-per-video", "1"), "a video needs at least 2 frames, got 1"),
    ],
)
def test_options_that_make_no_sense(options, message, tmp_path, capsys):
    """Refused before anything is written or, of a URDF, read."""
    out = ["--out", str(tmp_path / "out")]
    assert cli.main(["generate", "--category", "laptop", *options, *out]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
