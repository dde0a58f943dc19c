"""One step of the tracker, (state, frame) -> (state, result): Algorithm 1 with its errata."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import Array as AnyArray
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import NetworkConfig, RegistrationConfig, TrackerConfig
from caper_jax.lie import se3
from caper_jax.models.gravity import class_log_weights
from caper_jax.models.pipeline import SMALLEST_SIZE
from caper_jax.models.plausibility import FEW_POINTS, PLAUSIBLE, log_size, rules, size_bounds
from caper_jax.models.rotation_classes import NUM_CUBE_ROTATIONS, log_odds
from caper_jax.tracking.keyframes import (
    add_log_odds,
    chamfer_energy,
    grow_surface,
    is_keyframe,
    keyframe_cloud,
    make_keyframe,
    poses_disagree,
    rebase_surface,
    tree_where,
    update_keyframe,
)
from caper_jax.tracking.measurement import (
    PoseMeasurement,
    box_residual,
    diagonal,
    joints_from_poses,
    measure,
    update_parameters,
    without_strays,
)
from caper_jax.tracking.registration import (
    JointTree,
    PartPoses,
    SurfaceMap,
    empty_surface,
    match_cost,
    register,
    suppress_jitter,
)
from caper_jax.tracking.state import Keyframe, ObjectParameters, Observation, TrackerState, of_type

_ACCEPTED = 1.3  # a box residual this many times the accepted one is inconsistent again
_GIVEN = 60.0  # nats against another rotation class of a pose that the user gave
_ENERGY_STRIDE = 2  # every second point enters the energy


@flax.struct.dataclass
class TrackResult:
    """Result of the tracker for one frame.

    Attributes:
      pose: ArticulatedPose [K, ...], meters, camera frame.
      labels: [N] int32 part of each point, -1 for strays (``geometry.outliers``).
      energy: [] Eq 16, relative to the object's diagonal.
      keyframe: [] bool, whether this frame became the keyframe.
      estimator_queried: [] bool, whether the single-frame estimator ran.
      lost: [] bool, the pose is not to be trusted: it is held from before, as the frame does not
        show the object or holds impossible numbers; or it is inconsistent with the frame.
      plausible: [] bool, whether this can be an object of the category, by this frame's size and
        number of points and by the last estimate of the single-frame estimator.
      reason: [] int32, why not, an index into ``plausibility.REASONS``.
      size_ratio: [] size of the cloud over that usual in the category.
      distinct_points: [] int32, how many different points the object has, strays left out.
    """

    pose: ArticulatedPose
    labels: Int[AnyArray, "*frames N"]
    energy: Float[AnyArray, "*frames"]
    keyframe: Bool[AnyArray, "*frames"]
    estimator_queried: Bool[AnyArray, "*frames"]
    lost: Bool[AnyArray, "*frames"]
    plausible: Bool[AnyArray, "*frames"]
    reason: Int[AnyArray, "*frames"]
    size_ratio: Float[AnyArray, "*frames"]
    distinct_points: Int[AnyArray, "*frames"]


def initial_state(category: Category, network: NetworkConfig, config: TrackerConfig):
    """The state before the first frame: the single-frame estimator gives that frame's pose."""
    parts, joints, points = category.num_parts, category.num_joints, network.num_points
    eye = jnp.eye(4)
    parameters = ObjectParameters(
        axis=jnp.tile(jnp.array([1.0, 0.0, 0.0]), (joints, 1)),
        pivot=jnp.zeros((joints, 3)),
        size=jnp.asarray(category.mean_size) * category.unit,
        center=jnp.asarray(category.mean_center) * category.unit,
        num_frames=jnp.asarray(0.0),
        known=jnp.zeros(joints),
    )
    keyframe = Keyframe(
        root=eye,
        joint_state=jnp.zeros(joints),
        parts=jnp.tile(eye, (parts, 1, 1)),
        points=jnp.zeros((points, 3)),
        labels=jnp.zeros(points, jnp.int32),
        age=jnp.asarray(0, jnp.int32),
    )
    state = TrackerState(
        root=eye.at[2, 3].set(category.unit),
        joint_state=jnp.zeros(joints),
        parts=keyframe.parts,
        root_velocity=jnp.zeros(6),
        joint_velocity=jnp.zeros(joints),
        parameters=parameters,
        variance=jnp.zeros(3),
        keyframe=keyframe,
        surface=empty_surface(config.registration),
        accepted_residual=jnp.zeros(()),
        num_inconsistent=jnp.asarray(0, jnp.int32),
        rotation_log_odds=jnp.zeros(NUM_CUBE_ROTATIONS),
        rotation_votes=jnp.zeros(NUM_CUBE_ROTATIONS),
        init_frames_left=jnp.asarray(0, jnp.int32),
        lost=jnp.asarray(True),
        reason=jnp.asarray(PLAUSIBLE, jnp.int32),
    )
    return of_type(state, eye.dtype)


