"""One step of the tracker, (state, frame) -> (state, result): Algorithm 1 with its errata."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.estimator import estimate
from caper_jax.geometry import linalg, se3, so3
from caper_jax.networks.canonical import canonicalise
from caper_jax.networks.caper import NetworkConfig, PartsNetwork
from caper_jax.networks.increment import increment_transform
from caper_jax.networks.voting import vote
from caper_jax.tracking.config import TrackerConfig
from caper_jax.tracking.energy import chamfer_energy
from caper_jax.tracking.joints import joints_from_poses
from caper_jax.tracking.registration import (
    PartPoses,
    RegistrationConfig,
    Surface,
    Tree,
    empty_surface,
    extend_surface,
    hold_still,
    mismatch,
    move_surface,
    part_poses,
    register,
)
from caper_jax.tracking.state import Constants, Keyframe, Observation, TrackerState

_MEMORY = 60.0  # frames over which joint parameters and sizes are averaged
_ENERGY_STRIDE = 2  # every so-manieth point enters the energy


@flax.struct.dataclass
class Tracked:
    """What the tracker says about one frame.

    Attributes:
      pose: ArticulatedPose [K, ...], metres, camera frame; the last one where ``lost``.
      labels: [N] int32 part of each point.
      energy: [] Eq 16, relative to the object's diagonal.
      keyframe: [] bool, whether this frame became the keyframe.
      estimated: [] bool, whether the static estimator was asked.
      lost: [] bool, the pose is held from before, or was found again in this very frame.
    """

    pose: ArticulatedPose
    labels: Any
    energy: Any
    keyframe: Any
    estimated: Any
    lost: Any


@flax.struct.dataclass
class _Fix:
    """A pose of the object in one frame, from whatever source; network units."""

    root: Any
    joint_state: Any
    parts: Any
    labels: Any
    constants: Constants


def initial_state(category: Category, network: NetworkConfig, config: TrackerConfig):
    """The state before the first frame: the static estimator gives that frame's pose."""
    parts, joints, points = category.num_parts, category.num_joints, network.num_points
    eye = jnp.eye(4)
    constants = Constants(
        axis=jnp.tile(jnp.array([1.0, 0.0, 0.0]), (joints, 1)),
        pivot=jnp.zeros((joints, 3)),
        size=jnp.asarray(category.mean_size, jnp.float32) * category.unit,
        center=jnp.asarray(category.mean_center, jnp.float32) * category.unit,
        seen=jnp.asarray(0.0),
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
    return TrackerState(
        root=eye.at[2, 3].set(category.unit),
        joint_state=jnp.zeros(joints),
        parts=keyframe.parts,
        root_velocity=jnp.zeros(6),
        joint_velocity=jnp.zeros(joints),
        constants=constants,
        variance=jnp.zeros(3),
        keyframe=keyframe,
        surface=empty_surface(config.registration),
        doubtful=jnp.asarray(0, jnp.int32),
        lost=jnp.asarray(True),
    )


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
      translation: [K, 3] metres.
      category, network, config: static.
    """
    poses = se3.from_rt(rotation, translation * category.unit)
    root, parts = poses[0], se3.compose(se3.inverse(poses[0]), poses)
    points = frame.points * category.unit
    found = _measure(variables, points, frame.labels, root, category, network)
    states, constants = joints_from_poses(parts, found.constants, category)
    fix = replace(found, root=root, parts=parts, joint_state=states, constants=constants)
    begin = initial_state(category, network, config)
    return replace(
        begin,
        root=root,
        joint_state=fix.joint_state,
        parts=parts,
        constants=fix.constants,
        keyframe=_make_keyframe(fix, points),
        surface=_extended(begin.surface, fix, points, config),
        lost=jnp.asarray(False),
    )


def track_step(
    variables: dict[str, Any],
    state: TrackerState,
    frame: Observation,
    category: Category,
    network: NetworkConfig,
    config: TrackerConfig,
) -> tuple[TrackerState, Tracked]:
    """Tracks the object through one frame.

    Pure, of fixed shapes, without batch axes: jit it and call it in a loop, scan it over a
    recording, vmap it over videos, differentiate it (the matches of points and the decisions are
    piecewise constant).

    Args:
      variables: as ``estimator.estimate`` takes them.
      state: from ``initial_state``, ``given_state`` or the last step.
      frame: the observation.
      category, network, config: static.

    Returns:
      The next state, and what was found in this frame.
    """
    key = state.keyframe
    # A frame without points runs through the same arithmetic, on points where the object was.
    stand_in = se3.act(state.root, key.points) + jnp.array([0.0, 0.0, 1e-3])
    points = jnp.where(frame.present, frame.points * category.unit, stand_in)

    predicted = (
        se3.compose(state.root, se3.exp(config.damping * state.root_velocity)),
        state.joint_state + config.damping * state.joint_velocity,
    )
    reference = predicted[0] if config.anchored else key.root
    found = _measure(variables, points, frame.labels, reference, category, network)
    constants = _averaged(state.constants, found.constants)
    tree = Tree(constants.axis, constants.pivot, category.joint_types, category.parents)

    root, joints = found.root, found.joint_state
    parts = PartPoses(tree, key.joint_state, key.parts)
    stride = config.registration.stride
    against = (state.surface, parts, points[::stride], found.labels[::stride])
    if config.registration.steps:
        start = _better_start(against, predicted, (root, joints), config)
        expected = _expectations(config.registration, predicted, (root, joints))
        root, joints, information = register(*against, start, expected, config.registration)
        root = hold_still(state.root, root, information, config.registration.hold)
    tracked = _Fix(root, joints, parts.at(joints), found.labels, constants)

    unmatched = mismatch(*against, (root, joints), config.registration)
    contradicted = (unmatched > config.mismatch) | _apart(root, found.root, config)
    doubtful = jnp.where(contradicted, state.doubtful + 1, 0)
    lost = state.lost | (doubtful >= config.patience)
    energy = chamfer_energy(
        se3.act(se3.inverse(root), points)[::_ENERGY_STRIDE],
        found.labels[::_ENERGY_STRIDE],
        _moved(key, tracked)[::_ENERGY_STRIDE],
        key.labels[::_ENERGY_STRIDE],
        category.num_parts,
        _diagonal(constants),
    )
    due = _due(energy, unmatched, key.age, config) | lost
    fix, variance, estimated = _keyframe_fix(
        variables,
        points,
        frame.labels,
        tracked,
        state.variance,
        due,
        lost,
        category,
        network,
        config,
    )
    made = _make_keyframe(fix, points)
    kept = replace(key, age=key.age + 1)
    surface = jax.lax.cond(
        due,
        lambda: _extended(_rebased(state.surface, tracked, fix, lost, config), fix, points, config),
        lambda: state.surface,
    )

    missed = se3.log(se3.compose(se3.inverse(predicted[0]), fix.root))
    velocity = config.damping * state.root_velocity + config.velocity_gain * missed
    joint_velocity = config.damping * state.joint_velocity
    joint_velocity += config.velocity_gain * (fix.joint_state - predicted[1])
    after = TrackerState(
        root=fix.root,
        joint_state=fix.joint_state,
        parts=fix.parts,
        root_velocity=jnp.where(lost, 0.0, velocity),
        joint_velocity=jnp.where(lost, 0.0, joint_velocity),
        constants=fix.constants,
        variance=variance,
        keyframe=_where(due, made, kept),
        surface=surface,
        # A pose from the static estimator alone is on trial: one contradiction undoes it.
        doubtful=jnp.where(lost, config.patience - 1, doubtful),
        lost=jnp.asarray(False),
    )
    held = replace(
        state,
        root_velocity=jnp.zeros_like(state.root_velocity),
        joint_velocity=jnp.zeros_like(state.joint_velocity),
    )
    after = _where(frame.present, after, held)
    return after, Tracked(
        pose=_articulated_pose(after, category),
        labels=fix.labels,
        energy=energy,
        keyframe=due & frame.present,
        estimated=estimated & frame.present,
        lost=after.lost | ~frame.present,
    )


def _measure(variables, points, labels, reference, category, network) -> _Fix:
    """Stage II on the proxy-canonicalised cloud: increment from the reference and all the rest."""
    own = {name: collection["parts"] for name, collection in variables.items()}
    cloud = canonicalise(points[None], reference[None, :3, :3], reference[None, :3, 3])
    module = PartsNetwork(network, category.num_parts)
    output: Any = module.apply(own, cloud, train=False)
    axis, pivot = vote(cloud, output.heatmap, output.offset, output.direction)
    increment = increment_transform(output.increment[0], network.increment)
    predicted = output.segmentation[0].argmax(-1).astype(jnp.int32)
    unit = category.unit
    constants = Constants(
        axis=axis[0],
        pivot=pivot[0],
        size=jnp.asarray(category.mean_size) * unit + output.size[0],
        center=jnp.asarray(category.mean_center) * unit + output.center[0],
        seen=jnp.asarray(1.0),
        known=jnp.zeros(category.num_joints),
    )
    tree = Tree(axis[0], pivot[0], category.joint_types, category.parents)
    return _Fix(
        root=se3.compose(reference, increment),
        joint_state=output.state[0],
        parts=part_poses(tree, output.state[0]),
        labels=jnp.where(labels >= 0, labels, predicted),
        constants=constants,
    )


def _estimate(variables, points, labels, category, network) -> _Fix:
    """The static estimator's answer for a cloud in network units."""
    unit = category.unit
    prediction = estimate(variables, points[None] / unit, category, network)
    pose = jax.tree.map(lambda array: array[0], prediction.pose)
    length = jnp.array([unit if kind == "prismatic" else 1.0 for kind in category.joint_types])
    poses = se3.from_rt(pose.rotation, pose.translation * unit)
    return _Fix(
        root=poses[0],
        joint_state=pose.joint_state * length,
        parts=se3.compose(se3.inverse(poses[0]), poses),
        labels=jnp.where(labels >= 0, labels, prediction.labels[0]),
        constants=Constants(
            axis=pose.joint_axis,
            pivot=pose.joint_pivot * unit,
            size=pose.size * unit,
            center=pose.box_center * unit,
            seen=jnp.asarray(1.0),
            known=jnp.zeros(category.num_joints),
        ),
    )


def _averaged(old: Constants, new: Constants) -> Constants:
    """Running means over the frames of a video."""
    seen = jnp.minimum(old.seen, _MEMORY)
    of_parts, of_joints = 1.0 / (seen + 1.0), 1.0 / (seen + old.known + 1.0)[:, None]
    return Constants(
        axis=linalg.unit(old.axis + of_joints * (new.axis - old.axis)),
        pivot=old.pivot + of_joints * (new.pivot - old.pivot),
        size=old.size + of_parts * (new.size - old.size),
        center=old.center + of_parts * (new.center - old.center),
        seen=old.seen + 1.0,
        known=old.known,
    )


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
    against: tuple[Surface, PartPoses, Any, Any], predicted, found, config: TrackerConfig
):
    """The prediction or the network's answer, whichever lies closer to the keyframe's surface."""
    costs = [mismatch(*against, start, config.registration) for start in (predicted, found)]
    return _where(costs[1] < costs[0], found, predicted)


