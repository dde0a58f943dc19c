"""What a tracker remembers and what it is given: fixed-size pytrees."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from caper_jax.articulation.pose import Array as AnyArray
from caper_jax.tracking.registration import SurfaceMap


@flax.struct.dataclass
class Observation:
    """One frame of a stream.

    Attributes:
      points: [N, 3] meters, camera frame; anything where ``present`` is false.
      present: [] bool, whether the frame shows the object at all.
      labels: [N] int32 part of each point where it is known, -1 where the tracker is to predict it.
      gravity: [3] unit vector, the way things fall in the camera's frame; zeros where it is
        unknown, None where it is so in all frames.
    """

    points: Float[AnyArray, "*frames N 3"]
    present: Bool[AnyArray, "*frames"]
    labels: Int[AnyArray, "*frames N"]
    gravity: Float[AnyArray, "*frames 3"] | None = None


@flax.struct.dataclass
class ObjectParameters:
    """What stays the same throughout a video; network units, root's canonical frame.

    Attributes:
      axis, pivot: [J, 3] of the joints.
      size, center: [K, 3] of the parts' boxes.
      num_frames: [] float, frames in these means.
      known: [J] float, how many frames' worth is known of each joint from a given first pose.
    """

    axis: Float[Array, "J 3"]
    pivot: Float[Array, "J 3"]
    size: Float[Array, "K 3"]
    center: Float[Array, "K 3"]
    num_frames: Float[Array, ""]
    known: Float[Array, "J"]


@flax.struct.dataclass
class Keyframe:
    """The frame that increments refer to, tau(t) in Sec 5.3.2; network units.

    Attributes:
      root: [4, 4] root pose, proxy canonical space -> camera.
      joint_state: [J].
      parts: [K, 4, 4] pose of each part in the root's frame.
      points: [N, 3] its cloud in its proxy canonical space (Eq 9).
      labels: [N] int32 parts of the points.
      age: [] int32, frames since.
    """

    root: Float[Array, "4 4"]
    joint_state: Float[Array, "J"]
    parts: Float[Array, "K 4 4"]
    points: Float[Array, "N 3"]
    labels: Int[Array, "N"]
    age: Int[Array, ""]


@flax.struct.dataclass
class TrackerState:
    """All a tracker remembers of a video; network units, camera frame.

    Attributes:
      root: [4, 4] root pose in the last frame.
      joint_state: [J].
      parts: [K, 4, 4] pose of each part in the root's frame.
      root_velocity: [6] twist from frame to frame, in the root's frame.
      joint_velocity: [J].
      parameters: what does not change in a video, as the mean over the frames so far.
      variance: [3] of root rotation, root translation and joint states, as far as they have
        drifted from what the estimator or the user gave.
      keyframe: what increments refer to.
      surface: the parts' surfaces as far as the frames so far show them, for registration.
      accepted_residual: [] the box residual that an estimate could not improve, so that objects of
        unusual size do not count as inconsistent again and again.
      num_inconsistent: [] int32, frames in a row that disagreed with the track.
      rotation_log_odds: [24] log odds, over the frames so far, that the track is off by each of
        ``models.rotation_classes``, according to stage II.
      rotation_votes: [24] likewise, according to the estimates of the first frames.
      init_frames_left: [] int32, in how many further frames the estimator is queried.
      lost: [] bool, the next frame with points starts from the estimator alone.
      reason: [] int32, why the last estimate was not plausible, see ``plausibility.REASONS``.
    """

    root: Float[Array, "4 4"]
    joint_state: Float[Array, "J"]
    parts: Float[Array, "K 4 4"]
    root_velocity: Float[Array, "6"]
    joint_velocity: Float[Array, "J"]
    parameters: ObjectParameters
    variance: Float[Array, "3"]
    keyframe: Keyframe
    surface: SurfaceMap
    accepted_residual: Float[Array, ""]
    num_inconsistent: Int[Array, ""]
    rotation_log_odds: Float[Array, "24"]
    rotation_votes: Float[Array, "24"]
    init_frames_left: Int[Array, ""]
    lost: Bool[Array, ""]
    reason: Int[Array, ""]


def of_type(tree, dtype):
    """A pytree with its floating-point leaves in one dtype: 64-bit JAX mixes them otherwise."""

    def cast(leaf):
        leaf = jnp.asarray(leaf)
        return leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(cast, tree)
