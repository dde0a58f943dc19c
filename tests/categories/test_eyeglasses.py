"""Eyeglasses: conventions, real sizes, mechanics and variety of the drawn instances."""

from __future__ import annotations

import numpy as np
import pytest
from _helpers.shapes import boxes, corners, motion, moved
from _helpers.solid_points import deepest_overlap, inside

from caper_jax import categories
from caper_jax.synthetic.instances import draw_instances

SIDES = (-1.0, 1.0)  # of the temples, parts 1 and 2


@pytest.fixture(scope="module")
def glasses():
    return draw_instances(categories.get("eyeglasses"), 200, "train", 3)


def has_lens(model):
    """Whether something opaque lies behind the middle of the right lens."""
    low, high = boxes(model)[0]
    line = np.linspace(0.0, 1.0, 400)[:, None] * (0, 0, high[2] - low[2])
    points = np.array([0.26 * (high[0] - low[0]), 0.0, low[2]]) + line
    return bool(np.any([inside(solid, points) for solid in model.parts[0]]))


def test_temples_reach_back_from_their_sides(glasses):
    for model in glasses:
        frame, *temples = boxes(model)
        assert frame[1, 2] > max(temple[1, 2] for temple in temples)
        for temple, side in zip(temples, SIDES, strict=True):
            assert (np.sign(temple[:, 0]) == side).all()
            assert temple[0, 2] < frame[0, 2] - 0.08
            assert temple[0, 1] < frame[1, 1]


def test_hinges_are_upright_and_where_frame_and_temple_meet(glasses):
    for model in glasses:
        for joint, side in enumerate(SIDES):
            assert side * model.axis[joint, 1] > np.cos(np.radians(10))
            assert side * model.pivot[joint, 0] > 0.045
            pivot = model.pivot[joint][None]
            for part in (0, joint + 1):
                assert any(inside(solid, pivot, -0.001)[0] for solid in model.parts[part])


@pytest.mark.parametrize("joint", [0, 1])
def test_a_positive_state_folds_a_temple_inwards(glasses, joint):
    for model in glasses:
        points = corners(model.parts[joint + 1])
        tip = points[points[:, 2].argmin()]
        slightly, fully = (moved(tip, motion(model, joint, at)) for at in (0.2, np.pi / 2))
        assert SIDES[joint] * (tip - slightly)[0] > 0.01
        # Folded, the temple lies behind the frame, along x.
        assert abs(fully[2] - model.pivot[joint, 2]) < 0.03
        assert SIDES[joint] * (tip - fully)[0] > 0.07


def test_sizes_are_those_of_real_glasses(glasses):
    size = np.array([np.ptp(boxes(model), axis=1) for model in glasses])
    frame, temples = size[:, 0], size[:, 1:]
    assert (frame > (0.095, 0.018, 0.005)).all() and (frame < (0.165, 0.08, 0.05)).all()
    assert (temples > (0.001, 0.002, 0.08)).all() and (temples < (0.03, 0.08, 0.165)).all()
    np.testing.assert_allclose(temples[:, 0, 2], temples[:, 1, 2], atol=0.004)


def test_frames_are_mirror_symmetric(glasses):
    for model in glasses[:50]:
        low, high = boxes(model)[0]
        middle = (model.pivot[0, 0] + model.pivot[1, 0]) / 2
        np.testing.assert_allclose(low[0] + high[0], 2 * middle, atol=1e-9)


def test_temples_do_not_run_into_the_frame(glasses):
    """Only the barrel of the hinge lies in a temple; folded tips may touch a rim."""
    rng = np.random.default_rng(0)
    for model in glasses[:60]:
        for joint in (0, 1):
            for state in (0.0, 0.8, model.limits[joint, 1]):
                at = motion(model, joint, state)
                depth = deepest_overlap(rng, model.parts[joint + 1], model.parts[0], at)
                assert depth < 0.0035


def test_temples_fold_nearly_all_the_way(glasses):
    limits = np.degrees([model.limits for model in glasses])
    assert (limits[..., 0] == 0).all()
    assert limits[..., 1].min() >= 84 and limits[..., 1].max() <= 90


def test_all_kinds_occur(glasses):
    lens = np.mean([has_lens(model) for model in glasses])
    assert 0.5 < lens < 0.85
    front = np.array([np.ptp(boxes(model)[0], axis=0) for model in glasses])
    assert (front[:, 1] < 0.032).sum() > 5 and (front[:, 1] > 0.052).sum() > 10
    temples = np.array([np.ptp(boxes(model)[2], axis=0) for model in glasses])
    drop = temples[:, 1] / temples[:, 2]  # of the tips behind the ears
    assert (drop < 0.12).sum() > 5 and (drop > 0.35).sum() > 10
    # Thin wires, and plastic.
    height = np.array([model.parts[2][0].half[1] for model in glasses])
    assert (height < 0.0015).sum() > 20 and (height > 0.004).sum() > 30
    counts = {len(model.parts[0]) for model in glasses}
    assert len(counts) > 10