def given_state(
    variables: dict[str, Any],
    frame: Observation,
    rotation,
    translation,
    category: Category,
    network: NetworkConfig,
    config: TrackerConfig,
) -> TrackerState:
    """The state after a first frame whose part poses are known (Algorithm 1, l. 1).

    Only the poses are taken; joint parameters, sizes and parts of the points come from the
    network, the joint states from the poses about the joints found.

    Args:
      variables: as ``estimator.estimate`` takes them.
      frame: the first frame.
      rotation: [K, 3, 3] part frame -> camera.
      translation: [K, 3] meters.
      category, network, config: static.
    """
    poses = se3.from_rt(rotation, translation * category.unit)
    root, parts = poses[0], se3.compose(se3.inverse(poses[0]), poses)
    points, labels, _ = without_strays(frame.points * category.unit, frame.labels)
    found = measure(variables, points, labels, root, category, network)
    states, parameters = joints_from_poses(parts, found.parameters, category)
    measurement = replace(found, root=root, parts=parts, joint_state=states, parameters=parameters)
    begin = initial_state(category, network, config)
    after = replace(
        begin,
        root=root,
        joint_state=measurement.joint_state,
        parts=parts,
        parameters=measurement.parameters,
        keyframe=make_keyframe(measurement, points),
        surface=grow_surface(begin.surface, measurement, points, config),
        rotation_log_odds=begin.rotation_log_odds - _GIVEN,
        rotation_votes=begin.rotation_votes - _GIVEN,
        lost=jnp.asarray(False),
    )
    return of_type(after, begin.root.dtype)


def track_step(
    variables: dict[str, Any],
    state: TrackerState,
    frame: Observation,
    category: Category,
    network: NetworkConfig,
    config: TrackerConfig,
) -> tuple[TrackerState, TrackResult]:
    """Tracks the object through one frame.

    Pure, of fixed shapes, without batch axes: jit it and call it in a loop, scan it over a
    recording, vmap it over videos, differentiate it (the matches of points and the decisions are
    piecewise constant). Reverse mode keeps the state of every frame and runs the frame again,
    rather than keep all that was computed in it: 45 kB instead of 70 MB per frame (1,024 points).

    Args:
      variables: as ``estimator.estimate`` takes them.
      state: from ``initial_state``, ``given_state`` or the last step.
      frame: the observation.
      category, network, config: static.

    Returns:
      The next state, and the result for this frame.
    """
    step = partial(_track_step, category=category, network=network, config=config)
    # A scan keeps the compiler from merging both runs: no barrier is needed.
    return jax.checkpoint(step, prevent_cse=False)(variables, state, frame)


