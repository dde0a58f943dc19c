"""Fine meshes of the generator's solids, for comparison with an independent ray caster."""

from __future__ import annotations

import numpy as np
import trimesh

from caper_jax.articulation.category import Category, ObjectModel
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.geometry.meshes import Mesh
from caper_jax.geometry.solids import Solid
from caper_jax.synthetic import urdf_export

SECTIONS = 512  # of a circle


def part_mesh(solids: list[Solid]) -> trimesh.Trimesh:
    """One mesh of a part: its solids side by side (the caster too takes the nearest hit)."""
    return urdf_export.part_mesh(solids, SECTIONS)


def mesh_object(model: ObjectModel, category: Category) -> MeshObject:
    """A generated object at rest, as meshes."""
    meshes = [part_mesh(solids) for solids in model.parts]
    parts = tuple(Mesh(np.asarray(m.vertices, float), np.asarray(m.faces)) for m in meshes)
    return MeshObject(
        parts, category.joint_types, category.parents, model.axis, model.pivot, model.limits
    )
