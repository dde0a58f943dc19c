"""Robustness and plausibility: the disturbances by their laws, the table from end to end."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.stats import kstest

from caper_jax import cli
from caper_jax.data.clouds import count_distinct
from caper_jax.reproduce import robustness

CLOUDS = np.random.default_rng(0).uniform(-0.2, 0.2, (4, 5000, 3)).astype(np.float32) + [0, 0, 1]
CLOUDS = CLOUDS.astype(np.float32)


def test_specks_fill_a_ball_evenly():
    disturbed = robustness.with_specks(CLOUDS, 0.3, np.random.default_rng(1))
    moved = (disturbed != CLOUDS).any(-1)
    assert abs(moved.mean() - 0.3) < 0.02
    for cloud, source, chosen in zip(disturbed, CLOUDS, moved, strict=True):
        center = source.mean(0)
        radius = 1.5 * np.linalg.norm(source - center, axis=1).max()
        away = np.linalg.norm(cloud[chosen] - center, axis=1) / radius
        assert kstest(away**3, "uniform").pvalue > 1e-3


def test_speckle_stays_on_its_rays():
    disturbed = robustness.with_speckle(CLOUDS, 0.2, np.random.default_rng(2))
    moved = (disturbed != CLOUDS).any(-1)
    assert abs(moved.mean() - 0.2) < 0.02
    unit = [c / np.linalg.norm(c, axis=-1, keepdims=True) for c in (disturbed, CLOUDS)]
    np.testing.assert_allclose(*unit, atol=1e-5)
    shift = np.linalg.norm(disturbed, axis=-1) - np.linalg.norm(CLOUDS, axis=-1)
    radius = np.linalg.norm(CLOUDS - CLOUDS.mean(1, keepdims=True), axis=-1).max(1, keepdims=True)
    relative = (shift / radius)[moved]
    assert abs(np.abs(relative).mean() - 0.2) < 0.02 and abs((relative > 0).mean() - 0.5) < 0.05


def test_few_points_are_points_of_the_cloud():
    few = robustness.with_few(CLOUDS, 77, np.random.default_rng(3))
    assert few.shape == CLOUDS.shape
    np.testing.assert_array_equal(count_distinct(few), 77)
    known = {tuple(point) for point in CLOUDS[0]}
    assert {tuple(point) for point in few[0]} <= known


def test_the_area_under_roc_is_the_chance_of_the_right_order():
    rng = np.random.default_rng(4)
    right, wrong = rng.normal(0.5, 1, 60).round(1), rng.normal(0, 1, 40).round(1)
    pairs = np.sign(right[:, None] - wrong)
    expected = ((pairs > 0) + 0.5 * (pairs == 0)).mean()
    assert robustness._area_under_roc(right, wrong) == pytest.approx(expected)
    assert robustness._area_under_roc(right, right - 100) == 1.0


@pytest.mark.parametrize("what", ["robustness", "plausibility"])
def test_the_tables_of_the_box(what, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(robustness, "_SHARES", (0.03,))
    monkeypatch.setattr(robustness, "_POINTS", (64,))
    monkeypatch.setattr(robustness, "_FACTORS", (0.2, 5.0))
    monkeypatch.setattr(robustness, "_INSTANCES", 8)
    monkeypatch.setattr("caper_jax.categories.names", lambda: ("box", "stapler"))
    options = ["--category", "box", "--frames", "32", "--out", str(tmp_path)]
    assert cli.main(["reproduce", what, *options]) == 0
    table = capsys.readouterr().out
    content = json.loads((tmp_path / f"{what}.json").read_text())["categories"]["box"]
    if what == "robustness":
        assert list(content) == [
            *("clean 0", "specks 0.03", "speckle 0.03", "points 64", "mask rim 1")
        ]
        for row in content.values():
            assert all(0.0 <= row[key] <= 1.0 for key in row if key != "root_deg")
        assert content["points 64"]["implausible"] == 1.0
        assert content["specks 0.03"]["root_deg"] < content["points 64"]["root_deg"]
        assert "| box        | 3 % specks" in table
        assert (tmp_path / "robustness_box.png").stat().st_size > 1000
    else:
        assert content["5 times as large"]["implausible"] > 0.9
        assert content["another category"]["area"] > 0.8
        assert content["right"]["implausible"] < 0.2
