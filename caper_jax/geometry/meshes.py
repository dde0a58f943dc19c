"""Triangle meshes as plain arrays, read from files or made from a URDF's simple shapes."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from caper_jax.errors import CaperError

SUFFIXES = (".obj", ".stl", ".dae", ".glb", ".gltf", ".ply", ".off")
NEEDS_MESH = "needs more packages: pip install 'caper-jax[mesh]'"


@dataclass(frozen=True)
class Mesh:
    """A surface.

    Attributes:
      vertices: [V, 3] meters, all in use.
      faces: [F, 3] indices of vertices.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def moved(self, pose: Float[np.ndarray, "4 4"]) -> Mesh:
        """This mesh under a pose [4, 4]."""
        return Mesh(self.vertices @ pose[:3, :3].T + pose[:3, 3], self.faces)

    def scaled(self, factor: float | Float[np.ndarray, " 3"]) -> Mesh:
        """This mesh with its coordinates multiplied by a factor or by factors [3]."""
        return Mesh(self.vertices * factor, self.faces)

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """[2, 3] lowest and highest corner of the axis-aligned box."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    def moments(self) -> tuple[float, Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """Area, mean [3] and second moments [3, 3] about the mean of the surface, exactly."""
        corners = self.vertices[self.faces]
        edges = corners[:, 1:] - corners[:, :1]
        areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1) / 2
        total = areas.sum()
        mean = np.einsum("f,fi->i", areas, corners.mean(1)) / total
        corners = corners - mean
        # The integral of x x^T over a triangle is area / 12 (sum_i v_i v_i^T + s s^T), with s the
        # sum of its corners.
        sums = corners.sum(1)
        second = np.einsum("f,fvi,fvj->ij", areas, corners, corners)
        second += np.einsum("f,fi,fj->ij", areas, sums, sums)
        return float(total), mean, second / (12 * total)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def read_mesh(path: Path) -> Mesh:
    """Reads a mesh file; all its pieces in one, triangles without area left out.

    A Collada file's unit is applied, its up axis is not (as ROS does).

    Raises:
      CaperError: a format or file that cannot be read, or a .dae file without pycollada.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise CaperError(f"{path}: meshes are read from {', '.join(SUFFIXES)}")
    import trimesh

    if path.suffix.lower() == ".dae" and importlib.util.find_spec("collada") is None:
        raise CaperError(f"{path}: reading .dae files needs pycollada: pip install pycollada")
    try:
        scene = trimesh.load_scene(path, process=False, skip_materials=True)
        surfaces = [
            geometry
            for geometry in scene.dump()
            if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)
        ]
    except Exception as error:
        # The readers of seven formats raise whatever they stumble over.
        raise CaperError(f"{path}: the mesh cannot be read ({error})") from error
    if not surfaces:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    mesh = join([_plain(surface.vertices, surface.faces) for surface in surfaces])
    if not np.isfinite(mesh.vertices).all():
        raise CaperError(f"{path}: the mesh has coordinates that are not finite")
    return mesh.scaled(_collada_unit(scene.units)) if path.suffix.lower() == ".dae" else mesh


def _collada_unit(text: Any) -> float:
    """Meters per unit of a Collada file, which trimesh reports as e.g. "0.01 * meters"."""
    factor, found, _ = str(text or "").partition("* meters")
    return float(factor) if found else 1.0


def _plain(vertices: Any, faces: Any) -> Mesh:
    """Without triangles that have no area, and vertices that no triangle has."""
    vertices = np.asarray(vertices, np.float64)
    faces = np.asarray(faces, np.int64)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    used, faces = np.unique(faces[(normals != 0).any(-1)], return_inverse=True)
    return Mesh(vertices[used], faces.reshape(-1, 3))


def primitive_mesh(kind: str, numbers: Sequence[float], where: str) -> Mesh:
    """A URDF box, cylinder (along z) or sphere, centered on its frame.

    Args:
      kind: the name of its element.
      numbers: lengths of a box, radius and length of a cylinder, or radius of a sphere; meters.
      where: the file and link, for errors.

    Raises:
      CaperError: another shape.
    """
    import trimesh

    if kind == "box":
        surface = trimesh.creation.box(extents=numbers)
    elif kind == "cylinder":
        radius, length = numbers
        surface = trimesh.creation.cylinder(radius, length, sections=96)
    elif kind == "sphere":
        surface = trimesh.creation.icosphere(subdivisions=4, radius=numbers[0])
    else:
        raise CaperError(f"{where}: <{kind}> is neither mesh, box, cylinder nor sphere")
    return _plain(surface.vertices, surface.faces)
