"""Fine meshes of the generator's solids, for comparison with an independent ray caster."""

from __future__ import annotations

import trimesh

from caper_jax.geometry.solids import Solid
from caper_jax.synthetic import urdf_export

SECTIONS = 512  # of a circle


def part_mesh(solids: list[Solid]) -> trimesh.Trimesh:
    """One mesh of a part: its solids side by side (the caster too takes the nearest hit)."""
    return urdf_export.part_mesh(solids, SECTIONS)
