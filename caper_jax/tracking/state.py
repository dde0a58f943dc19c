"""What a tracker remembers and what it is given: fixed-size pytrees."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from caper_jax.tracking.registration import SurfaceMap


@flax.struct.dataclass
class Observation:
    """One frame of a stream.

    Attributes:
      points: [N, 3] meters, camera frame; anything where ``present`` is false.
      present: [] bool, whether the frame shows the object at all.
      labels: [N] int32 part of each point where it is known, -1 where the tracker is to predict it.
    """

    points: Any
    present: Any
    labels: Any


@flax.struct.dataclass
class ObjectParameters:
    """What stays the same throughout a video; network units, root's canonical frame.

    Attributes:
      axis, pivot: [J, 3] of the joints.
      size, center: [K, 3] of the parts' boxes.
      seen: [] float, frames in these means.
      known: [J] float, how many frames' worth is known of each joint from a given first pose.
    """

    axis: Any
    pivot: Any
    size: Any
    center: Any
    seen: Any
    known: Any


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

    root: Any
    joint_state: Any
    parts: Any
    points: Any
    labels: Any
    age: Any


@flax.struct.dataclass
class TrackerState:
    """All a tracker remembers of a video; network units, camera frame.

    Attributes:
      root: [4, 4] root pose in the last frame.
      joint_state: [J].
      parts: [K, 4, 4] pose of each part in the root's frame.
      root_velocity: [6] twist from frame to frame, in the root's frame.
      joint_velocity: [J].
      constants: what does not change in a video, as the mean over the frames so far.
      variance: [3] of root rotation, root translation and joint states, as far as they have
        drifted from what the static estimator or the user gave.
      keyframe: what increments refer to.
      surface: what was seen of the parts so far, for registration.
      accepted: [] the box residual that the static estimator was asked about and could not
        better, so that objects of unusual size are not doubted again and again.
      num_inconsistent: [] int32, frames in a row that disagreed with the track.
      turn: [24] log odds, over the frames so far, that the track is off by a turn, as stage II sees
        it.
      vote: [24] likewise, by static estimates on trial.
      trial: [] int32, in so many further frames the static estimator is asked.
      lost: [] bool, the next frame with points starts afresh from the static estimator.
    """

    root: Any
    joint_state: Any
    parts: Any
    root_velocity: Any
    joint_velocity: Any
    constants: ObjectParameters
    variance: Any
    keyframe: Keyframe
    surface: SurfaceMap
    accepted: Any
    num_inconsistent: Any
    turn: Any
    vote: Any
    trial: Any
    lost: Any


def of_type(tree, dtype):
    """A pytree with its floating-point leaves in one dtype: 64-bit JAX mixes them otherwise."""

    def cast(leaf):
        leaf = jnp.asarray(leaf)
        return leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(cast, tree)
