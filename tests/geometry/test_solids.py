"""Bounds of solids, with and without holes, against points, meshes and hand-computed values."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from _helpers import solid_points
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.errors import CaperError
from caper_jax.geometry.solids import (
    Solid,
    bounds,
    box,
    cone,
    cylinder,
    ellipsoid,
    frustum,
    surface_points,
)
from caper_jax.synthetic.instances import draw_instances

KINDS = ("box", "cylinder", "ellipsoid", "frustum", "cone")


def draw(rng: np.random.Generator, kind: str, scale: float, hole: Solid | None = None) -> Solid:
    """A solid of about ``scale`` meters near the origin, turned anyhow."""
    rotation = Rotation.random(rng=rng).as_matrix()
    center, half = scale * rng.uniform(-0.7, 0.7, 3), scale * rng.uniform(0.3, 1.0, 3)
    taper = tuple(rng.uniform(0.3, 1.0, 2)) if kind == "frustum" else (1.0, 1.0)
    if kind == "cone":
        taper = (rng.uniform(0.3, 1.0),) * 2
    return Solid(kind, center, half, rotation, hole, taper)


@pytest.mark.parametrize(("kind", "hole"), [*itertools.product(KINDS, KINDS)])
def test_what_a_hole_leaves(kind, hole):
    pytest.importorskip("manifold3d")
    from caper_jax.synthetic.urdf_export import part_mesh

    rng = np.random.default_rng(KINDS.index(kind) * 5 + KINDS.index(hole))
    cut = 0
    for _ in range(8):
        solid = draw(rng, kind, 0.2, draw(rng, hole, 0.25))
        try:
            low, high = bounds([solid])
        except CaperError:  # swallowed, but for slivers between a circle and its sections
            points = solid_points._surface(rng, dataclasses.replace(solid, hole=None), 2000)
            assert not solid_points.inside(solid, points, -1e-9).any()
            continue
        mesh = part_mesh([solid], sections=96)
        # Circles have 128 sections here and 96 in the mesh: a sliver of a millimeter.
        tolerance = 1e-9 if {kind, hole} <= {"box", "frustum"} else 1e-3
        np.testing.assert_allclose([low, high], mesh.bounds, rtol=0, atol=tolerance)
        cut += not np.allclose([low, high], solid.extent(), rtol=0, atol=5e-3)
    assert cut >= 2


def test_a_dome_reaches_down_to_its_cut():
    dome = cylinder((0, 0, 0), (0.1, 0.1, 0.2), hole=box((0, -0.5, 0), (1, 0.5, 1)))
    low, high = bounds([dome])
    np.testing.assert_allclose(low, [-0.1, 0, -0.2], atol=1e-12)
    np.testing.assert_allclose(high, [0.1, 0.1, 0.2], atol=1e-12)


@pytest.mark.parametrize(
    "solid",
    [
        box((0, 0, 0), (1, 1, 1), hole=box((0, 0.5, 0), (0.9, 1, 0.9))),  # a tray keeps its rim
        cylinder((0, 0, 0), (1, 2, 1), hole=cylinder((0, 0, 0), (0.9, 1.9, 2))),  # a ring
        ellipsoid((0, 0, 0), (1, 2, 3), hole=ellipsoid((0, 0, 0), (0.5, 0.5, 0.5))),
        frustum((0, 0, 0), (1, 1, 1), (0.5, 0.2), hole=cone((0, 0, 0.5), (0.1, 0.1, 1), 0.5)),
    ],
)
def test_holes_that_spare_the_outermost_points_change_nothing(solid):
    np.testing.assert_array_equal(bounds([solid]), solid.extent())


def test_a_hole_that_swallows_its_solid_is_an_error():
    with pytest.raises(CaperError, match=r"hole of a box at .* swallows all of it"):
        bounds([box((0, 0, 0), (1, 1, 1), hole=ellipsoid((0, 0, 0), (3, 3, 3)))])


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_are_reached_and_not_exceeded(kind):
    """Against many points of the unit solid's surface."""
    rng = np.random.default_rng(3)
    unit = rng.uniform(-1, 1, (200_000, 3))
    unit[:100_000, 2] = np.sign(unit[:100_000, 2])
    for _ in range(5):
        solid = draw(rng, kind, 0.5)
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
