"""Drawers: conventions, mechanics, real sizes and the variety of the generated cabinets."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest
from _helpers.shapes import boxes
from _helpers.solid_points import deepest_overlap, inside

from caper_jax.categories.drawer import DRAWER
from caper_jax.synthetic.instances import draw_instances

CLOSE = 40  # instances of the tests that look at points


@pytest.fixture(scope="module")
def models():
    return draw_instances(DRAWER, 200, "test", 0)


def is_cart(model) -> bool:
    return model.parts[0][0].hole is None


def front_of_carcass(model) -> float:
    """z of the front of the body's first solid: the shell, or a front post."""
    return model.parts[0][0].extent()[1][2] if not is_cart(model) else model.pivot[0, 2]


def slid(distance: float) -> np.ndarray:
    pose = np.eye(4)
    pose[2, 3] = distance
    return pose


def test_a_body_and_three_drawers_from_the_bottom_up(models):
    for model in models:
        body, *drawers = boxes(model)
        middle = boxes(model)[:, :, 1].mean(1)
        assert (np.diff(middle[1:]) > 0).all()
        # No drawer is higher than the body or reaches below it.
        assert all(body[0, 1] < low[1] and high[1] < body[1, 1] + 0.02 for low, high in drawers)
        # Fronts (first solids) lie one above the other.
        fronts = np.array([part[0].extent() for part in model.parts[1:]])
        assert (fronts[1:, 0, 1] > fronts[:-1, 1, 1]).all()


def test_drawers_rest_closed_and_slide_out_to_the_front(models):
    for model in models:
        np.testing.assert_array_equal(model.axis, [[0, 0, 1]] * 3)
        front = front_of_carcass(model)
        body, *drawers = boxes(model)
        for part, box, (low, high) in zip(model.parts[1:], drawers, model.limits, strict=True):
            back, tip = box[:, 2]
            assert low == 0 and back > body[0][2] and back < front
            # Nothing but the front and its handle stands out of the closed cabinet.
            tray = part[0].extent()[0][2]
            assert tray < front + 0.002 and tip - front < 0.085
            # Fully open, at least half of the tray is out and some of it still held.
            assert front + 0.5 * (back - front) < back + high < front
            assert tip + high > front + 0.05


def test_sizes_are_those_of_furniture_and_of_desktop_boxes(models):
    size = np.array([np.ptp(boxes(model)[0], axis=0) for model in models])
    assert size.min() > 0.1 and size.max() < 2.2
    width, height, depth = size.T
    assert np.percentile(height, 5) < 0.35 and np.percentile(height, 95) > 1.1
    assert np.percentile(width, 5) < 0.32 and np.percentile(width, 95) > 1.05
    # The published means (ArtImage) lie well within: width 0.71 and depth 0.64 of the height.
    assert np.percentile(width / height, 20) < 0.71 < np.percentile(width / height, 80)
    assert np.percentile(depth / height, 20) < 0.64 < np.percentile(depth / height, 80)


def test_trays_are_open_above_and_leave_a_cavity(models):
    for model in models[:CLOSE]:
        body = model.parts[0]
        for part, limits in zip(model.parts[1:], model.limits, strict=True):
            tray = next(solid for solid in part[1:] if _is_tray(solid))
            room = tray.hole
            # Just above the tray's floor, and just over its rim, in a corner.
            floor = room.center[1] - room.half[1]
            rim = tray.center[1] + tray.half[1]
            points = np.tile(room.center + np.array([0.8, 0, -0.8]) * room.half, (2, 1))
            points[:, 1] = floor + 1e-4, rim + 1e-4
            assert not inside(tray, points).any()
            assert not any(inside(solid, points).any() for solid in body)
            # Once the drawer is open, nothing is left where the back of its tray was.
            back = tray.center - np.array([0, 0, tray.half[2] - 1e-4])
            gone = back[None] - slid(limits[1])[:3, 3]
            assert inside(tray, back[None]).all()
            assert not any(inside(solid, gone).any() for solid in part)
            assert not any(inside(solid, back[None]).any() for solid in body)


def _is_tray(solid) -> bool:
    """A box whose hole is open above, but not to the front."""
    if solid.hole is None:
        return False
    low, high = solid.extent()
    hole_low, hole_high = solid.hole.extent()
    return bool(hole_high[1] > high[1] and hole_high[2] < high[2] and hole_low[1] > low[1])


def test_parts_do_not_pass_through_each_other(models):
    rng = np.random.default_rng(0)
    for model in models[:CLOSE]:
        for joint, (low, high) in enumerate(model.limits):
            for share in (0.0, 0.3, 1.0):
                pose = slid(low + share * (high - low))
                others = list(chain(*model.parts[: joint + 1], *model.parts[joint + 2 :]))
                assert deepest_overlap(rng, model.parts[joint + 1], others, pose) < 5e-4


def test_every_kind_of_cabinet_occurs(models):
    def share(condition) -> float:
        return np.mean([condition(model) for model in models])

    def shell(model):
        return None if is_cart(model) else model.parts[0][0]

    def open_side(model, axis: int, high: bool) -> bool:
        solid = shell(model)
        if solid is None:
            return False
        outer, hole = solid.extent()[high][axis], solid.hole.extent()[high][axis]
        return hole > outer if high else hole < outer

    def heights(model):
        return np.array([np.ptp(np.array(part[0].extent())[:, 1]) for part in model.parts[1:]])

    def kinds(model, part: int):
        return {solid.kind for solid in model.parts[part]}

    assert 0.03 < share(is_cart) < 0.2
    assert share(lambda m: open_side(m, 1, True)) > 0.03  # kitchen units without worktop
    assert share(lambda m: open_side(m, 2, False)) > 0.01  # no back
    inset = share(lambda m: m.parts[1][0].extent()[1][2] <= front_of_carcass(m) + 1e-9)
    assert 0.25 < inset < 0.75
    equal = share(lambda m: np.ptp(heights(m)) < 0.15 * heights(m).mean())
    graded = share(lambda m: (np.diff(heights(m)) < -0.02 * heights(m).mean()).all())
    assert equal > 0.15 and graded > 0.15
    for kind in ("box", "cylinder", "ellipsoid", "frustum"):
        assert share(lambda m, kind=kind: kind in kinds(m, 1)) > 0.1
    assert share(lambda m: "frustum" in kinds(m, 0)) > 0.05  # tapered legs, broken edges
    # A sunk panel, a grip or a notch in the front; none in most.
    assert 0.15 < share(lambda m: m.parts[1][0].hole is not None) < 0.6
    # A desk or a compartment beside the drawers: these are off the middle.
    aside = share(lambda m: abs(m.pivot[0, 0]) > 0.05)
    assert 0.02 < aside < 0.2


def test_instances_stay_cheap(models):
    assert max(sum(map(len, model.parts)) for model in models) <= 35
    assert np.mean([sum(map(len, model.parts)) for model in models]) < 26
