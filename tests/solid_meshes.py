"""Watertight meshes of the generator's solids, for comparison with an independent ray caster."""

from __future__ import annotations

import manifold3d
import numpy as np
import trimesh

from caper_jax.geometry.solids import Solid

SECTIONS = 512  # of a circle


def _unit(solid: Solid) -> manifold3d.Manifold:
    if solid.kind == "box":
        return manifold3d.Manifold.cube((2, 2, 2), center=True)
    if solid.kind == "ellipsoid":
        return manifold3d.Manifold.sphere(1, SECTIONS)
    if solid.kind == "frustum":
        square = manifold3d.CrossSection.square((2, 2), center=True)
        return square.extrude(2, scale_top=solid.taper).translate((0, 0, -1))
    return manifold3d.Manifold.cylinder(2, 1, solid.taper[0], SECTIONS, center=True)


def _manifold(solid: Solid) -> manifold3d.Manifold:
    affine = np.concatenate([solid.rotation * solid.half, solid.center[:, None]], axis=1)
    shape = _unit(solid).transform(affine)
    return shape if solid.hole is None else shape - _manifold(solid.hole)


def part_mesh(solids: list[Solid]) -> trimesh.Trimesh:
    """One mesh of a part: its solids side by side (the caster too takes the nearest hit)."""
    meshes = []
    for solid in solids:
        mesh = _manifold(solid).to_mesh()
        meshes.append(trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False))
    return trimesh.util.concatenate(meshes)
