"""Dishwashers: conventions, a door that closes the opening, real sizes and their variety."""

from __future__ import annotations

import numpy as np
import pytest
from _helpers import shapes
from _helpers.shapes import boxes, moved
from _helpers.solid_points import deepest_overlap, inside

from caper_jax.categories.dishwasher import DISHWASHER
from caper_jax.synthetic.instances import draw_instances

CLOSE = 40  # instances of the tests that look at points
SHUT = -np.pi / 2


@pytest.fixture(scope="module")
def models():
    return draw_instances(DISHWASHER, 200, "test", 0)


def front(model) -> float:
    """z of the opening: the front of the tub, the body's first solid."""
    return model.parts[0][0].extent()[1][2]


def corners(model, part: int, state: float) -> np.ndarray:
    """[N, 3] corners of the solids of a part, the door's moved from rest to ``state``."""
    points = shapes.corners(model.parts[part])
    return moved(points, shapes.motion(model, 0, state)) if part else points


def test_the_door_rests_open_and_lies_flat_in_front(models):
    for model in models:
        body, door = boxes(model)
        size = door[1] - door[0]
        assert size[1] < 0.5 * size[2]  # horizontal
        assert door.mean(0)[2] > front(model) and door.mean(0)[1] < body.mean(0)[1]
        assert body[0, 1] < door[0, 1]  # above the floor
        np.testing.assert_allclose(model.limits, [[SHUT, 0]])


def test_positive_opens(models):
    for model in models:
        np.testing.assert_array_equal(model.axis, [[1, 0, 0]])
        body = boxes(model)[0]
        shut = corners(model, 1, SHUT)
        tip = shut[shut[:, 1].argmax()]
        # Shut, the door stands upright in front of the tub and below the top of the body.
        assert np.ptp(shut[:, 1]) > 0.5 * np.ptp(body[:, 1])
        assert front(model) - 0.06 < shut[:, 2].min() and shut[:, 2].max() < front(model) + 0.16
        assert tip[1] < body[1, 1]
        ajar = moved(tip, shapes.motion(model, 0, 0.1))
        assert ajar[2] > tip[2] + 0.02  # swings to the front
        assert moved(tip, shapes.motion(model, 0, np.pi / 2))[1] < tip[1] - 0.2  # and down


def test_the_shut_door_closes_the_opening(models):
    rng = np.random.default_rng(0)
    for model in models[:CLOSE]:
        tub, hole = model.parts[0][0].extent(), model.parts[0][0].hole.extent()
        low, high = np.maximum(tub[0], hole[0]), np.minimum(tub[1], hole[1])
        if hole[1][1] > tub[1][1]:  # open above: stretchers frame the opening
            high[1] = model.parts[0][1].extent()[0][1]
        points = rng.uniform(low, high, size=(500, 3))
        points[:, 2] = front(model) + 0.004  # just within the door's plate
        at_rest = moved(points, shapes.motion(model, 0, np.pi / 2))
        covered = np.any([inside(solid, at_rest) for solid in model.parts[1]], axis=0)
        assert covered.mean() > 0.99


def test_the_hinge_is_where_both_parts_meet(models):
    for model in models:
        _, y, z = model.pivot[0]
        tub = model.parts[0][0].extent()
        assert -0.045 < z - front(model) < 0.06
        assert tub[0][1] - 0.05 < y < tub[0][1] + 0.35 * (tub[1][1] - tub[0][1])
        shut = corners(model, 1, SHUT)
        assert abs(shut[:, 1].min() - y) < 0.1  # the lower edge of the door


