"""Small inputs that once came out wrong, with the right values beside them; skipped if absent."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.cli import main
from caper_jax.errors import CaperError
from caper_jax.estimator import load
from caper_jax.lie import so3
from caper_jax.models.plausibility import FEW_POINTS, TOO_LARGE, implausible_because

CASES = Path(__file__).resolve().parents[2] / "shared" / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason=f"no cases at {CASES}")


def root_error(found, truth) -> float:
    """Degrees."""
    return float(np.degrees(so3.geodesic_distance(found.pose.rotation[0], np.array(truth)[0])))


@pytest.mark.parametrize("name", ["box_0", "laptop_1"])
@pytest.mark.parametrize("share", ["0.3", "3"])
def test_specks_change_nothing(name, share):
    truth = json.loads((CASES / "specks" / f"{name}_truth.json").read_text())
    estimator = load(name.split("_")[0])
    found = estimator(np.load(CASES / "specks" / f"{name}_{share}percent.npy"))
    assert root_error(found, truth["rotation"]) < 1.0
    assert found.plausible
    strays = int((np.asarray(found.labels) < 0).sum())
    assert float(share) / 200 * 1024 <= strays <= 3 * float(share) / 100 * 1024


def test_few_points_are_refused_or_doubted():
    box, folder = load("box"), CASES / "few_points"
    with pytest.raises(CaperError, match="only 16 of 16 points"):
        box(np.load(folder / "box_0_16.npy"))
    with pytest.raises(CaperError, match="all 200 usable points of points are the same point"):
        box(np.load(folder / "all_equal.npy"))
    found = box(np.load(folder / "box_0_48.npy"))
    assert found.reason == FEW_POINTS and not found.plausible
    low, high = box.category.state_bounds[0]
    assert low <= found.pose.joint_state[0] <= high


def test_depth_of_the_tum_kind_is_recognized(capsys):
    folder = CASES / "tum_scale"
    inputs = [
        *("--depth", str(folder / "depth.png"), "--mask", str(folder / "mask.png")),
        *("--intrinsics", str(folder / "intrinsics.json")),
    ]
    category = json.loads((folder / "truth.json").read_text())["category"]
    assert main(["estimate", "--category", category, *inputs]) == 0
    (warning,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("warning: ")]
    assert "times too large" in warning and "--depth-scale 0.0002" in warning
    assert main(["estimate", "--category", category, *inputs, "--depth-scale", "0.0002"]) == 0
    assert "warning" not in capsys.readouterr().err


def test_clouds_in_one_place_have_gradients_and_no_object():
    """Inside jit nothing can be refused: the verdict says it, and no number is NaN."""
    for name in ("box", "drawer"):
        estimator = load(name)
        points = jnp.tile(jnp.array([0.1, -0.05, 0.8]), (1, 1024, 1))

        def total(points, estimator=estimator):
            found = estimator.function(estimator.variables, points)
            leaves = (found.pose, found.rotation_std, found.translation_std, found.state_std)
            return sum(leaf.sum() for leaf in jax.tree.leaves(leaves)), found

        gradient, found = jax.grad(total, has_aux=True)(points)
        assert np.isfinite(gradient).all()
        assert not found.plausible[0] and found.distinct_points[0] == 1


def test_the_warning_names_the_factor():
    box = load("box")
    points = np.load(CASES / "specks" / "box_0_0.3percent.npy")
    found = box(5 * points)
    assert found.reason == TOO_LARGE
    assert "times too large for this category (box)" in implausible_because(found, box.category)