def _apart(first, second, config: TrackerConfig):
    """Whether two root poses contradict each other."""
    turn = so3.geodesic_distance(first[:3, :3], second[:3, :3])
    shift = linalg.norm(first[:3, 3] - second[:3, 3])
    return (turn > jnp.radians(config.gate_deg)) | (shift > config.gate)


def _due(energy, unmatched, age, config: TrackerConfig):
    """Whether the policy wants a new keyframe."""
    if config.policy == "none":
        return jnp.asarray(True)
    if config.policy == "fixed":
        return age + 1 >= config.interval
    return (energy > config.threshold) | (unmatched > config.unseen)


def _keyframe_fix(
    variables, points, labels, tracked: _Fix, variance, due, lost, category, network, config
):
    """The pose of a frame that may be a keyframe, its variance [3], whether it was estimated."""
    asks = lost | due if config.policy in ("fixed", "dynamic") else lost
    static = jax.lax.cond(
        asks,
        lambda: _estimate(variables, points, labels, category, network),
        lambda: tracked,
    )
    static_variance = jnp.square(
        jnp.array([config.static_rotation, config.static_translation, config.static_joint])
    )
    drift = jnp.array([config.drift_rotation, config.drift_translation, config.drift_joint])
    grown = variance + jnp.where(due, jnp.square(drift), 0.0)
    gain = grown / (grown + static_variance) if config.filtered else jnp.ones(3)
    # One that contradicts the track is not averaged in: a mean of two poses is neither.
    gain = jnp.where(_apart(tracked.root, static.root, config), 0.0, gain)
    gain = jnp.where(asks, jnp.where(lost, 1.0, gain), 0.0)

    correction = se3.log(se3.compose(se3.inverse(tracked.root), static.root))
    correction *= jnp.repeat(gain[:2], 3, total_repeat_length=6)
    fused = _Fix(
        root=se3.compose(tracked.root, se3.exp(correction)),
        joint_state=tracked.joint_state + gain[2] * (static.joint_state - tracked.joint_state),
        parts=se3.interpolate(tracked.parts, static.parts, gain[2]),
        labels=tracked.labels,
        constants=tracked.constants,
    )
    fix = _where(lost, static, fused)
    return fix, jnp.where(lost, static_variance, (1.0 - gain) * grown), asks


