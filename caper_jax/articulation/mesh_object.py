"""An articulated object made of meshes: its parts and joints in one reference pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Shaped

from caper_jax.articulation.kinematics import (
    forward_kinematics_float64,
    joint_transform_float64,
)
from caper_jax.geometry.meshes import Mesh

_DIRECTIONS = 48  # of a half circle, over which widths are averaged


@dataclass(frozen=True)
class MeshObject:
    """Parts and joints in one frame that all parts share in the reference pose; meters.

    Attributes:
      parts: K meshes.
      kinds: J times "revolute" or "prismatic".
      parents: J parts; joint j carries part j + 1.
      axis: [J, 3] unit vectors.
      pivot: [J, 3] points on the axes.
      limits: [J, 2] radians or meters from the reference pose; may be infinite.
    """

    parts: tuple[Mesh, ...]
    kinds: tuple[str, ...]
    parents: tuple[int, ...]
    axis: Float[np.ndarray, "J 3"]
    pivot: Float[np.ndarray, "J 3"]
    limits: Float[np.ndarray, "J 2"]

    @property
    def num_joints(self) -> int:
        return len(self.kinds)

    def poses(self, states: Shaped[np.ndarray, " J"]) -> Float[np.ndarray, "K 4 4"]:
        """[K, 4, 4] of the parts in the root's frame, at states from the reference pose."""
        return forward_kinematics_float64(
            np.eye(4), self.axis, self.pivot, states, self.kinds, self.parents
        )

    def at(self, states: Shaped[np.ndarray, " J"]) -> MeshObject:
        """The same object with another reference pose; states count from there."""
        poses = self.poses(states)
        carriers = poses[list(self.parents)]
        turns, shifts = carriers[:, :3, :3], carriers[:, :3, 3]
        return replace(
            self,
            parts=tuple(mesh.moved(pose) for mesh, pose in zip(self.parts, poses, strict=True)),
            axis=np.einsum("jab,jb->ja", turns, self.axis),
            pivot=np.einsum("jab,jb->ja", turns, self.pivot) + shifts,
            limits=self.limits - np.asarray(states)[:, None],
        )

    def moved(self, pose: Float[np.ndarray, "4 4"], scale: float = 1.0) -> MeshObject:
        """In another frame (old -> new [4, 4]), then with all lengths times ``scale``."""
        sliding = np.array([kind == "prismatic" for kind in self.kinds], bool)
        return replace(
            self,
            parts=tuple(mesh.moved(pose).scaled(scale) for mesh in self.parts),
            axis=self.axis @ pose[:3, :3].T,
            pivot=scale * (self.pivot @ pose[:3, :3].T + pose[:3, 3]),
            limits=self.limits * np.where(sliding, scale, 1.0)[:, None],
        )

    def flipped(self, signs: Float[np.ndarray, " J"]) -> MeshObject:
        """With the axes of the joints with sign -1 reversed, and their limits with them."""
        limits = np.where(signs[:, None] < 0, -self.limits[:, ::-1], self.limits)
        return replace(self, axis=self.axis * signs[:, None], limits=limits)

    def ordered(self, order: Sequence[int]) -> MeshObject:
        """With joint ``order[j]`` as joint j; for joints that all hang on the root."""
        rows = list(order)
        return replace(
            self,
            parts=(self.parts[0], *(self.parts[row + 1] for row in rows)),
            kinds=tuple(self.kinds[row] for row in rows),
            axis=self.axis[rows],
            pivot=self.pivot[rows],
            limits=self.limits[rows],
        )

    def exchanged(self) -> MeshObject:
        """Two parts, the other one the root: seen from its child, a joint turns the other way."""
        return replace(self, parts=self.parts[::-1], axis=-self.axis)

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """[2, 3] corners of the whole object's box."""
        boxes = np.array([mesh.bounds() for mesh in self.parts])
        return np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])

    def across(self, joint: int) -> Float[np.ndarray, "2 3"]:
        """[2, 3] orthonormal, e1 x e2 = axis: the plane in which a revolute joint turns."""
        axis = self.axis[joint]
        first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(axis, first)])

    def direction(self, part: int, joint: int) -> Float[np.ndarray, " 3"]:
        """[3] unit vector across a joint's axis, away from it, along which a part is longest."""
        plane = self.across(joint)
        _, mean, second = self.parts[part].moments()
        longest = np.linalg.eigh(plane @ second @ plane.T)[1][:, -1] @ plane
        away = mean - self.pivot[joint]
        return longest if longest @ away >= 0 else -longest

    def turn(
        self, joint: int, start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"]
    ) -> float:
        """Angle in (-pi, pi] about a joint's axis from one direction to another."""
        plane = self.across(joint)
        (a, b), (c, d) = plane @ start, plane @ end
        return float(np.arctan2(a * d - b * c, a * c + b * d))

    def width(self, joint: int, state: float) -> float:
        """How far a joint's two parts reach together, meters, at one of its states.

        Along a slide; in the plane of a turn, the mean over all directions.
        """
        motion = joint_transform_float64(
            self.kinds[joint], self.axis[joint], self.pivot[joint], state
        )
        child = self.parts[joint + 1].moved(motion)
        points = np.concatenate([self.parts[self.parents[joint]].vertices, child.vertices])
        if self.kinds[joint] == "prismatic":
            along = points @ self.axis[joint]
            return float(np.ptp(along))
        angles = np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        directions = np.stack([np.cos(angles), np.sin(angles)], -1) @ self.across(joint)
        return float(np.ptp(points @ directions.T, axis=0).mean())
