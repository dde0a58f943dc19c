"""Generated objects as URDF files with OBJ meshes, for simulators and other programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from caper_jax.articulation.category import Category, ObjectModel
from caper_jax.articulation.shapes import centered
from caper_jax.errors import CaperError
from caper_jax.files import write_atomically
from caper_jax.geometry.meshes import NEEDS_MESH
from caper_jax.geometry.solids import Solid

SECTIONS = 96  # of a circle
URDF_FILE = "mobility.urdf"  # its name in PartNet-Mobility


def _manifold3d() -> Any:
    try:
        import manifold3d
    except ImportError:
        raise CaperError(f"a mesh of a generated object {NEEDS_MESH}") from None
    return manifold3d


def _circle(axes: np.ndarray, sections: int) -> np.ndarray:
    """[V, 2] points of the unit circle, those farthest along x, y and z included.

    Args:
      axes: [3, 2] images of the circle's own axes.
      sections: points besides these.
    """
    farthest = np.arctan2(axes[:, 1], axes[:, 0])
    even = np.arange(sections) * (2 * np.pi / sections)
    angles = np.sort(np.concatenate([even, farthest, farthest + np.pi]) % (2 * np.pi))
    angles = angles[np.diff(angles, append=angles[0] + 2 * np.pi) > 1e-6]
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _shape(solid: Solid, sections: int) -> Any:
    """The solid, its hole cut away, as a manifold3d.Manifold."""
    manifold3d = _manifold3d()
    axes = solid.rotation * solid.half
    if solid.kind == "ellipsoid":
        sphere = manifold3d.Manifold.sphere(1, sections).to_mesh64().vert_properties[:, :3]
        farthest = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        unit = manifold3d.Manifold.hull_points(np.concatenate([sphere, farthest, -farthest]))
    else:
        if solid.kind in ("box", "frustum"):
            outline = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        else:
            outline = _circle(axes[:, :2], sections)
        section = manifold3d.CrossSection([outline])
        unit = section.extrude(2, scale_top=solid.taper).translate((0, 0, -1))
    shape = unit.transform(np.concatenate([axes, solid.center[:, None]], axis=1))
    return shape if solid.hole is None else shape - _shape(solid.hole, sections)


def part_mesh(solids: list[Solid], sections: int = SECTIONS, united: bool = False) -> Any:
    """The surface of a part, in meters, in the frame of its solids.

    Args:
      solids: at least one.
      sections: of a full circle; edges lie on the true surface.
      united: one surface around all solids; else each solid has its own, watertight too.

    Returns:
      A trimesh.Trimesh; its box is the solids' own (where no hole cuts the outermost points).

    Raises:
      CaperError: manifold3d is not installed, or nothing is left of the solids.
    """
    import trimesh

    manifold3d = _manifold3d()
    shapes = [_shape(solid, sections) for solid in solids]
    if united:
        shapes = [manifold3d.Manifold.batch_boolean(shapes, manifold3d.OpType.Add)]
    meshes = [shape.to_mesh64() for shape in shapes if not shape.is_empty()]
    if not meshes:
        raise CaperError("a part without solids, or with holes as large as they are, has no mesh")
    return trimesh.util.concatenate(
        [
            trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False)
            for mesh in meshes
        ]
    )


def write_urdf(
    folder: str | Path,
    model: ObjectModel,
    category: Category,
    name: str,
    sections: int = SECTIONS,
    overwrite: bool = False,
) -> Path:
    """Writes an object as ``mobility.urdf`` with one link, and ``meshes/<part>.obj``, per part.

    With all joints at zero the object is in its rest pose, and the frame of the base link is the
    canonical frame: y up, origin at the center of the whole object's box at rest (not the z-up
    frame usual in robotics). Every mesh is written in that frame; the frame of another link sits
    on its joint's pivot with the same axes. URDF counts in meters and radians.

    Args:
      folder: made if need be.
      model: the object; it is centered here.
      category: names its parts and says how they hang together.
      name: of the robot in the file.
      sections: of a full circle.
      overwrite: replace an object written there before.

    Returns:
      Path of the URDF. It is written last: where it is, the meshes are complete.

    Raises:
      CaperError: an object there already, a model that does not fit the category, or packages for
        meshes that are not installed.
    """
    folder = Path(folder)
    path = folder / URDF_FILE
    if path.exists() and not overwrite:
        raise CaperError(f"{path} exists; choose another folder, or overwrite it explicitly")
    if len(model.parts) != category.num_parts or len(model.axis) != category.num_joints:
        raise CaperError(
            f"category {category.name!r} has {category.num_parts} parts and "
            f"{category.num_joints} joints, the model {len(model.parts)} and {len(model.axis)}"
        )
    model = centered(model)
    links = [re.sub(r"[^\w.+-]+", "_", part) for part in category.parts]
    pivots = np.concatenate([np.zeros((1, 3)), model.pivot])
    robot = ElementTree.Element("robot", name=name)
    meshes = {}
    for link, solids, pivot in zip(links, model.parts, pivots, strict=True):
        file = f"meshes/{link}.obj"
        meshes[file] = _obj(part_mesh(solids, sections, united=True))
        element = ElementTree.SubElement(robot, "link", name=link)
        for use in ("visual", "collision"):
            shape = ElementTree.SubElement(element, use)
            ElementTree.SubElement(shape, "origin", xyz=_text(-pivot), rpy="0 0 0")
            geometry = ElementTree.SubElement(shape, "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=file)
    for child, joint in enumerate(category.joints, start=1):
        element = ElementTree.SubElement(
            robot, "joint", name=f"{links[child]}_joint", type=joint.type
        )
        ElementTree.SubElement(element, "parent", link=links[joint.parent])
        ElementTree.SubElement(element, "child", link=links[child])
        origin = pivots[child] - pivots[joint.parent]
        ElementTree.SubElement(element, "origin", xyz=_text(origin), rpy="0 0 0")
        axis = model.axis[child - 1]
        ElementTree.SubElement(element, "axis", xyz=_text(axis / np.linalg.norm(axis)))
        low, high = (_text([limit]) for limit in model.limits[child - 1])
        # Effort and velocity are required by the format; the generator knows none.
        ElementTree.SubElement(element, "limit", lower=low, upper=high, effort="100", velocity="10")
    ElementTree.indent(robot)
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    for file, content in meshes.items():
        write_atomically(folder / file, content)
    write_atomically(path, ElementTree.tostring(robot, "utf-8", xml_declaration=True) + b"\n")
    return path


def _text(values) -> str:
    return " ".join(f"{value + 0.0:.12g}" for value in values)


def _obj(mesh: Any) -> bytes:
    lines = [f"v {_text(vertex)}" for vertex in mesh.vertices]
    lines += ["f {} {} {}".format(*(face + 1)) for face in mesh.faces]
    return ("\n".join(lines) + "\n").encode()
