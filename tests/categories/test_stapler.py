"""Staplers: conventions, real sizes, mechanics and variety of the drawn instances."""

from __future__ import annotations

import numpy as np
import pytest
from _helpers.shapes import boxes, kinds, motion, moved, sample
from _helpers.solid_points import inside

from caper_jax import categories
from caper_jax.synthetic.instances import draw_instances

# Base length and width, height of the base with the hinge's cheeks, and height of the hinge over
# the underside of the seven measured ReArt-48 staplers, mm.
MEASURED = [
    (119.9, 34.3, 29.4, 23.2),
    (124.6, 34.3, 30.6, 27.4),
    (129.4, 41.1, 34.3, 29.1),
    (121.8, 35.1, 28.8, 22.8),
    (121.6, 34.9, 28.4, 22.5),
    (122.7, 33.5, 29.3, 23.1),
    (161.6, 41.6, 35.3, 28.6),
]


@pytest.fixture(scope="module")
def staplers():
    return draw_instances(categories.get("stapler"), 200, "train", 3)


def has_handles_behind(model):
    return model.pivot[0, 2] - boxes(model)[:, 0, 2].max() > 0.05


def test_the_arm_lies_over_the_base_and_opens_upwards(staplers):
    for model in staplers:
        (base, arm), pivot = boxes(model), model.pivot[0]
        np.testing.assert_array_equal(model.axis, [[-1.0, 0.0, 0.0]])
        if not has_handles_behind(model):
            assert pivot[2] < base[0, 2] + 0.22 * (base[1] - base[0])[2]
            assert arm[1, 1] > base[0, 1] + 0.4 * (base[1] - base[0])[1]
        # The nose of the arm: in front of the hinge, over the front of the base.
        points = sample(np.random.default_rng(0), model.parts[1], 60)
        nose = points[points[:, 2].argmax()]
        assert nose[2] > pivot[2] + 0.04
        assert nose[1] > base[0, 1] and abs(nose[0]) < base[1, 0]
        lifted = moved(nose, motion(model, 0, 0.1))
        assert lifted[1] > nose[1] + 0.05 * (nose[2] - pivot[2])


def test_sizes_are_those_of_real_staplers(staplers):
    size = np.array([np.ptp(boxes(model).reshape(-1, 3), axis=0) for model in staplers])
    low, high = size.min(0), size.max(0)
    assert (low > (0.012, 0.012, 0.04)).all() and (high < (0.11, 0.2, 0.5)).all()
    assert (size[:, 2] > 1.5 * size[:, 0]).all()


def test_every_measured_stapler_has_one_like_it(staplers):
    drawn = []
    for model in staplers:
        low, high = boxes(model)[0]
        drawn.append([*(high - low)[[2, 0, 1]], model.pivot[0, 1] - low[1]])
    ratio = np.abs(np.log(np.array(drawn)[:, None] / (np.array(MEASURED) / 1000)))
    assert (ratio.max(-1).min(0) < 0.12).all()


def test_parts_do_not_run_into_each_other(staplers):
    rng = np.random.default_rng(1)
    for model in staplers[:80]:
        base, arm = model.parts
        points = sample(rng, arm, 60)
        for state in (0.0, model.limits[0, 1] / 2, model.limits[0, 1]):
            at = moved(points, motion(model, 0, state))
            # What turns on the pin surrounds it.
            off_the_pin = np.linalg.norm((at - model.pivot[0])[:, 1:], axis=1) > 0.01
            hit = np.any([inside(solid, at, 0.0006) for solid in base], axis=0)
            assert (hit & off_the_pin).mean() < 0.02


def test_ranges_of_the_hinge(staplers):
    low, high = np.array([model.limits[0] for model in staplers]).T
    assert (low == 0).all()
    assert high.max() == pytest.approx(np.radians(60)) and np.radians(12) < high.min()


def test_all_kinds_occur(staplers):
    """Long arms, minis, pliers, levers; arched, round, tapered and plain covers."""
    length = np.array([np.ptp(boxes(model)[0, :, 2]) for model in staplers])
    pliers = np.array([has_handles_behind(model) for model in staplers])
    arms = [kinds(model.parts[1]) for model in staplers]
    assert (length > 0.34).sum() > 1 and (length < 0.08).sum() > 9
    assert 5 < pliers.sum() < 40
    for kind in ("ellipsoid-box", "cylinder-box", "frustum"):
        assert sum(kind in row for row in arms) > 10
    levers = [boxes(m)[1, 1, 1] - m.pivot[0, 1] > 0.045 for m in staplers]
    assert sum(levers) > 5
