"""Where the object is in one frame: by the networks, on the track or from nothing, or as given."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import Array as AnyArray
from caper_jax.config import NetworkConfig
from caper_jax.estimator import estimate
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.geometry.frames import canonicalize
from caper_jax.geometry.raster_order import from_raster_order, raster_order, to_raster_order
from caper_jax.lie import linalg, se3, so3
from caper_jax.models.observation import Selection, select
from caper_jax.models.parts import PartsNetwork, increment_transform, vote
from caper_jax.models.plausibility import PLAUSIBLE
from caper_jax.models.rotation_classes import NUM_CUBE_ROTATIONS, log_odds
from caper_jax.tracking.registration import JointTree, part_poses
from caper_jax.tracking.state import ObjectParameters, of_type

_NO_ROTATION = np.zeros(NUM_CUBE_ROTATIONS, np.float32)
_MEMORY = 60.0  # frames over which joint parameters and sizes are averaged
# Motion from rest at which a pose tells as much about its joint as one frame's votes do.
_TURN, _SLIDE, _PIVOT = 0.1, 0.1, 0.1


@flax.struct.dataclass
class PoseMeasurement:
    """A pose of the object in one frame, from whatever source; network units.

    Attributes:
      root: [4, 4] root pose, camera frame.
      joint_state: [J].
      parts: [K, 4, 4] part poses in the root's frame.
      labels: [N] int32 part of every point.
      parameters: joint parameters and sizes.
      confidence: [] in [0, 1], the lower one of the root's two directions (Eq 18); 1 of a track.
      rotation_log_odds: [24] log odds that the reference is off by each rotation of
        ``models.rotation_classes``; zero without evidence.
      reason: [] int32, why the pose is not plausible, see ``plausibility.REASONS``.
    """

    root: Float[Array, "4 4"]
    joint_state: Float[Array, "J"]
    parts: Float[Array, "K 4 4"]
    labels: Int[Array, "N"]
    parameters: ObjectParameters
    confidence: Float[Array, ""]
    rotation_log_odds: Float[AnyArray, "24"]
    reason: Int[AnyArray, ""]


def without_strays(points, labels) -> tuple[Array, Array, Selection]:
    """Points [N, 3] and labels [N] without those that lie alone, and which ones they are."""
    selection = select(points[None])
    return (
        selection.pick(points[None])[0],
        selection.pick(labels[None, :, None])[0, :, 0],
        selection,
    )


def measure(
    variables, points, labels, reference, category: Category, network: NetworkConfig
) -> PoseMeasurement:
    """Stage II on the proxy-canonicalized cloud (Eq 9): increment from the reference, and the rest.

    Stage II alone cannot tell whether the object is plausible: the pose is said to be.

    Args:
      variables: as ``estimator.estimate`` takes them.
      points: [N, 3] network units, camera frame.
      labels: [N] int32, known parts of points, -1 where they are to be predicted.
      reference: [4, 4] the root pose that canonicalizes.
      category, network: static.
    """
    own = {name: collection["parts"] for name, collection in variables.items()}
    order = raster_order(points)[None]
    cloud = to_raster_order(points[None], order)
    cloud = canonicalize(cloud, reference[None, :3, :3], reference[None, :3, 3])
    module = PartsNetwork(network, category.num_parts)
    output: Any = module.apply(own, cloud, train=False)
    axis, pivot = vote(cloud, output.heatmap, output.offset, output.direction)
    increment = increment_transform(output.increment[0], network.increment)
    segmentation = from_raster_order(output.segmentation, order)[0]
    predicted = segmentation.argmax(-1).astype(jnp.int32)
    unit = category.unit
    parameters = ObjectParameters(
        axis=axis[0],
        pivot=pivot[0],
        size=jnp.asarray(category.mean_size) * unit + output.size[0],
        center=jnp.asarray(category.mean_center) * unit + output.center[0],
        num_frames=jnp.asarray(1.0),
        known=jnp.zeros(category.num_joints),
    )
    tree = JointTree(axis[0], pivot[0], category.joint_types, category.parents)
    low, high = category.network_state_bounds.T.astype(points.dtype)
    state = jnp.clip(output.state[0], low, high)
    measurement = PoseMeasurement(
        root=se3.compose(reference, increment),
        joint_state=state,
        parts=part_poses(tree, state),
        labels=jnp.where(labels >= 0, labels, predicted),
        parameters=parameters,
        confidence=jnp.asarray(1.0, points.dtype),
        rotation_log_odds=(
            _NO_ROTATION if output.rotation_class is None else log_odds(output.rotation_class[0])
        ),
        reason=jnp.asarray(PLAUSIBLE, jnp.int32),
    )
    return of_type(measurement, points.dtype)


def estimate_measurement(
    variables, points, labels, gravity, category: Category, network: NetworkConfig
) -> PoseMeasurement:
    """The pose that the single-frame estimator gives.

    Arguments as for ``measure``; gravity is that of ``state.Observation``.
    """
    unit = category.unit
    down = None if gravity is None else gravity[None]
    prediction = estimate(variables, points[None] / unit, category, network, gravity=down)
    pose = jax.tree.map(lambda array: array[0], prediction.pose)
    poses = se3.from_rt(pose.rotation, pose.translation * unit)
    measurement = PoseMeasurement(
        root=poses[0],
        joint_state=pose.joint_state * category.state_units,
        parts=se3.compose(se3.inverse(poses[0]), poses),
        labels=jnp.where(labels >= 0, labels, prediction.labels[0]),
        parameters=ObjectParameters(
            axis=pose.joint_axis,
            pivot=pose.joint_pivot * unit,
            size=pose.size * unit,
            center=pose.box_center * unit,
            num_frames=jnp.asarray(1.0),
            known=jnp.zeros(category.num_joints),
        ),
        confidence=prediction.confidence[0].min(),
        rotation_log_odds=_NO_ROTATION,
        reason=prediction.reason[0],
    )
    return of_type(measurement, points.dtype)


def update_parameters(old: ObjectParameters, new: ObjectParameters) -> ObjectParameters:
    """Running means over the frames of a video."""
    num_frames = jnp.minimum(old.num_frames, _MEMORY)
    of_parts, of_joints = 1.0 / (num_frames + 1.0), 1.0 / (num_frames + old.known + 1.0)[:, None]
    return ObjectParameters(
        axis=linalg.unit(old.axis + of_joints * (new.axis - old.axis)),
        pivot=old.pivot + of_joints * (new.pivot - old.pivot),
        size=old.size + of_parts * (new.size - old.size),
        center=old.center + of_parts * (new.center - old.center),
        num_frames=old.num_frames + 1.0,
        known=old.known,
    )


def diagonal(parameters: ObjectParameters):
    """[] length of the diagonal of the object's box at rest."""
    return jnp.maximum(rest_diagonal(jnp.abs(parameters.size), parameters.center), 1e-3)


