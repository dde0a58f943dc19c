"""Forms shared by categories: rotations against SciPy, moved solids point by point."""

from __future__ import annotations

import numpy as np
import pytest
from _helpers.solid_points import inside, loose
from scipy.spatial.transform import Rotation

from caper_jax.categories.forms import about, along, beam, chain, mirrored, rotated
from caper_jax.geometry.solids import bounds, box, cone, cylinder, ellipsoid, frustum

RNG = np.random.default_rng(0)
TILT = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
CENTER, HALF = (0.1, -0.2, 0.3), (0.5, 0.2, 0.7)
SOLIDS = [
    box(CENTER, HALF, TILT, hole=cylinder((0.1, -0.2, 0.5), (0.2, 0.1, 0.6), TILT)),
    cylinder(CENTER, HALF, TILT),
    ellipsoid(CENTER, HALF, TILT),
    frustum(CENTER, HALF, (0.3, 0.8), TILT),
    cone(CENTER, HALF, 0.4, TILT),
]
POINTS = RNG.uniform(-1, 1, (4000, 3))


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_about_is_right_handed(axis):
    expected = Rotation.from_euler(axis, 0.7).as_matrix()
    np.testing.assert_allclose(about(axis, 0.7), expected, atol=1e-15)


def test_along_points_z_and_keeps_y_near_up():
    for direction, up in RNG.normal(size=(50, 2, 3)):
        rotation = along(direction, up)
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        np.testing.assert_allclose(rotation[:, 2] * np.linalg.norm(direction), direction)
        # Of all directions across, y is nearest to up: up has no part along x, and y is not down.
        assert rotation[:, 0] @ up == pytest.approx(0.0, abs=1e-12)
        assert rotation[:, 1] @ up > 0


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.kind)
def test_turned_solids_hold_the_turned_points(solid):
    turn, pivot = about("y", 1.1), np.array([0.2, 0.1, -0.3])
    hit = inside(solid, POINTS)
    assert 50 < hit.sum() < 3900
    moved = (POINTS - pivot) @ turn.T + pivot
    np.testing.assert_array_equal(inside(rotated(solid, turn, pivot), moved), hit)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.kind)
def test_mirrored_solids_hold_the_mirrored_points(solid, axis):
    flip = np.where(np.arange(3) == "xyz".index(axis), -1.0, 1.0)
    other = mirrored(solid, axis)
    assert np.linalg.det(other.rotation) == pytest.approx(1.0)
    np.testing.assert_array_equal(inside(other, POINTS * flip), inside(solid, POINTS))


@pytest.mark.parametrize(
    ("taper", "round_", "kind"),
    [
        (None, False, "box"),
        (None, True, "cylinder"),
        ((0.5, 1.0), False, "frustum"),
        (0.5, False, "frustum"),
        (0.5, True, "cone"),
    ],
)
def test_beams_reach_from_start_to_end(taper, round_, kind):
    start, end = np.array([0.2, 0.0, 0.1]), np.array([0.2, 0.0, 1.1])
    solid = beam(start, end, (0.05, 0.02), (0.0, 1.0, 0.0), taper, round_)
    assert solid.kind == kind
    low, high = bounds([solid])
    np.testing.assert_allclose(low, (0.15, -0.02, 0.1), atol=1e-12)
    np.testing.assert_allclose(high, (0.25, 0.02, 1.1), atol=1e-12)
    at_end = np.array([[0.24, 0.0, 1.09], [0.22, 0.0, 1.09]])
    np.testing.assert_array_equal(inside(solid, at_end), [taper is None, True])


@pytest.mark.parametrize("closed", [False, True])
def test_chains_follow_their_points_without_gaps(closed):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    solids = list(chain(points, (0.1, 0.05), (0.0, 0.0, 1.0), closed))
    assert len(solids) == (4 if closed else 3) and not loose(solids)
    np.testing.assert_allclose(bounds(solids)[0][2], -0.05)
    middles = (points + np.roll(points, -1, axis=0)) / 2
    hit = np.any([inside(solid, middles) for solid in solids], axis=0)
    np.testing.assert_array_equal(hit, [True, True, True, closed])
