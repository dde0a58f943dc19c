"""Articulated objects from URDF files with meshes: what the user says, and what an import gives.

``load`` reads files, ``parts`` maps links to a category's parts, ``canonical`` brings the object to
the category's rest pose and frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from caper_jax.articulation.category import Category
from caper_jax.articulation.mesh_object import MeshObject


@dataclass(frozen=True)
class ImportOptions:
    """What the user says about a URDF; all else is detected.

    Attributes:
      up: [3] the file's direction that becomes canonical y, or None.
      front: [3] the file's direction that becomes canonical z, or None.
      rest: states of the file's joints at rest, by the name of the joint or of the link it
        carries; degrees or meters. "" stands for all joints that the parts keep.
      parts: one link of each part in the category's order, or None.
      scale: factor for all lengths, or None for the category's mean size.
    """

    up: Shaped[np.ndarray, " 3"] | None = None
    front: Shaped[np.ndarray, " 3"] | None = None
    rest: Mapping[str, float] = field(default_factory=dict)
    parts: tuple[str, ...] | None = None
    scale: float | None = 1.0


@dataclass(frozen=True)
class JointMap:
    """From the value of a joint in the file to our state and back: radians or meters.

    ``state = factor * value + offset``; a positive state opens.

    Attributes:
      file_joint: its name in the file.
      type: "revolute" or "prismatic".
      factor: 1, or -1 where the file's joint closes by positive values; of a prismatic joint, that
        times the scale of lengths.
      offset: our state at the file's value 0.
      file_limits: (low, high) values that the file allows; infinite where it names none.
      state_range: (low, high) states that are drawn.
    """

    file_joint: str
    type: str
    factor: float
    offset: float
    file_limits: tuple[float, float]
    state_range: tuple[float, float]

    def state(self, value: float | np.ndarray) -> Any:
        """Our state of a value in the file."""
        return self.factor * value + self.offset

    def value(self, state: float | np.ndarray) -> Any:
        """The value in the file of one of our states."""
        return (state - self.offset) / self.factor

    def report(self) -> dict[str, Any]:
        """The map for a JSON file; limits are null where there is none.

        "clipped" says that fewer states are drawn than the file allows.
        """
        limits = sorted(self.state(limit) for limit in self.file_limits)
        low, high = self.state_range
        return {
            "file_joint": self.file_joint,
            "type": self.type,
            "unit": "rad" if self.type == "revolute" else "m",
            "map": "state = factor * value + offset; value = (state - offset) / factor",
            "factor": self.factor,
            "offset": self.offset,
            "file_limits": _finite(self.file_limits),
            "state_limits": _finite(limits),
            "state_range": [low, high],
            "clipped": bool(low > limits[0] + 1e-9 or high < limits[1] - 1e-9),
        }


def _finite(limits: Sequence[float]) -> list[float | None]:
    return [float(limit) if np.isfinite(limit) else None for limit in limits]


@dataclass(frozen=True)
class ImportedObject:
    """An articulated object with meshes, in the conventions of this project.

    Attributes:
      name: of the object.
      category: its category.
      at_rest: parts and joints at rest, canonical frame, meters; K parts in order.
      size, box_center: [K, 3] meters.
      joints: J maps between the file's joints and ours.
      notes: what was detected and decided, a line each.
    """

    name: str
    category: Category
    at_rest: MeshObject
    size: Float[np.ndarray, "K 3"]
    box_center: Float[np.ndarray, "K 3"]
    joints: tuple[JointMap, ...]
    notes: tuple[str, ...]

    @property
    def states(self) -> Float[np.ndarray, "J 2"]:
        """[J, 2] range from which states are drawn, radians or meters from rest."""
        return np.array([joint.state_range for joint in self.joints])

    def report(self) -> dict[str, Any]:
        """How the file was understood, for a JSON file: notes, and the map of every joint."""
        return {
            "name": self.name,
            "category": self.category.name,
            "notes": list(self.notes),
            "joints": {
                part: joint.report()
                for part, joint in zip(self.category.parts[1:], self.joints, strict=True)
            },
        }