def _track_step(
    variables: dict[str, Any],
    state: TrackerState,
    frame: Observation,
    *,
    category: Category,
    network: NetworkConfig,
    config: TrackerConfig,
) -> tuple[TrackerState, TrackResult]:
    key = state.keyframe
    # A frame without points runs through the same arithmetic, on points where the object was.
    stand_in = se3.act(state.root, key.points) + jnp.array([0.0, 0.0, 1e-3])
    points = jnp.where(frame.present, frame.points * category.unit, stand_in)
    points, labels, selection = without_strays(points, frame.labels)

    predicted = (
        se3.compose(state.root, se3.exp(config.damping * state.root_velocity)),
        state.joint_state + config.damping * state.joint_velocity,
    )
    reference = predicted[0] if config.use_prediction else key.root
    found = measure(variables, points, labels, reference, category, network)
    parameters = update_parameters(state.parameters, found.parameters)
    tree = JointTree(parameters.axis, parameters.pivot, category.joint_types, category.parents)

    root, joints = found.root, found.joint_state
    parts = PartPoses(tree, key.joint_state, key.parts)
    stride = config.registration.stride
    against = (state.surface, parts, points[::stride], found.labels[::stride])
    if config.registration.steps:
        start = _better_start(against, predicted, (root, joints), config)
        expected = _expectations(config.registration, predicted, (root, joints))
        root, joints, information = register(*against, start, expected, config.registration)
        root = suppress_jitter(state.root, root, information, config.registration.hold)
    joints = _bounded(joints, key.joint_state, category)
    tracked = PoseMeasurement(
        root,
        joints,
        parts.at(joints),
        found.labels,
        parameters,
        found.confidence,
        found.rotation_log_odds,
        state.reason,
    )
    new_odds = found.rotation_log_odds
    if frame.gravity is not None:
        new_odds += log_odds(class_log_weights(root[:3, :3], frame.gravity, category))
    # Frames show the same object from nearly the same side, so that each counts for little.
    summed = add_log_odds(state.rotation_log_odds, jnp.clip(new_odds, -1.0, 1.0), config)
    is_rotated = (summed.max() > config.flip_log_odds) & ~state.lost
    rotation_class = jnp.where(is_rotated, summed.argmax(), 0).astype(jnp.int32)

    unmatched = match_cost(*against, (root, joints), config.registration)
    residual = box_residual(tracked, points)
    is_inconsistent = (
        (unmatched > config.max_match_cost)
        | (residual > jnp.maximum(config.max_box_residual, _ACCEPTED * state.accepted_residual))
        | poses_disagree(root, found.root, config)
    )
    num_inconsistent = jnp.where(is_inconsistent, state.num_inconsistent + 1, 0)
    energy = chamfer_energy(
        se3.act(se3.inverse(root), points)[::_ENERGY_STRIDE],
        found.labels[::_ENERGY_STRIDE],
        keyframe_cloud(key, tracked)[::_ENERGY_STRIDE],
        key.labels[::_ENERGY_STRIDE],
        category.num_parts,
        diagonal(parameters),
    )
    due = is_keyframe(energy, unmatched, key.age, config) | (state.init_frames_left > 0)
    correction = update_keyframe(
        variables,
        points,
        labels,
        frame.gravity,
        tracked,
        residual,
        state,
        due,
        num_inconsistent,
        rotation_class,
        category,
        network,
        config,
    )
    measurement = correction.measurement
    accepted, replaced = correction.accepted, correction.replaced
    due |= replaced
    # After an estimate that does not count, the estimator is queried again in the next frame.
    settled = (num_inconsistent >= config.patience) & accepted
    left = jnp.maximum(state.init_frames_left - accepted, 0)
    # Without keyframes a frame knows of the last one only.
    restart = replaced | (config.policy == "none")
    surface = jax.lax.cond(
        due,
        lambda: grow_surface(
            rebase_surface(state.surface, tracked, measurement, restart, config),
            measurement,
            points,
            config,
        ),
        lambda: state.surface,
    )

    missed = se3.log(se3.compose(se3.inverse(predicted[0]), measurement.root))
    velocity = config.damping * state.root_velocity + config.velocity_gain * missed
    joint_velocity = config.damping * state.joint_velocity
    joint_velocity += config.velocity_gain * (measurement.joint_state - predicted[1])
    after = TrackerState(
        root=measurement.root,
        joint_state=measurement.joint_state,
        parts=measurement.parts,
        root_velocity=jnp.where(replaced, 0.0, velocity),
        joint_velocity=jnp.where(replaced, 0.0, joint_velocity),
        parameters=measurement.parameters,
        variance=correction.variance,
        keyframe=tree_where(due, make_keyframe(measurement, points), replace(key, age=key.age + 1)),
        surface=surface,
        accepted_residual=jnp.where(
            replaced,
            0.0,
            jnp.where(
                settled, jnp.maximum(residual, state.accepted_residual), state.accepted_residual
            ),
        ),
        # A pose from the estimator alone is provisional: one inconsistent frame undoes it.
        num_inconsistent=jnp.where(
            replaced, config.patience - 1, jnp.where(settled, 0, num_inconsistent)
        ),
        rotation_log_odds=jnp.where(replaced, 0.0, summed),
        rotation_votes=jnp.where(replaced, 0.0, correction.rotation_votes),
        init_frames_left=jnp.where(replaced, config.init_frames, left).astype(jnp.int32),
        lost=jnp.asarray(False),
        reason=measurement.reason,
    )
    held = replace(
        state,
        root_velocity=jnp.zeros_like(state.root_velocity),
        joint_velocity=jnp.zeros_like(state.joint_velocity),
    )
    # Numbers that overflowed on the way would stay for good.
    usable = frame.present & _finite(after)
    after = tree_where(usable, after, held)
    distinct = selection.inliers.distinct
    size = log_size(points[None], category)
    classifier = variables["params"].get("plausibility")
    reason = rules(measurement.reason[None], size, distinct, len(points), classifier)[0]
    reason = jnp.where(frame.present, reason, FEW_POINTS).astype(jnp.int32)
    return after, TrackResult(
        pose=_articulated_pose(after, category),
        labels=selection.spread_labels(measurement.labels[None])[0],
        energy=energy,
        keyframe=due & usable,
        estimator_queried=correction.estimator_queried & usable,
        lost=~usable | (is_inconsistent & ~replaced),
        plausible=reason == PLAUSIBLE,
        reason=reason,
        size_ratio=jnp.exp(size[0] - size_bounds(classifier)[1]),
        distinct_points=jnp.where(frame.present, distinct[0], 0),
    )


