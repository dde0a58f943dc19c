"""The pose of an articulated object, as predicted or as ground truth."""

from __future__ import annotations

from typing import Any

import flax.struct

# numpy or jax array: the same container serves files, the generator and the networks.
Array = Any


@flax.struct.dataclass
class ArticulatedPose:
    """Pose of an object with K parts and J = K - 1 joints; leading axes are batch axes.

    Attributes:
      rotation: [..., K, 3, 3] rest-canonical part frame -> camera.
      translation: [..., K, 3] meters; ``p_cam = R p + t``.
      size: [..., K, 3] meters; full extents of the part's box in its rest-canonical frame.
      box_center: [..., K, 3] meters; center of that box, in the rest-canonical frame.
      joint_axis: [..., J, 3] unit vectors in the root's canonical frame; a positive state turns
        (or moves) the child by plus the state about (along) it.
      joint_pivot: [..., J, 3] meters; a point on the axis, root's canonical frame.
      joint_state: [..., J] radians (revolute) or meters (prismatic) from the rest pose.
    """

    rotation: Array
    translation: Array
    size: Array
    box_center: Array
    joint_axis: Array
    joint_pivot: Array
    joint_state: Array
