"""Where the object is in one frame, as the networks see it: on the track, or from nothing."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.config import NetworkConfig
from caper_jax.estimator import estimate
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.geometry.frames import canonicalize
from caper_jax.geometry.raster_order import from_raster_order, raster_order, to_raster_order
from caper_jax.lie import linalg, se3
from caper_jax.models.increment import increment_transform
from caper_jax.models.networks import PartsNetwork
from caper_jax.models.rotation_classes import NUM_CUBE_ROTATIONS, log_odds
from caper_jax.models.voting import vote
from caper_jax.tracking.registration import JointTree, part_poses
from caper_jax.tracking.state import ObjectParameters, of_type

_NO_TURN = np.zeros(NUM_CUBE_ROTATIONS, np.float32)
_MEMORY = 60.0  # frames over which joint parameters and sizes are averaged


@flax.struct.dataclass
class PoseMeasurement:
    """A pose of the object in one frame, from whatever source; network units.

    Attributes:
      root: [4, 4] root pose, camera frame.
      joint_state: [J].
      parts: [K, 4, 4] part poses in the root's frame.
      labels: [N] int32 part of every point.
      constants: joint parameters and sizes.
      sure: [] in [0, 1], the lesser confidence of the root's two directions (Eq 18); 1 of a track.
      turn: [24] log odds that the reference is off by each rotation of
        ``models.rotation_classes``; zero where nothing says so.
    """

    root: Any
    joint_state: Any
    parts: Any
    labels: Any
    constants: ObjectParameters
    sure: Any
    turn: Any


def measure(
    variables, points, labels, reference, category: Category, network: NetworkConfig
) -> PoseMeasurement:
    """Stage II on the proxy-canonicalized cloud (Eq 9): increment from the reference, and the rest.

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
    constants = ObjectParameters(
        axis=axis[0],
        pivot=pivot[0],
        size=jnp.asarray(category.mean_size) * unit + output.size[0],
        center=jnp.asarray(category.mean_center) * unit + output.center[0],
        seen=jnp.asarray(1.0),
        known=jnp.zeros(category.num_joints),
    )
    tree = JointTree(axis[0], pivot[0], category.joint_types, category.parents)
    fix = PoseMeasurement(
        root=se3.compose(reference, increment),
        joint_state=output.state[0],
        parts=part_poses(tree, output.state[0]),
        labels=jnp.where(labels >= 0, labels, predicted),
        constants=constants,
        sure=jnp.asarray(1.0, points.dtype),
        turn=_NO_TURN if output.turn is None else log_odds(output.turn[0]),
    )
    return of_type(fix, points.dtype)


def estimate_measurement(
    variables, points, labels, category: Category, network: NetworkConfig
) -> PoseMeasurement:
    """The static estimator's answer; arguments as for ``measure``."""
    unit = category.unit
    prediction = estimate(variables, points[None] / unit, category, network)
    pose = jax.tree.map(lambda array: array[0], prediction.pose)
    poses = se3.from_rt(pose.rotation, pose.translation * unit)
    fix = PoseMeasurement(
        root=poses[0],
        joint_state=pose.joint_state * category.state_units,
        parts=se3.compose(se3.inverse(poses[0]), poses),
        labels=jnp.where(labels >= 0, labels, prediction.labels[0]),
        constants=ObjectParameters(
            axis=pose.joint_axis,
            pivot=pose.joint_pivot * unit,
            size=pose.size * unit,
            center=pose.box_center * unit,
            seen=jnp.asarray(1.0),
            known=jnp.zeros(category.num_joints),
        ),
        sure=prediction.confidence[0].min(),
        turn=_NO_TURN,
    )
    return of_type(fix, points.dtype)


def averaged(old: ObjectParameters, new: ObjectParameters) -> ObjectParameters:
    """Running means over the frames of a video."""
    seen = jnp.minimum(old.seen, _MEMORY)
    of_parts, of_joints = 1.0 / (seen + 1.0), 1.0 / (seen + old.known + 1.0)[:, None]
    return ObjectParameters(
        axis=linalg.unit(old.axis + of_joints * (new.axis - old.axis)),
        pivot=old.pivot + of_joints * (new.pivot - old.pivot),
        size=old.size + of_parts * (new.size - old.size),
        center=old.center + of_parts * (new.center - old.center),
        seen=old.seen + 1.0,
        known=old.known,
    )


def diagonal(constants: ObjectParameters):
    """[] length of the diagonal of the object's box at rest."""
    return jnp.maximum(rest_diagonal(jnp.abs(constants.size), constants.center), 1e-3)


def own_coordinates(fix: PoseMeasurement, points):
    """Points [N, 3] of the camera's frame, each in the frame of its part."""
    poses = se3.compose(fix.root, fix.parts)
    return se3.act(se3.inverse(poses)[fix.labels], points[:, None])[:, 0]


def box_residual(fix: PoseMeasurement, points):
    """Mean distance [] of points [N, 3] from the boxes of their parts, over the object's diagonal.

    The one thing in a pose that its own history cannot make look right: sizes are the category's.
    """
    own = own_coordinates(fix, points)
    sizes, centers = fix.constants.size[fix.labels], fix.constants.center[fix.labels]
    outside = jnp.maximum(jnp.abs(own - centers) - sizes / 2, 0.0)
    return linalg.norm(outside).mean() / diagonal(fix.constants)
