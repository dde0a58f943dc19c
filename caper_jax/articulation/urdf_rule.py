"""How URDF files of a category are brought to its rest pose and canonical frame.

A URDF says neither which way is up nor what is open. A rule reads it from the direction of the
joints, the side on which their range lies, and the shape of the parts; conventions of modelers (z
or y up, objects modeled closed or unfolded) only settle what is left.

Rest states are snapped to states that mean something in the file: 0, a limit, or 90 deg from one.
The functions of a rule belong to its category; those that several categories share are here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from caper_jax.articulation.mesh_object import MeshObject

X, Y, Z = np.eye(3)


class CanonicalAxes(NamedTuple):
    """Canonical axes in the file's frame.

    Attributes:
      up, front: [3] canonical y and z; of any length, not quite at right angles.
      assumed: which of "up" and "front" only a convention says.
    """

    up: Float[np.ndarray, " 3"]
    front: Float[np.ndarray, " 3"]
    assumed: tuple[str, ...] = ()


def rest_at_zero(ref: MeshObject) -> Float[np.ndarray, " J"]:
    """[J] the file's state 0 of every joint."""
    return np.zeros(ref.num_joints)


def usual_axes(ref: MeshObject) -> CanonicalAxes:
    """z up and x to the front, as in robotics."""
    return CanonicalAxes(Z, X, ("up", "front"))


@dataclass(frozen=True)
class UrdfRule:
    """How a category's objects in URDF files become its own.

    Attributes:
      rest: [J] states, from the file's 0, of the object in the file's frame.
      axes: up and front in the file's frame, for the object at rest.
      opening: [J, 3] direction, canonical, about or along which each joint opens; None keeps the
        sense of the file.
      order: axis (0, 1, 2) along which parts on the root are numbered; None keeps the file's order.
      snap: degrees within which the frame is set to the axes of the file.
      root: which of two parts is the root; None takes the file's.
      child_words: what links of the child are called and those of the root never: they decide
        which of two parts is the root where the file hangs the root on the child.
      partnet_classes: PartNet-Mobility's classes that hold the category; () for any.
    """

    rest: Callable[[MeshObject], np.ndarray] = rest_at_zero
    axes: Callable[[MeshObject], CanonicalAxes] = usual_axes
    opening: Callable[[MeshObject], np.ndarray] | None = None
    order: int | None = None
    snap: float = 35.0
    root: Callable[[MeshObject], int] | None = None
    child_words: tuple[str, ...] = ()
    partnet_classes: tuple[str, ...] = ()


def snap_state(
    state: float, limits: Float[np.ndarray, " 2"], degrees: float, quarter: bool = False
) -> float:
    """The first of 0, the limits and (if ``quarter``) 90 deg from them that is near a state.

    Args:
      state: radians.
      limits: [2] radians; infinite ones count for nothing.
      degrees: how near.
      quarter: whether 90 deg from a limit counts too.
    """
    ends = [float(end) for end in limits if np.isfinite(end)]
    turns = [end + sign * np.pi / 2 for end in ends for sign in (1, -1)] if quarter else []
    for candidate in (0.0, *ends, *turns):
        if abs(candidate - state) <= np.radians(degrees):
            return candidate
    return state


def opening_sign(ref: MeshObject, joint: int) -> float:
    """+1 or -1: the sign of the states to which a joint at the end of its range can go.

    The side on which more of its range lies; without a clear one, the side on which the object
    gets larger.
    """
    low, high = ref.limits[joint]
    if np.isfinite(high - low) and abs(high + low) > 0.2 * (high - low):
        return 1.0 if high + low > 0 else -1.0
    step = np.radians(60) if ref.kinds[joint] == "revolute" else 0.1 * np.ptp(ref.bounds())
    return 1.0 if ref.width(joint, step) >= ref.width(joint, -step) else -1.0


def closed_states(ref: MeshObject) -> Float[np.ndarray, " J"]:
    """[J] every joint at 0 or at the limit where the object is most compact, 0 if nearly as good.

    A range that starts a little before the lid is shut counts from 0 all the same.
    """
    states = []
    for joint in range(ref.num_joints):
        ends = [float(end) for end in ref.limits[joint] if np.isfinite(end)]
        if not ends and ref.kinds[joint] == "revolute":
            ends = [np.pi / 2, -np.pi / 2, np.pi]
        widths = {state: ref.width(joint, state) for state in (0.0, *ends)}
        best = min(widths, key=lambda state: widths[state])
        near = np.radians(5) if ref.kinds[joint] == "revolute" else 0.02 * np.ptp(ref.limits[joint])
        zero = abs(best) <= near or widths[0.0] <= 1.01 * widths[best]
        states.append(0.0 if zero else best)
    return np.array(states)


def level(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """[3] an axis of the file that is within 8 deg of a direction, else the direction.

    A wedge lies on the table with its underside, not with its middle.
    """
    index = int(np.argmax(np.abs(direction)))
    if abs(direction[index]) < np.cos(np.radians(8)):
        return direction
    return np.eye(3)[index] * np.sign(direction[index])


def along_positive(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """[3] a direction or its opposite, whichever points along a positive axis of the file."""
    return direction * np.sign(direction[np.argmax(np.abs(direction))])


def hinged_axes(ref: MeshObject) -> CanonicalAxes:
    """Front from the hinge along the child (a closed lid, an open door), up where it swings to."""
    front = ref.direction(1, 0)
    return CanonicalAxes(opening_sign(ref, 0) * np.cross(ref.axis[0], front), front)


def opens_along(axis: Float[np.ndarray, " 3"]) -> Callable[[MeshObject], np.ndarray]:
    """The ``opening`` of a category all of whose joints open about or along one canonical axis."""
    return lambda ref: np.tile(axis, (ref.num_joints, 1))