def _bounded(joints, begun, category: Category):
    """Joint states [J] within ``Category.state_bounds``, or as far beyond as the keyframe's."""
    low, high = category.network_state_bounds.T.astype(joints.dtype)
    return jnp.clip(joints, jnp.minimum(low, begun), jnp.maximum(high, begun))


def _finite(tree):
    """[] bool, whether every number of a pytree is."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


def _expectations(config: RegistrationConfig, predicted, found):
    """What registration is drawn to: pairs of a pose and its standard deviations [6 + J]."""
    joints = predicted[1].shape[0]
    of_prediction = (config.root_rotation, config.root_translation, config.joint)
    of_network = (config.network_rotation, config.network_translation, config.network_joint)
    return tuple(
        (pose, jnp.array([turn] * 3 + [shift] * 3 + [joint] * joints))
        for pose, (turn, shift, joint) in ((predicted, of_prediction), (found, of_network))
    )


def _better_start(
    against: tuple[SurfaceMap, PartPoses, Any, Any], predicted, found, config: TrackerConfig
):
    """The prediction or the network's answer, whichever lies closer to the keyframe's surface."""
    costs = [match_cost(*against, start, config.registration) for start in (predicted, found)]
    return tree_where(costs[1] < costs[0], found, predicted)


def _articulated_pose(state: TrackerState, category: Category) -> ArticulatedPose:
    """The pose in meters."""
    unit = category.unit
    poses = se3.compose(state.root, state.parts)
    return ArticulatedPose(
        rotation=poses[:, :3, :3],
        translation=poses[:, :3, 3] / unit,
        size=jnp.maximum(
            state.parameters.size / unit, SMALLEST_SIZE * jnp.asarray(category.mean_size)
        ),
        box_center=state.parameters.center / unit,
        joint_axis=state.parameters.axis,
        joint_pivot=state.parameters.pivot / unit,
        joint_state=state.joint_state / category.state_units,
    )
