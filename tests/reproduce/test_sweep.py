"""Sweeps: what they change by its laws, and the curves from end to end."""

from __future__ import annotations

import dataclasses
import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers import tiny
from _helpers.frames import random_pose
from _helpers.reproductions import cells, run
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.estimator import Estimator
from caper_jax.reproduce import conditions, robustness, sweep
from caper_jax.reproduce.options import Options

BOX = categories.get("box")
MODEL = Estimator(BOX, tiny.network(), tiny.random_variables(BOX, tiny.network()))
CLOUDS = np.random.default_rng(0).uniform(-0.2, 0.2, (4, 500, 3)) + [0, 0, 1]
CLOUDS = CLOUDS.astype(np.float32)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_an_edge_hides_its_share(share):
    left = conditions.hide(CLOUDS, share, np.random.default_rng(1))
    assert left.shape == (4, round(500 * (1 - share)), 3)
    directions = []
    for cloud, source in zip(left, CLOUDS, strict=True):
        kept = {tuple(point) for point in cloud}
        inside = np.array([tuple(point) in kept for point in source])
        assert inside.sum() == len(cloud)
        # Some line in the image has all that is left on its one side.
        image = source[:, :2] / source[:, 2:]
        angles = np.radians(np.arange(0, 360, 0.25))
        along = image @ np.stack([np.cos(angles), np.sin(angles)])
        cut = along[inside].max(0) < along[~inside].min(0, initial=np.inf)
        assert cut.any()
        directions.append(angles[cut.argmax()])
    assert share == 0.0 or np.std(directions) > 0.1


def test_noise_moves_the_depth_along_the_rays():
    noisy = conditions.with_noise(CLOUDS, 0.004, np.random.default_rng(2))
    np.testing.assert_allclose(
        noisy[..., :2] / noisy[..., 2:], CLOUDS[..., :2] / CLOUDS[..., 2:], atol=1e-6
    )
    moved = noisy[..., 2] - CLOUDS[..., 2]
    assert moved.std() == pytest.approx(0.004, rel=0.05) and abs(moved.mean()) < 3e-4
    np.testing.assert_array_equal(
        conditions.with_noise(CLOUDS, 0.0, np.random.default_rng(2)), CLOUDS
    )


def test_a_roll_turns_points_and_truth_alike_and_clockwise():
    truth = random_pose(4)
    points, moved = conditions.rolled(CLOUDS, truth, 90.0)
    right = conditions.rolled(np.array([[[1.0, 0, 2]]], np.float32), random_pose(1), 90.0)[0]
    np.testing.assert_allclose(right[0, 0], [0, 1, 2], atol=1e-6)  # y points down in the image

    def at_rest(points, pose):
        return np.einsum("fji,fnj->fni", pose.rotation[:, 0], points - pose.translation[:, :1])

    np.testing.assert_allclose(at_rest(points, moved), at_rest(CLOUDS, truth), atol=1e-5)
    # A model that is told of the roll says of the rolled clouds what it said before.
    told = Estimator(BOX.rolled(90.0), MODEL.network, MODEL.variables)
    few = CLOUDS[:, :64]
    found = jax.device_get(told(conditions.rolled(few, truth, 90.0)[0]).pose)
    before = jax.device_get(MODEL(few).pose)
    expected = conditions.rolled(few, before, 90.0)[1]
    np.testing.assert_allclose(found.rotation[:, 0], expected.rotation[:, 0], atol=1e-3)


def test_what_each_sweep_draws(monkeypatch):
    """Amounts ascend, and what is drawn for them is what they say."""
    asked = []
    points, truth = np.tile(CLOUDS, (3, 1, 1)), random_pose(12)

    def draw(**changes):
        asked.append(changes)
        return robustness.Batch(points, None, truth)

    options = Options(frames=2)
    for name, one in conditions.SWEEPS.items():
        levels = list(one.levels(draw, options))
        places = [at for at, _, _ in levels]
        assert places == sorted(set(places)) and len(places) >= 5, name
        frames = 2 if name == "distance" else 12
        assert all(len(p) == len(t.rotation) == frames for _, p, t in levels), name
    distance = np.concatenate(
        [t.translation[:, 0] for _, _, t in conditions._distance(draw, options)]
    )
    assert len(np.unique(distance, axis=0)) == 12
    tight, wide = {"erosion": 1.0}.items(), {"rim": 1.0}.items()
    assert sum(tight <= changes.items() for changes in asked) == len(conditions.TOO_TIGHT)
    assert sum(wide <= changes.items() for changes in asked) == len(conditions.TOO_WIDE)
    assert {"noise": ("none",)} in asked


def test_the_curves_from_end_to_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sweep, "find_models", lambda options: {"box": MODEL})
    monkeypatch.setattr(robustness, "_INSTANCES", 4)
    few = {"_GRID": 24, "TOO_TIGHT": (), "TOO_WIDE": (0.08,), "POINTS": (48, 64)}
    for name, values in few.items():
        monkeypatch.setattr(conditions, name, values)
    given = ("--category", "box", "--frames", "20", "--sweep", "points,mask", "--sweep", "roll")
    assert run("sweep", tmp_path, *given) == 0
    content = json.loads((tmp_path / "sweep.json").read_text())
    levels = content["categories"]["box"]
    assert list(levels) == ["points", "mask", "roll"] == list(content["axes"])
    assert [level["at"] for level in levels["mask"]] == [0.0, 8.0]
    for level in [level for each in levels.values() for level in each]:
        assert level["frames"] == 20 and 0 <= level["flipped"] <= 1
        for spread in (level["root_rotation_deg"], level["state"]["degrees"]):
            assert 0 < spread["median"] <= spread["p90"]
    found = cells(capsys.readouterr().out, "box", "points", "48")
    assert found[0] == f"{levels['points'][0]['root_rotation_deg']['median']:.2f}"
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {"sweep_box_points.png", "sweep_box_mask.png", "sweep_box_roll.png"}


def test_figures_are_those_of_the_errors():
    """Of a model that is off by 0, 4, 8, ... deg about the camera's axis, and nothing else."""
    truth = random_pose(20)
    angles = np.arange(20.0) * 4
    turn = Rotation.from_euler("z", angles[:, None], degrees=True).as_matrix().astype(np.float32)
    guess = dataclasses.replace(truth, rotation=turn[:, None] @ truth.rotation)
    points = np.arange(20, dtype=np.float32)[:, None, None] / 100 + CLOUDS[0, :64]

    class Off(Estimator):
        def __init__(self):
            self.category, self.network, self.variables = BOX, MODEL.network, {}

        def function(self, variables, points):
            index = jnp.round((points[:, 0, 0] - CLOUDS[0, 0, 0]) * 100).astype(jnp.int32)
            pose = jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], guess)
            return types.SimpleNamespace(pose=pose, plausible=index >= 5)

    model = Off()
    model.function = model.function  # one object, as jit needs it
    found = sweep.measured(model, points, truth)
    assert found["root_rotation_deg"] == pytest.approx(
        {"median": np.median(angles), "p90": np.quantile(angles, 0.9)}, abs=1e-3
    )
    assert found["flipped"] == (angles > 30).mean() and found["implausible"] == 0.25
    assert found["root_translation_m"] == {"median": 0, "p90": 0}
    assert found["state"] == {"degrees": {"median": 0, "p90": 0}} and found["frames"] == 20


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--sweep", "oclusion"), "unknown sweep 'oclusion'; did you mean 'occlusion'"),
        (("--sweep", "mask", "--videos", "3"), "--videos is no option of sweep"),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, options, message):
    assert run("sweep", tmp_path / "out", *options) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
