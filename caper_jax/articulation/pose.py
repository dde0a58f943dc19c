"""The pose of an articulated object, as predicted or as ground truth."""

from __future__ import annotations

from typing import Any

import flax.struct
from jaxtyping import Float

# numpy's or JAX's: the same container serves files, the generator and the networks.
Array = Any


@flax.struct.dataclass
class ArticulatedPose:
    """Pose of an object with K parts and J = K - 1 joints; ``*batch`` are any leading axes.

    A part's rest frame is its frame in the object's rest pose, where all parts share the root's.

    Attributes:
      rotation: rest frame of the part -> camera.
      translation: meters; ``p_camera = rotation @ p + translation``.
      size: meters; full extents of the part's box in its rest frame.
      box_center: meters; center of that box, in the rest frame.
      joint_axis: unit vectors in the root's rest frame; a positive state turns (or moves) the child
        by plus the state about (along) it.
      joint_pivot: meters; a point on the axis, in the root's rest frame.
      joint_state: radians (revolute) or meters (prismatic) from the rest pose.
    """

    rotation: Float[Array, "*batch K 3 3"]
    translation: Float[Array, "*batch K 3"]
    size: Float[Array, "*batch K 3"]
    box_center: Float[Array, "*batch K 3"]
    joint_axis: Float[Array, "*batch J 3"]
    joint_pivot: Float[Array, "*batch J 3"]
    joint_state: Float[Array, "*batch J"]


def joints_in_camera(
    pose: ArticulatedPose,
) -> tuple[Float[Array, "*batch J 3"], Float[Array, "*batch J 3"]]:
    """Joint axes (unit vectors) and pivots (meters, points on the axes) in the camera frame.

    A joint's own motion leaves its axis where it is. So the pose of the part that the joint carries
    brings the axis from the rest frame to the camera, however deep the tree of parts is.
    """
    rotation, translation = pose.rotation[..., 1:, :, :], pose.translation[..., 1:, :]
    axis = (rotation * pose.joint_axis[..., None, :]).sum(-1)
    return axis, (rotation * pose.joint_pivot[..., None, :]).sum(-1) + translation
