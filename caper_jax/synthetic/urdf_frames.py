"""Labeled frames of imported objects: rays into meshes by Embree, the rest as generated ones.

Cameras, joint states, ray grid, sensor noise and the choice of points are those of
``synthetic``; only the caster differs. Every part is a scene of its own in its rest frame,
into which the rays are moved; the nearest hit of all parts counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from caper_jax.articulation.category import Category
from caper_jax.data.types import Batch
from caper_jax.data.urdf import ImportedObject
from caper_jax.errors import CaperError
from caper_jax.geometry.meshes import NEEDS_MESH, Mesh
from caper_jax.geometry.raster_order import grid_raster_order
from caper_jax.synthetic import sensor as sensors
from caper_jax.synthetic.frames import FrameKeys, articulated_pose, draw_state_and_poses
from caper_jax.synthetic.instances import InstanceBank, split_key


class PartCaster:
    """Casts rays at the parts of one object in any pose."""

    def __init__(self, parts: Sequence[Mesh]) -> None:
        """Builds one Embree scene per part.

        Args:
          parts: K meshes in their rest frames.

        Raises:
          CaperError: the packages for meshes are not installed.
        """
        try:
            import trimesh
            from trimesh.ray.ray_pyembree import RayMeshIntersector
        except ImportError:
            raise CaperError(f"rendering meshes {NEEDS_MESH}") from None
        self._corners = [part.vertices[part.faces] for part in parts]
        self._normals = [
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            for corners in self._corners
        ]
        meshes = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts]
        self._scenes = [RayMeshIntersector(mesh) for mesh in meshes]
        self._spheres = []
        for part in parts:
            middle = part.bounds().mean(0)
            radius = np.linalg.norm(part.vertices - middle, axis=-1).max()
            self._spheres.append((middle, 1.001 * radius))
        self.outlines = [_outline(mesh) for mesh in meshes]

    def cast(
        self,
        poses: Float[np.ndarray, "K 4 4"],
        origins: Float[np.ndarray, "R 3"],
        directions: Float[np.ndarray, "R 3"],
    ) -> tuple[Float[np.ndarray, "K R"], Int[np.ndarray, "K R"]]:
        """Where rays meet each part, were it alone.

        Args:
          poses: [K, 4, 4] part rest frame -> frame of the rays.
          origins, directions: [R, 3].

        Returns:
          [K, R] multiples of the direction, infinite without a hit (the depth, for directions
          with z = 1 from the camera), and [K, R] the triangle met, -1 for none.
        """
        reach = np.full((len(poses), len(directions)), np.inf)
        faces = np.full((len(poses), len(directions)), -1)
        for k, pose in enumerate(np.asarray(poses, np.float64)):
            start = (origins - pose[:3, 3]) @ pose[:3, :3]
            ray = directions @ pose[:3, :3]
            middle, radius = self._spheres[k]
            aside = np.cross(middle - start, ray)
            near = np.flatnonzero((aside**2).sum(-1) <= radius**2 * (ray**2).sum(-1))
            if not len(near):
                continue
            face = self._scenes[k].intersects_first(start[near], ray[near])
            hit, face = near[face >= 0], face[face >= 0]
            # Embree answers in float32; the plane of the triangle gives the place exactly.
            normal, corner = self._normals[k][face], self._corners[k][face, 0]
            with np.errstate(divide="ignore", invalid="ignore"):
                along = (normal * (corner - start[hit])).sum(-1) / (normal * ray[hit]).sum(-1)
            good = np.isfinite(along) & (along > 0)
            reach[k, hit[good]], faces[k, hit[good]] = along[good], face[good]
        return reach, faces

    def normals(
        self, part: int, faces: Int[np.ndarray, " R"], pose: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "R 3"]:
        """Unit normals [R, 3] of triangles of a part under a pose [4, 4], of either sign."""
        normal = self._normals[part][faces] @ pose[:3, :3].T
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _outline(mesh: Any) -> np.ndarray:
    """[V, 3] the corners of a mesh's convex hull; all vertices of a flat mesh, which has none."""
    try:
        return np.asarray(mesh.convex_hull.vertices)
    except (ImportError, ValueError, RuntimeError):
        return np.asarray(mesh.vertices)


