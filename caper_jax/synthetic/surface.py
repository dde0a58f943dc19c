"""Points on the surface of solids, for layouts that describe objects by points."""

from __future__ import annotations

import itertools

import numpy as np

from caper_jax.geometry.solids import Solid, corners_after_cut

_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def surface_points(solids: list[Solid], count: int, rng: np.random.Generator) -> np.ndarray:
    """Points on a union of solids that reach its exact bounds.

    Args:
      solids: one part's.
      count: random points, shared among the solids by the area of their boxes; those that fall in
        a solid's hole are left out.
      rng: draws them.

    Returns:
      [n, 3] meters: the random points, then the outermost ones of every solid.
    """
    areas = np.array([(s.half * np.roll(s.half, 1)).sum() for s in solids])
    clouds = []
    for solid, number in zip(solids, rng.multinomial(count, areas / areas.sum()), strict=True):
        unit = _taper(solid, _random_unit(solid, number, rng))
        points = solid.center + (unit * solid.half) @ solid.rotation.T
        clouds.append(points if solid.hole is None else points[~_inside(solid.hole, points)])
    return np.concatenate([*clouds, *(_outermost(solid) for solid in solids)])


def _outermost(solid: Solid) -> np.ndarray:
    """The points of a solid, its hole cut away, that give its bounds."""
    points = _extremes(solid)
    if solid.hole is None:
        return points
    cut = _inside(solid.hole, points)
    return np.concatenate([points[~cut], corners_after_cut(solid)]) if cut.any() else points


def _random_unit(solid: Solid, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points [count, 3] on the unit solid before it is tapered."""
    if solid.kind == "ellipsoid":
        unit = rng.normal(size=(count, 3))
        return unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    unit = rng.uniform(-1.0, 1.0, (count, 3))
    if solid.kind in ("box", "frustum"):
        half = solid.half
        pair = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
        face = rng.choice(3, count, p=pair / pair.sum())
        unit[np.arange(count), face] = rng.choice((-1.0, 1.0), count)
        return unit
    angle = rng.uniform(0.0, 2 * np.pi, count)
    radius_x, radius_y, height = solid.half
    cap = rng.random(count) < radius_x * radius_y / (
        radius_x * radius_y + height * (radius_x + radius_y)
    )
    radius = np.where(cap, np.sqrt(rng.random(count)), 1.0)
    z = np.where(cap, np.sign(unit[:, 2]), unit[:, 2])
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


def _taper(solid: Solid, unit: np.ndarray) -> np.ndarray:
    """x and y shrunk along z, as in frusta and cones."""
    share = (unit[:, 2:] + 1) / 2
    scale = 1 + share * (np.array(solid.taper) - 1)
    return np.concatenate([unit[:, :2] * scale, unit[:, 2:]], axis=-1)


def _inside(solid: Solid, points: np.ndarray) -> np.ndarray:
    """[n] bool: strictly inside the solid."""
    unit = (points - solid.center) @ solid.rotation / solid.half
    if solid.kind == "ellipsoid":
        return (unit**2).sum(-1) < 1
    share = np.clip((unit[:, 2:] + 1) / 2, 0, 1)
    flat = unit[:, :2] / (1 + share * (np.array(solid.taper) - 1))
    if solid.kind in ("box", "frustum"):
        return (np.abs(flat).max(-1) < 1) & (np.abs(unit[:, 2]) < 1)
    return ((flat**2).sum(-1) < 1) & (np.abs(unit[:, 2]) < 1)


def _extremes(solid: Solid) -> np.ndarray:
    """Points of the solid without its hole, farthest along and against every coordinate axis."""
    if solid.kind in ("box", "frustum"):
        unit = _taper(solid, _CORNERS)
    else:
        # Directions of the coordinate axes in the frame of the unit solid, times its radii.
        reach = solid.rotation * solid.half
        if solid.kind == "ellipsoid":
            unit = reach / np.linalg.norm(reach, axis=-1, keepdims=True)
            unit = np.concatenate([unit, -unit])
        else:
            flat = reach[:, :2] / np.maximum(np.linalg.norm(reach[:, :2], axis=-1), 1e-12)[:, None]
            flat = np.concatenate([flat, -flat])
            ends = [np.concatenate([flat, np.full((6, 1), z)], axis=-1) for z in (-1.0, 1.0)]
            unit = _taper(solid, np.concatenate(ends))
    return solid.center + (unit * solid.half) @ solid.rotation.T
