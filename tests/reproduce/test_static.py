"""Tables of single frames, with an estimator that knows the truth, or almost."""

from __future__ import annotations

import json
import types

import numpy as np
import pytest
from _helpers.frames import random_frames
from _helpers.reproductions import cells, run
from _helpers.tiny import network
from _helpers.tracks import BOX

from caper_jax.data import hdf5
from caper_jax.evaluation import protocol
from caper_jax.evaluation.metrics import object_diagonal
from caper_jax.reproduce import static


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Arguments that name a file of frames of a box."""
    path = tmp_path_factory.mktemp("frames") / "box.h5"
    visibility = np.tile([0.9, 0.15], (5, 1))
    fields = random_frames(5, 1500)
    hdf5.write(path, category=BOX, split="test", visibility=visibility, **fields)
    return ["--category", "box", "--data", str(path), "--format", "caper"]


def by(predictor):
    """Stands for ``evaluate``: whatever the model, this predictor answers."""
    return lambda dataset, model, frames: protocol.evaluate(dataset, predictor, frames)


@pytest.fixture
def known(frames, monkeypatch):
    model = types.SimpleNamespace(category=BOX, network=network())
    monkeypatch.setattr(static, "find_model", lambda *_: model)
    monkeypatch.setattr(static, "evaluate", by(protocol.truth_predictor))
    return frames


def test_the_truth_scores_perfectly(known, tmp_path, capsys):
    assert run("table2", tmp_path / "out", *known) == 0
    output = capsys.readouterr().out
    means, spreads = output.split("**All errors")
    row = cells(means, "box", "lid", "as labeled")
    assert row[:9] == ["1.50", "0.00", "0.00", "0.012", "4.30", "0.00", "0.00", "90.1", "100.0"]
    row = cells(spreads, "box", "lid", "as labeled", "0.00 / 0.00")
    assert row[:3] == ["0.0", "0.0 / 0.0", "100.0 / 100.0"]
    assert "5 frames of" in output and "0 failures" in output
    content = json.loads((tmp_path / "out" / "table2.json").read_text())
    assert content["categories"]["box"]["frames"] == 5
    assert run("table2", tmp_path / "out", *known, "--frames", "2") == 0
    assert "2 frames of" in capsys.readouterr().out


def test_a_failure_counts_with_the_distance_over_the_diagonal(known, tmp_path, capsys, monkeypatch):
    def fails(frames, points):
        pose = protocol.truth_predictor(frames, points)
        return pose.replace(rotation=np.full_like(pose.rotation, np.nan))

    monkeypatch.setattr(static, "evaluate", by(fails))
    assert run("table2", tmp_path, *known) == 0
    output = capsys.readouterr().out
    assert "5 failures" in output
    assert cells(output, "box", "lid", "as labeled", "180.00 / 180.00")[0] == "100.0"
    parts = json.loads((tmp_path / "table2.json").read_text())["categories"]["box"]["parts"]
    truth = random_frames(5, 1500)["pose"]
    share = np.linalg.norm(truth.translation, axis=-1) / object_diagonal(truth)[:, None]
    assert [part["rotation_deg"]["mean"] for part in parts] == [180.0, 180.0]
    relative = [part["translation_relative"]["mean"] for part in parts]
    np.testing.assert_allclose(relative, share.mean(0), rtol=1e-4)


def test_parts_are_sorted_by_what_is_hidden(known, tmp_path, capsys):
    assert run("table8", tmp_path, *known) == 0
    output = capsys.readouterr().out
    for share, count, rotation in (
        *(("0-40 %", "5", "0.00"), ("40-80 %", "0", "-"), ("80-100 %", "5", "0.00")),
    ):
        assert cells(output, "box", share)[:3] == [count, "-", rotation]