def render_frames(
    objects: Sequence[ImportedObject],
    frames: int,
    *,
    noise: str = "kinect",
    num_points: int = 4096,
    grid: int = 128,
    split: str = "test",
    seed: int = 0,
    report: Callable[[int], None] = lambda count: None,
) -> Batch:
    """Frames of imported objects in turn, in random states before random cameras.

    Args:
      objects: at least one, all of one category.
      frames: F.
      noise: sensor preset.
      num_points: N points per frame.
      grid: rays per side over the object's projected box.
      split, seed: the same arguments give the same frames, see ``split_key``.
      report: called with the number of frames done since its last call.

    Returns:
      Batch of numpy arrays [F, ...]; ``instance`` numbers the objects.

    Raises:
      CaperError: unknown noise preset, or the packages for meshes are not installed.
    """
    category = objects[0].category
    mix = sensors.sensor_mix((noise,))
    casters = [PartCaster(item.at_rest.parts) for item in objects]
    instance = np.arange(frames) % len(objects)
    bank = _bank(objects)
    key = split_key(split, seed)
    frame_keys = jax.vmap(partial(jax.random.fold_in, key))(np.arange(frames))
    instances = jax.tree.map(lambda values: values[instance], bank)
    keys, *drawn = _draw(frame_keys, instances, category, num_points)
    states, poses, grid_offsets, picks = map(np.asarray, drawn)
    rows = []
    for index in range(frames):
        which = instance[index]
        caster = casters[which]
        rays = _ray_grid(caster.outlines, poses[index], grid_offsets[index], grid)
        rows.append(_observe(keys, index, caster, poses[index], rays, mix, picks[index]))
        report(1)
    points, labels, visible, visibility = (np.stack(column) for column in zip(*rows, strict=True))
    pose = articulated_pose(instances, states, poses)
    return Batch(points, labels, pose, visible, instance.astype(np.int32), visibility)


def _bank(objects: Sequence[ImportedObject]) -> InstanceBank:
    """Joints, boxes and ranges as the generator keeps them; the surfaces are in the casters."""

    def stack(rows: list[np.ndarray]) -> np.ndarray:
        return np.stack(rows).astype(np.float32)

    return InstanceBank(
        groups={},
        joint_axis=stack([item.at_rest.axis for item in objects]),
        joint_pivot=stack([item.at_rest.pivot for item in objects]),
        limits=stack([item.states for item in objects]),
        size=stack([item.size for item in objects]),
        box_center=stack([item.box_center for item in objects]),
    )


@partial(jax.jit, static_argnums=(2, 3))
def _draw(frame_keys, instances: InstanceBank, category: Category, num_points: int):
    """Keys, states [F, J], poses [F, K, 4, 4], and uniform numbers for the grid and the picks."""

    def one(key, instance):
        keys = FrameKeys(*jax.random.split(key, 8))
        state, poses, _ = draw_state_and_poses(keys.scene, instance, category)
        grid = jax.random.uniform(keys.grid, (2,))
        return keys, state, poses, grid, jax.random.uniform(keys.pick, (num_points,))

    return jax.vmap(one)(frame_keys, instances)


def _ray_grid(
    outlines: Sequence[np.ndarray], poses: np.ndarray, offset: np.ndarray, grid: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rays (x [G, G], y [G, G]) over the object's projection on the plane z = 1."""
    plane = []
    for outline, pose in zip(outlines, poses.astype(np.float64), strict=True):
        points = outline @ pose[:3, :3].T + pose[:3, 3]
        points = points[points[:, 2] > 0.01 * points[:, 2].max()]
        plane.append(points[:, :2] / points[:, 2:])
    corners = np.concatenate(plane)
    low, high = corners.min(0), corners.max(0)
    x, y = (low[a] + (np.arange(grid) + offset[a]) / grid * (high - low)[a] for a in (0, 1))
    return np.meshgrid(x, y, indexing="xy")


def _observe(
    keys: FrameKeys, frame: int, caster: PartCaster, poses: np.ndarray, rays, mix, pick: np.ndarray
):
    """Points [N, 3], labels [N], and pixels and unhidden share [K] of each part."""
    directions = np.stack([*rays, np.ones_like(rays[0])], axis=-1).reshape(-1, 3)
    reach, _ = caster.cast(poses, np.zeros_like(directions), directions)
    nearest = reach.min(0)
    hit = np.isfinite(nearest)
    part = np.where(hit, reach.argmin(0), -1)
    visible = np.array([np.count_nonzero(part == k) for k in range(len(poses))], np.int32)
    alone = np.isfinite(reach).sum(1)

    image = rays[0].shape
    depth = np.where(hit, nearest, 0.0).astype(np.float32).reshape(image)
    rays = tuple(ray.astype(np.float32) for ray in rays)
    sensor, surface, seen = _sense(keys, frame, mix, depth, hit.reshape(image), rays)
    shown = np.asarray(seen).ravel()
    order = grid_raster_order(image[0])
    found = order[(shown if shown.any() else hit)[order]]
    # Evenly spread in scan order, repeating when there are too few.
    index = found[((np.arange(len(pick)) + pick) * len(found) / len(pick)).astype(np.int64)]
    chosen = jax.tree.map(lambda values: np.asarray(values).ravel()[index], surface)
    points = _measure(keys, frame, sensor, chosen, (rays[0].ravel()[index], rays[1].ravel()[index]))
    return np.asarray(points), part[index].astype(np.int32), visible, visible / np.maximum(alone, 1)


@jax.jit
def _sense(keys: FrameKeys, frame, mix, depth, hit, rays):
    sensor = sensors.draw_sensor(keys.sensor[frame], mix)
    surface = sensors.surface_map(depth, hit, rays)
    return sensor, surface, sensors.valid_pixels(keys.loss[frame], sensor, surface, hit)


@jax.jit
def _measure(keys: FrameKeys, frame, sensor, chosen, rays):
    return sensors.measure(keys.noise[frame], sensor, chosen, rays)
