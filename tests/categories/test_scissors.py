"""Scissors: frame and root, opening, equal halves, real sizes and variety of the instances."""

from __future__ import annotations

import json

import numpy as np
import pytest
from _helpers.shapes import boxes, corners, motion, moved
from _helpers.solid_points import deepest_overlap, inside
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.articulation.symmetry import apply_symmetry
from caper_jax.categories.forms import rotated
from caper_jax.geometry.solids import bounds
from caper_jax.synthetic.instances import build_bank, draw_instances

REST = 20.0  # degrees between the blades
HALF_TURN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def scissors():
    return draw_instances(categories.get("scissors"), 200, "train", 3)


def straightened(model, part):
    """The part as a root, its blade along x: tip at +x, handle at -z, pivot at the origin."""
    turn = Rotation.from_euler("y", REST / 2, degrees=True).as_matrix()
    if part == 1:
        turn = turn @ HALF_TURN
    return [rotated(solid.moved(-model.pivot[0]), turn) for solid in model.parts[part]]


def straight_size(model, part):
    low, high = bounds(straightened(model, part))
    return high - low


def reach(model, part):
    """How far the handle reaches back from the pivot, meters."""
    return -bounds(straightened(model, part))[0][0]


def is_equal(model):
    """Whether a half turn about x takes the parts' boxes to each other."""
    low, high = boxes(model).transpose(1, 0, 2)
    center, size = (low + high) / 2, high - low
    return np.allclose(size[0], size[1]) and np.allclose(center[0], HALF_TURN @ center[1])


def test_blades_lie_twenty_degrees_apart_about_x(scissors):
    """The line of a blade runs from the pivot to its tip: straightened, the tip is on x."""
    for model in scissors:
        for part in (0, 1):
            solids = straightened(model, part)
            tip = np.array([[0.995 * bounds(solids)[1][0], 0.0, 0.0]])
            beside = tip + np.linspace(-0.02, 0.02, 401)[:, None] * (0, 0, 1.0)
            beside = np.concatenate([beside + (0, y, 0) for y in (-0.0004, 0.0004)])
            hit = np.any([inside(solid, beside) for solid in solids], axis=0)
            assert hit.any()
            assert beside[hit, 2].mean() == pytest.approx(0.0, abs=2e-4)


def test_root_has_its_tip_at_positive_z_and_the_longer_handle(scissors):
    for model in scissors:
        tips, ends = [], []
        for part in model.parts:
            points = corners(part) - model.pivot[0]
            tips.append(points[points[:, 0].argmax(), 2])
            ends.append(points[points[:, 0] < 0.5 * points[:, 0].min(), 2].mean())
        assert tips[0] > 0 > tips[1]
        assert ends[0] < ends[1]  # the handles cross over
        if is_equal(model):
            assert reach(model, 0) == pytest.approx(reach(model, 1))
        else:
            assert reach(model, 0) > reach(model, 1) + 0.0005


def test_a_positive_state_opens(scissors):
    for model in scissors:
        np.testing.assert_array_equal(model.axis, [[0.0, 1.0, 0.0]])
        points = corners(model.parts[1])
        tip = points[points[:, 0].argmax()]
        opened = moved(tip, motion(model, 0, 0.1))
        assert opened[2] < tip[2] - 0.05 * (tip - model.pivot[0])[0]
        opening = REST + np.degrees(model.limits[0])
        assert opening[0] == pytest.approx(3) and 42 <= opening[1] <= 60


def test_pivots_run_through_both_blades(scissors):
    for model in scissors:
        for part in model.parts:
            line = model.pivot[0] + np.linspace(-0.006, 0.006, 200)[:, None] * (0, 1, 0)
            assert np.any([inside(solid, line) for solid in part])


def test_halves_do_not_run_into_each_other(scissors):
    rng = np.random.default_rng(0)
    for model in scissors[:60]:
        for state in (model.limits[0, 0], 0.0, model.limits[0, 1]):
            depth = deepest_overlap(rng, model.parts[1], model.parts[0], motion(model, 0, state))
            assert depth < 0.0015