def _make_keyframe(fix: _Fix, points) -> Keyframe:
    return Keyframe(
        root=fix.root,
        joint_state=fix.joint_state,
        parts=fix.parts,
        points=se3.act(se3.inverse(fix.root), points),
        labels=fix.labels,
        age=jnp.asarray(0, jnp.int32),
    )


def _moved(key: Keyframe, fix: _Fix):
    """The keyframe's cloud [N, 3], each part moved by its increment, in the root's frame."""
    motions = se3.compose(fix.parts, se3.inverse(key.parts))
    return se3.act(motions[key.labels], key.points[:, None])[:, 0]


def _extended(surface: Surface, fix: _Fix, points, config: TrackerConfig) -> Surface:
    poses = se3.compose(fix.root, fix.parts)
    own = se3.act(se3.inverse(poses)[fix.labels], points[:, None])[:, 0]
    return extend_surface(surface, own, fix.labels, config.registration)


def _rebased(surface: Surface, tracked: _Fix, fix: _Fix, lost, config: TrackerConfig) -> Surface:
    """The surface where it was in the camera's frame, said in corrected part frames.

    An estimate that replaces the track says that those frames meant nothing: nothing is kept.
    """
    old, new = (se3.compose(f.root, f.parts) for f in (tracked, fix))
    moved = move_surface(surface, se3.compose(se3.inverse(new), old))
    return _where(lost, empty_surface(config.registration), moved)


def _diagonal(constants: Constants):
    """Length of the diagonal of the object's box at rest."""
    half = jnp.abs(constants.size) / 2
    low, high = (constants.center - half).min(0), (constants.center + half).max(0)
    return jnp.maximum(linalg.norm(high - low), 1e-3)


def _articulated_pose(state: TrackerState, category: Category) -> ArticulatedPose:
    """The pose in metres."""
    unit = category.unit
    length = jnp.array([1 / unit if kind == "prismatic" else 1.0 for kind in category.joint_types])
    poses = se3.compose(state.root, state.parts)
    return ArticulatedPose(
        rotation=poses[:, :3, :3],
        translation=poses[:, :3, 3] / unit,
        size=jnp.maximum(state.constants.size / unit, 0.01 * jnp.asarray(category.mean_size)),
        box_center=state.constants.center / unit,
        joint_axis=state.constants.axis,
        joint_pivot=state.constants.pivot / unit,
        joint_state=state.joint_state * length,
    )


def _where(condition, yes, no):
    """Leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