def part_coordinates(measurement: PoseMeasurement, points):
    """Points [N, 3] of the camera frame, each in the frame of its part."""
    poses = se3.compose(measurement.root, measurement.parts)
    return se3.act(se3.inverse(poses)[measurement.labels], points[:, None])[:, 0]


def box_residual(measurement: PoseMeasurement, points):
    """Mean distance [] of points [N, 3] from the boxes of their parts, over the object's diagonal.

    A track that drifts cannot hide it: sizes are the category's.
    """
    own = part_coordinates(measurement, points)
    sizes, centers = (
        measurement.parameters.size[measurement.labels],
        measurement.parameters.center[measurement.labels],
    )
    outside = jnp.maximum(jnp.abs(own - centers) - sizes / 2, 0.0)
    return linalg.norm(outside).mean() / diagonal(measurement.parameters)


def joints_from_poses(parts, votes: ObjectParameters, category: Category):
    """Joint states, axes and pivots that fit given part poses, as far as these determine them.

    A child's pose in its parent's frame is ``[R | (I - R) q]`` (Eq 8): the axis of R is the
    joint's, its angle the state, and the pivot q follows but for its place along the axis. Near
    rest R and I - R vanish and the votes of the network stay as they are; in between, both count
    by their uncertainty.

    Args:
      parts: [K, 4, 4] part poses in the root's frame, network units.
      votes: joints as the network sees them; its axes also decide about the signs.
      category: joint types and tree.

    Returns:
      (states [J], parameters with new axes, pivots and ``known``).
    """
    states, axes, pivots, known = [], [], [], []
    for joint, (kind, parent) in enumerate(
        zip(category.joint_types, category.parents, strict=True)
    ):
        relative = se3.compose(se3.inverse(parts[parent]), parts[joint + 1])
        rotation, translation = relative[:3, :3], relative[:3, 3]
        turns = kind == "revolute"
        motion, scale = (so3.log(rotation), _TURN) if turns else (translation, _SLIDE)
        voted = votes.axis[joint]
        forward = jnp.where(linalg.dot(motion, voted) < 0, -1.0, 1.0)
        weight = linalg.dot(motion, motion) / scale**2
        length = linalg.norm(motion)
        axis = linalg.unit(voted + weight * forward * linalg.unit(motion))
        states.append(forward * length)
        axes.append(axis)
        known.append(weight)
        pivot = votes.pivot[joint]
        if turns:
            arm = jnp.eye(3, dtype=rotation.dtype) - rotation
            normal = linalg.multiply(arm.T, arm) + _PIVOT**2 * jnp.eye(3, dtype=arm.dtype)
            missing = translation - linalg.apply(arm, pivot)
            pivot += jnp.linalg.solve(normal, linalg.apply(arm.T, missing))
        pivots.append(pivot)
    parameters = replace(
        votes, axis=jnp.stack(axes), pivot=jnp.stack(pivots), known=10.0 * jnp.stack(known)
    )
    return jnp.stack(states), parameters