def test_equal_halves_change_places_by_the_declared_half_turn(scissors):
    """Solid by solid; and the second reading of the truth keeps every convention."""
    category = categories.get("scissors")
    equal = [model for model in scissors if is_equal(model)]
    assert 0.35 * len(scissors) < len(equal) < 0.65 * len(scissors)
    for model in equal:
        one, other = map(corners, model.parts)
        for points in (one, other):
            points[:] = points[np.lexsort(points.round(7).T)]
        other = other @ HALF_TURN
        other = other[np.lexsort(other.round(7).T)]
        np.testing.assert_allclose(one, other, atol=1e-6)
    bank = build_bank(equal)
    count, state = len(equal), np.full((len(equal), 1), 0.3)
    truth = ArticulatedPose(
        rotation=np.stack([np.tile(np.eye(3), (count, 1, 1)), _spins(state)], axis=1),
        translation=np.stack([np.zeros((count, 3)), _shifts(bank, state)], axis=1),
        size=bank.size,
        box_center=bank.box_center,
        joint_axis=bank.joint_axis,
        joint_pivot=bank.joint_pivot,
        joint_state=state,
    )
    second = apply_symmetry(truth, category.symmetries[0], category)
    np.testing.assert_allclose(second.size, truth.size, atol=1e-6)
    np.testing.assert_allclose(second.box_center, truth.box_center, atol=1e-6)
    np.testing.assert_allclose(second.joint_axis, truth.joint_axis, atol=1e-12)
    np.testing.assert_allclose(second.joint_pivot, truth.joint_pivot, atol=1e-6)
    np.testing.assert_array_equal(second.joint_state, state)


def _spins(state):
    return Rotation.from_rotvec(state * (0, 1, 0)).as_matrix()


def _shifts(bank, state):
    pivot = bank.joint_pivot[:, 0]
    return pivot - np.einsum("nij,nj->ni", _spins(state), pivot)


def test_sizes_are_those_of_real_scissors(scissors):
    size = np.array([[straight_size(model, part) for part in (0, 1)] for model in scissors])
    assert (size > (0.07, 0.003, 0.018)).all() and (size < (0.33, 0.03, 0.09)).all()


def test_every_measured_pair_has_one_like_it(scissors, shared_data):
    """Length, width and distance from pivot to tips of the nine ReArt-48 pairs, blade by blade.

    Their files hold the blades along y and z of the file's axes, which are our x and z, at a
    right angle.
    """
    metas = json.loads((shared_data / "reartmix_box" / "urdf_metas.json").read_text())
    measured = []
    for entry in metas["urdf_metas"]:
        if entry["category_name"] == "scissor":
            corners = np.array(entry["corner_pts"])[1:, :, 0]
            for (low, high), length, width in zip(corners, (1, 0), (0, 1), strict=True):
                size = high - low
                measured.append([size[length], size[width], size[2], high[length]])
    assert len(measured) == 18
    drawn = []
    for model in scissors:
        low, high = bounds(straightened(model, 0))
        drawn.append([high[0] - low[0], high[2] - low[2], high[1] - low[1], high[0]])
    ratio = np.abs(np.log(np.array(drawn)[:, None] / np.array(measured)))
    assert ratio.max(-1).min(0).max() < 0.2


def test_all_kinds_occur(scissors):
    """Left-handed, bent and round-tipped pairs; flat rings and round tubes; small and long."""
    length = np.array([straight_size(model, 0)[0] for model in scissors])
    assert (length < 0.105).sum() > 5 and (length > 0.24).sum() > 5
    metal = np.array([model.parts[0][0].center[1] - model.pivot[0, 1] for model in scissors])
    assert 5 < (metal < 0).sum() < 40  # the root below: left-handed
    rings = [any(s.hole is not None for s in model.parts[0]) for model in scissors]
    assert 20 < sum(rings) < 100
    # Bent handles: the root's reaches across the line of its blade.
    bent = [bounds(straightened(model, 0))[0][2] > -0.03 for model in scissors]
    assert sum(bent) > 5