def test_tubs_are_hollow(models):
    for model in models[:CLOSE]:
        tub = model.parts[0][0]
        low, high = tub.hole.extent()
        room = np.minimum(high, tub.extent()[1]) - low
        outer = np.subtract(*tub.extent()[::-1])
        assert (room[[0, 2]] > 0.75 * outer[[0, 2]]).all() and room[1] > 0.6 * outer[1]
        # The highest third is free of racks and crockery in many places.
        x, z = np.meshgrid(np.linspace(0.1, 0.9, 9), np.linspace(0.1, 0.9, 9))
        points = low + np.stack([x.ravel(), np.full(81, 0.72), z.ravel()], -1) * room
        full = np.any([inside(solid, points) for solid in model.parts[0]], axis=0)
        assert full.mean() < 0.4


def test_the_door_passes_the_body_on_its_way(models):
    rng = np.random.default_rng(0)
    for model in models[:CLOSE]:
        body, door = model.parts
        for state in np.radians((-90, -88, -80, -65, -40, 0)):
            assert deepest_overlap(rng, door, body, shapes.motion(model, 0, state)) < 5e-4
            assert corners(model, 1, state)[:, 1].min() > boxes(model)[0, 0, 1] - 1e-6


def test_sizes_are_real(models):
    size = np.array([np.ptp(boxes(model)[0], axis=0) for model in models])
    width, height, depth = size.T
    assert width.min() > 0.38 and width.max() < 0.72
    assert height.min() > 0.36 and height.max() < 0.96
    assert depth.min() > 0.38 and depth.max() < 0.78
    slim, low = width < 0.49, height < 0.56
    assert 0.1 < (slim & ~low).mean() < 0.45 and 0.05 < low.mean() < 0.3
    thickness = [np.ptp(corners(model, 1, SHUT)[:, 2]) for model in models]
    assert min(thickness) < 0.05 and max(thickness) > 0.09


def test_every_kind_of_dishwasher_occurs(models):
    def share(condition) -> float:
        return np.mean([condition(model) for model in models])

    def open_trays(model) -> int:
        return sum(solid.hole is not None for solid in model.parts[0][1:])

    def feet(model) -> int:
        """Solids that stand on the floor."""
        floor = boxes(model)[0, 0, 1]
        return sum(solid.extent()[0][1] < floor + 1e-6 for solid in model.parts[0])

    def reach(model) -> float:
        """How far the door's inner panel reaches into the tub."""
        return front(model) - corners(model, 1, SHUT)[:, 2].min()

    def strip(model) -> bool:
        """A control strip on the body, in front of the tub and above the door."""
        top = corners(model, 1, SHUT)[:, 1].max()
        return any(
            solid.extent()[0][2] > front(model) - 1e-9 and solid.extent()[0][1] > top
            for solid in model.parts[0]
        )

    for count in (0, 1, 2, 3):
        assert share(lambda m, n=count: open_trays(m) == n) > 0.02
    assert share(lambda m: feet(m) == 1) > 0.2  # a plinth
    assert share(lambda m: feet(m) >= 4) > 0.2  # feet
    assert share(lambda m: reach(m) < 0) > 0.01  # flat inside
    assert share(lambda m: reach(m) > 0.015) > 0.3  # a plug
    assert 0.1 < share(strip) < 0.45
    assert share(lambda m: m.parts[0][0].hole.extent()[1][1] > m.parts[0][0].extent()[1][1]) > 0.01
    assert share(lambda m: m.parts[0][0].hole.extent()[0][2] < boxes(m)[0, 0, 2]) > 0.01
    crockery = share(
        lambda m: any(s.kind in ("cylinder", "ellipsoid") and s.half[2] < 0.008 for s in m.parts[0])
    )
    assert 0.2 < crockery < 0.8
    hinged_behind = share(lambda m: m.pivot[0, 2] < front(m))
    assert 0.1 < hinged_behind < 0.6
    for kind in ("cylinder", "ellipsoid", "frustum"):
        assert share(lambda m, kind=kind: any(s.kind == kind for s in m.parts[1])) > 0.04
    assert share(lambda m: m.parts[1][0].hole is not None) > 0.05  # sunk panel or pocket
