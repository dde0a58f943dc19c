"""Watertight meshes of the generator's solids, for comparison with an independent ray caster."""

from __future__ import annotations

import manifold3d
import numpy as np
import trimesh

from caper_jax.geometry.solids import Solid

SECTIONS = 512  # of a circle


def _manifold(solid: Solid) -> manifold3d.Manifold:
    if solid.kind == "box":
        unit = manifold3d.Manifold.cube((2, 2, 2), center=True)
    else:
        unit = manifold3d.Manifold.cylinder(2, 1, 1, SECTIONS, center=True)
    affine = np.concatenate([solid.rotation * solid.half, solid.center[:, None]], axis=1)
    shape = unit.transform(affine)
    return shape if solid.hole is None else shape - _manifold(solid.hole)


def part_mesh(solids: list[Solid]) -> trimesh.Trimesh:
    """One mesh of a part: its solids side by side (the caster too takes the nearest hit)."""
    meshes = []
    for solid in solids:
        mesh = _manifold(solid).to_mesh()
        meshes.append(trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False))
    return trimesh.util.concatenate(meshes)
