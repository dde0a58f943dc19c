"""Points in solids, by the definition of the unit solids: an oracle for what touches what."""

from __future__ import annotations

import numpy as np

from caper_jax.geometry.solids import Solid


def _depth(solid: Solid, points: np.ndarray) -> np.ndarray:
    """[N] least distance, in meters, from points [N, 3] to the faces of a solid without its hole.

    Negative outside; for slanted and curved faces a value of that order.
    """
    local = (points - solid.center) @ solid.rotation / solid.half
    shrink = 1 + (np.array(solid.taper) - 1) * (local[:, 2:] + 1) / 2
    across = np.abs(local[:, :2]) / np.maximum(shrink, 1e-9)
    if solid.kind == "ellipsoid":
        return (1 - np.linalg.norm(local, axis=1)) * solid.half.min()
    if solid.kind in ("cylinder", "cone"):
        side = (1 - np.linalg.norm(across, axis=1)) * solid.half[:2].min()
    else:
        side = ((1 - across) * solid.half[:2]).min(1)
    return np.minimum(side, (1 - np.abs(local[:, 2])) * solid.half[2])


def inside(solid: Solid, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """[N] bool: points [N, 3] in the solid, at least ``margin`` meters below its surface."""
    within = _depth(solid, points) > margin
    if solid.hole is not None:
        within &= _depth(solid.hole, points) < -margin
    return within


def deepest_overlap(
    rng: np.random.Generator, moving: list[Solid], fixed: list[Solid], pose: np.ndarray
) -> float:
    """How deep, in meters, points of ``moving`` under ``pose`` [4, 4] lie in ``fixed``.

    0 when none does. The points are sampled on surfaces, with all corners of boxes.
    """
    points = np.concatenate(
        [_surface(rng, solid, 300) for solid in moving]
        + [solid.corners() for solid in moving if solid.kind == "box"]
    )
    points = points[np.any([inside(solid, points, -1e-6) for solid in moving], axis=0)]
    points = points @ pose[:3, :3].T + pose[:3, 3]
    worst = 0.0
    for solid in fixed:
        depth = _depth(solid, points)
        if solid.hole is not None:
            depth = np.minimum(depth, -_depth(solid.hole, points))
        worst = max(worst, float(depth.max()))
    return worst


def loose(solids: list[Solid], slack: float = 1e-3) -> list[int]:
    """Indices of the solids that no chain of others, each within ``slack`` meters, holds to the
    first.
    """
    rng = np.random.default_rng(0)
    extents = [np.array(solid.extent()) for solid in solids]
    surfaces = [_surface(rng, solid, 1500) for solid in solids]

    def touch(one: int, other: int) -> bool:
        low = np.maximum(extents[one][0], extents[other][0]) - slack
        high = np.minimum(extents[one][1], extents[other][1]) + slack
        points = np.concatenate([surfaces[one], surfaces[other]])
        points = points[((points >= low) & (points <= high)).all(1)]
        for solid in (solids[one], solids[other]):
            points = points[_depth(solid, points) > -slack]
            if solid.hole is not None:
                points = points[_depth(solid.hole, points) < slack]
        return len(points) > 0

    rest, reached = set(range(1, len(solids))), [0]
    while reached and rest:
        reached = [index for index in rest if any(touch(index, other) for other in reached)]
        rest.difference_update(reached)
    return sorted(rest)


def _surface(rng: np.random.Generator, solid: Solid, count: int) -> np.ndarray:
    """[N, 3] points on a solid without its hole, and on the hole."""
    unit = rng.uniform(-1, 1, size=(count, 3))
    across = np.abs(unit[:, :2])
    if solid.kind == "ellipsoid":
        gauge = np.linalg.norm(unit, axis=1)
    else:
        round_ = solid.kind in ("cylinder", "cone")
        across = np.linalg.norm(across, axis=1) if round_ else across.max(1)
        gauge = np.maximum(across, np.abs(unit[:, 2]))
    unit /= gauge[:, None]
    unit[:, :2] *= 1 + (np.array(solid.taper) - 1) * (unit[:, 2:] + 1) / 2
    points = solid.center + (unit * solid.half) @ solid.rotation.T
    if solid.hole is None:
        return points
    return np.concatenate([points, _surface(rng, solid.hole, count)])
