"""What a category is: its parts, joints, frames and symmetries, as data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from caper_jax.arrays import array_problem
from caper_jax.articulation.conversions import Conversion
from caper_jax.articulation.urdf_rule import UrdfRule
from caper_jax.errors import CaperError, unknown_name
from caper_jax.geometry.solids import Solid

JointType = Literal["revolute", "prismatic"]
_BEYOND_LIMITS = 0.25  # of the range: objects open wider than those that training saw


@dataclass(frozen=True)
class Joint:
    """The joint that carries one constrained part.

    Attributes:
      type: "revolute" or "prismatic".
      parent: index of the part it is mounted on (0 is the root).
      limits: (low, high) of the state used for training, radians or meters from the rest pose.
    """

    type: JointType
    parent: int
    limits: tuple[float, float]


@dataclass(frozen=True)
class Symmetry:
    """Another pose that describes the same object equally well (a declared ambiguity).

    There the pose of part k is ``T'_k = T_permutation[k] @ S``, with S the ``rotation`` about the
    origin of the rest frame.

    Attributes:
      permutation: part k is then what was part ``permutation[k]``.
      rotation: [3, 3] of the rest frame.
      reason: why the two cannot be told apart, for documentation.
      tolerance: largest relative difference of any extent of the exchanged parts at which an
        instance still looks the same in both poses.
    """

    permutation: tuple[int, ...]
    rotation: tuple[tuple[float, float, float], ...]
    reason: str
    tolerance: float = 0.3


@dataclass(frozen=True)
class ObjectModel:
    """One instance: solids per part at rest, and its joints.

    Attributes:
      parts: K lists of solids, in one common frame at rest; meters.
      axis: [K-1, 3] unit joint axes in that frame; positive opens.
      pivot: [K-1, 3] points on the axes.
      limits: [K-1, 2] range of the states of this instance, radians or meters.
    """

    parts: list[list[Solid]]
    axis: np.ndarray
    pivot: np.ndarray
    limits: np.ndarray


@dataclass(frozen=True)
class Viewpoint:
    """Where cameras of generated frames stand, relative to the object as in use.

    Attributes:
      up: the canonical axis that points away from the table, "y" for all but lying objects.
      azimuth: degrees, full circle by default; 0 looks at the front (+z).
      elevation: degrees above the table.
      roll: degrees, either side of ``camera_roll``.
      camera_roll: degrees by which upright things appear rotated clockwise in the image.
      distance: in object diagonals.
      either_side: the object lies on its one side as often as on the other, so that cameras above
        the table look at either.
    """

    up: Literal["x", "y", "z"] = "y"
    azimuth: tuple[float, float] = (-180.0, 180.0)
    elevation: tuple[float, float] = (5.0, 80.0)
    roll: float = 15.0
    camera_roll: float = 0.0
    distance: tuple[float, float] = (1.5, 6.0)
    either_side: bool = False


@dataclass(frozen=True)
class Category:
    """A category of articulated objects (K parts, K - 1 joints), root first.

    Attributes:
      name: as on the command line.
      parts: K names, in the order of every array.
      joints: K - 1 joints; joint j carries part j + 1.
      directions: the two axes of the root's frame that stage I regresses (paper Fig. 4).
      directions_reason: why these two.
      unit: network units per meter; inputs and outputs of the public interface are meters.
      mean_size: [K, 3] meters, mean part sizes of the training instances (paper Sec 5.2.3).
      mean_center: [K, 3] meters, mean box centers in the rest-canonical frame. Where this,
        mean_size or unit is left out, it is computed from drawn shapes, which takes about a second.
      shape: draws an instance from a numpy generator; None when only real data exist.
      viewpoint: cameras of generated frames.
      symmetries: declared ambiguities.
      stands: whether such objects stand as they are used, ``viewpoint.up`` against gravity; False
        where they lie as they like, so that gravity says nothing of their rotation.
      closed: the limit at which a joint is closed; None where that means nothing.
      urdf_rule: how objects in URDF files become this category's; no rule takes the file's state 0
        as the rest pose, z as up and x as the front.
      datasets: how its objects in public datasets become ours, see ``articulation.conversions``.
    """

    name: str
    parts: tuple[str, ...]
    joints: tuple[Joint, ...]
    directions: tuple[Literal["x", "y", "z"], Literal["x", "y", "z"]]
    directions_reason: str
    unit: float = 0.0
    mean_size: tuple[tuple[float, float, float], ...] = ()
    mean_center: tuple[tuple[float, float, float], ...] = ()
    shape: Callable[[np.random.Generator], ObjectModel] | None = None
    viewpoint: Viewpoint = field(default_factory=Viewpoint)
    symmetries: tuple[Symmetry, ...] = ()
    stands: bool = True
    closed: Literal["low", "high"] | None = "low"
    # Compiled functions do not depend on it: it is no part of equality or of the hash.
    urdf_rule: UrdfRule = field(default_factory=UrdfRule, compare=False)
    # Not part of what makes categories equal: networks do not see it, and it cannot be hashed.
    datasets: Mapping[str, Conversion] = field(default_factory=dict, compare=False, repr=False)

    @property
    def num_parts(self) -> int:
        return len(self.parts)

    @property
    def num_joints(self) -> int:
        return len(self.joints)

    @property
    def joint_types(self) -> tuple[JointType, ...]:
        return tuple(joint.type for joint in self.joints)

    @property
    def parents(self) -> tuple[int, ...]:
        """[K-1] parent part of each joint."""
        return tuple(joint.parent for joint in self.joints)

    @property
    def state_units(self) -> np.ndarray:
        """[K-1] network units per meter (prismatic joints), 1 (revolute ones)."""
        return np.array([self.unit if t == "prismatic" else 1.0 for t in self.joint_types])

    @property
    def state_bounds(self) -> np.ndarray:
        """[K-1, 2] states that an estimate may have: the limits, and a quarter of their range
        beyond each; radians or meters."""
        limits = np.array([joint.limits for joint in self.joints], float).reshape(-1, 2)
        margin = _BEYOND_LIMITS * (limits[:, 1] - limits[:, 0])
        return limits + np.stack([-margin, margin], axis=-1)

    @property
    def network_state_bounds(self) -> np.ndarray:
        """[K-1, 2] ``state_bounds`` in radians or network units."""
        return self.state_bounds * self.state_units[:, None]

    def scaled(self, factor: float) -> Category:
        """The category of objects that are ``factor`` times as large; same networks, same weights.

        It draws no shapes: the ones of the category are of its own size.

        Raises:
          CaperError: a factor that is not positive.
        """
        if not 0 < factor < np.inf:
            raise CaperError(f"object scale must be positive, got {factor}")
        if factor == 1.0:
            return self

        def times(rows):
            return tuple(tuple(factor * value for value in row) for row in rows)

        joints = tuple(
            joint
            if joint.type == "revolute"
            else replace(joint, limits=(factor * joint.limits[0], factor * joint.limits[1]))
            for joint in self.joints
        )
        return replace(
            self,
            unit=self.unit / factor,
            joints=joints,
            mean_size=times(self.mean_size),
            mean_center=times(self.mean_center),
            shape=None,
        )

    def rolled(self, degrees: float) -> Category:
        """The category as cameras see it that are not level; same networks, same weights.

        Args:
          degrees: by which things appear rotated clockwise in the image, on top of before; 180
            for a camera upside down.

        Raises:
          CaperError: an angle that is not finite.
        """
        if not np.isfinite(degrees):
            raise CaperError(f"camera roll must be finite, in degrees, got {degrees}")
        if degrees == 0.0:
            return self
        camera_roll = self.viewpoint.camera_roll + degrees
        return replace(self, viewpoint=replace(self.viewpoint, camera_roll=camera_roll))

    def __post_init__(self) -> None:
        where = f"category {self.name!r}"
        if len(self.parts) != len(self.joints) + 1:
            raise CaperError(f"{where}: {len(self.parts)} parts need {len(self.parts) - 1} joints")
        for child, joint in enumerate(self.joints, start=1):
            if not 0 <= joint.parent < child:
                raise CaperError(f"{where}: part {child} must come after its parent {joint.parent}")
            if joint.type not in get_args(JointType):
                wrong = unknown_name("joint type", joint.type, get_args(JointType))
                raise CaperError(f"{where}: {wrong}")
            if not -np.inf < joint.limits[0] < joint.limits[1] < np.inf:
                raise CaperError(
                    f"{where}: joint of part {child} must have finite limits, the low one first, "
                    f"got {joint.limits}"
                )
        if not set(self.directions) <= set("xyz") or len(self.directions) != 2:
            raise CaperError(f"{where}: directions are two of x, y, z, got {self.directions}")
        if self.directions[0] == self.directions[1]:
            raise CaperError(f"{where}: the two directions must differ, got {self.directions}")
        if self.shape is not None and not (self.unit and self.mean_size and self.mean_center):
            from caper_jax.articulation.shapes import left_out

            for name, value in left_out(self).items():
                object.__setattr__(self, name, value)
        for label, rows in (("mean_size", self.mean_size), ("mean_center", self.mean_center)):
            problem = array_problem(label, rows, (len(self.parts), 3), np.number)
            if problem:
                raise CaperError(
                    f"{where}: {problem}; only a category with a shape function may leave it out"
                )
        if not 0 < self.unit < np.inf or np.min(self.mean_size) <= 0:
            raise CaperError(f"{where}: unit and mean_size must be positive")
        if self.closed not in ("low", "high", None):
            raise CaperError(f"{where}: closed is 'low', 'high' or None, got {self.closed!r}")
        for symmetry in self.symmetries:
            rotation = np.array(symmetry.rotation, float)
            if sorted(symmetry.permutation) != list(range(len(self.parts))):
                raise CaperError(
                    f"{where}: a symmetry must permute the parts, got {symmetry.permutation}"
                )
            is_rotation = rotation.shape == (3, 3) and np.allclose(
                rotation @ rotation.T, np.eye(3), atol=1e-5
            )
            if not is_rotation or np.linalg.det(rotation) < 0:
                raise CaperError(
                    f"{where}: the rotation of a symmetry is no rotation matrix: {rotation}"
                )
