"""Surfaces of solids: what is refused, how far they reach, and points on them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.errors import CaperError
from caper_jax.geometry.solid_surface import surface_points
from caper_jax.geometry.solids import Solid, bounds, box, cone, cylinder, ellipsoid, frustum
from caper_jax.synthetic.instances import draw_instances

KINDS = ("box", "cylinder", "ellipsoid", "frustum", "cone")


def random_solid(rng: np.random.Generator, kind: str, center, scale: float) -> Solid:
    """Half extents of 5 to 100 % of ``scale``, meters, turned at random."""
    half = scale * rng.uniform(0.05, 1.0, 3)
    rotation = Rotation.random(rng=rng).as_matrix()
    if kind == "frustum":
        return frustum(center, half, rng.uniform(0.1, 1.0, 2), rotation)
    if kind == "cone":
        return cone(center, half, rng.uniform(0.1, 1.0), rotation)
    make = {"box": box, "cylinder": cylinder, "ellipsoid": ellipsoid}[kind]
    return make(center, half, rotation)


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_are_reached_and_not_exceeded(kind):
    """Against many points of the unit solid's surface."""
    rng = np.random.default_rng(3)
    unit = rng.uniform(-1, 1, (200_000, 3))
    unit[:100_000, 2] = np.sign(unit[:100_000, 2])
    for _ in range(5):
        solid = random_solid(rng, kind, rng.uniform(-1, 1, 3), 0.5)
        wide = 1 + (np.array(solid.taper) - 1) * (unit[:, 2:] + 1) / 2
        points = unit.copy()
        if kind == "ellipsoid":
            points /= np.linalg.norm(points, axis=1, keepdims=True)
        elif kind in ("box", "frustum"):
            points[:, :2] = np.sign(points[:, :2]) * wide
        else:
            points[:, :2] *= wide / np.linalg.norm(points[:, :2], axis=1, keepdims=True)
        points = solid.center + points * solid.half @ solid.rotation.T
        low, high = solid.extent()
        np.testing.assert_allclose(points.min(0), low, atol=1e-3)
        np.testing.assert_allclose(points.max(0), high, atol=1e-3)
        assert (points >= low - 1e-12).all() and (points <= high + 1e-12).all()


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: box((0, 0, 0), (1, 0, 1)), "positive"),
        (lambda: cylinder((0, 0), (1, 1, 1)), "center"),
        (lambda: ellipsoid((0, 0, 0), (1, np.nan, 1)), "half"),
        (lambda: box((0, 0, 0), (1, 1, 1), np.eye(2)), "rotation"),
        (lambda: frustum((0, 0, 0), (1, 1, 1), (0.5, 1.2)), "taper"),
        (lambda: frustum((0, 0, 0), (1, 1, 1), 0.5), "2 numbers"),
        (lambda: cone((0, 0, 0), (1, 1, 1), 0.0), "taper"),
    ],
)
def test_impossible_solids_are_refused(make, match):
    with pytest.raises(CaperError, match=match):
        make()


@pytest.mark.parametrize("name", categories.names())
def test_surface_points_reach_the_bounds_and_lie_within(name):
    for model in draw_instances(categories.get(name), 5, "train", 1):
        for solids in model.parts:
            points = surface_points(solids, 300, np.random.default_rng(0))
            low, high = bounds(solids)
            np.testing.assert_allclose(points.min(0), low, atol=1e-12)
            np.testing.assert_allclose(points.max(0), high, atol=1e-12)
