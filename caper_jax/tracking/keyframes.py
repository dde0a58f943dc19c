"""Keyframes (paper Sec 5.3.2): when there is a new one, and what its pose is."""

from __future__ import annotations

from dataclasses import replace

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from caper_jax.config import TrackerConfig
from caper_jax.lie import linalg, se3, so3
from caper_jax.models.encoders.neighbors import squared_distances
from caper_jax.models.rotation_classes import (
    CUBE_ROTATIONS,
    NUM_CUBE_ROTATIONS,
    nearest_cube_rotation,
    rotate_pose,
)
from caper_jax.tracking.measurement import (
    PoseMeasurement,
    box_residual,
    estimate_measurement,
    measure,
    part_coordinates,
)
from caper_jax.tracking.registration import (
    SurfaceMap,
    empty_surface,
    extend_surface,
    move_surface,
)
from caper_jax.tracking.state import Keyframe, TrackerState

_LONG = 2  # frames beyond the patience after which an unconfident estimate counts as well
_BETTER = 0.6  # box_residual of an estimate over the track's, at which it may replace the track


def is_keyframe(energy, unmatched, age, config: TrackerConfig):
    """Whether the policy wants this frame as keyframe.

    Args:
      energy: [] Eq 16.
      unmatched: [] share of points off the surface.
      age: [] frames since the last keyframe.
      config: static.
    """
    if config.policy == "none":
        return jnp.asarray(True)
    if config.policy == "fixed":
        return age + 1 >= config.interval
    return (energy > config.threshold) | (unmatched > config.max_unmatched)


def poses_disagree(first, second, config: TrackerConfig):
    """Whether two root poses [4, 4] contradict each other, not only differ."""
    turn = so3.geodesic_distance(first[:3, :3], second[:3, :3])
    shift = linalg.norm(first[:3, 3] - second[:3, 3])
    return (turn > jnp.radians(config.gate_deg)) | (shift > config.gate)


@flax.struct.dataclass
class Correction:
    """Result of ``update_keyframe``.

    Attributes:
      measurement: the pose.
      variance: [3] of the state.
      rotation_votes: [24] of the state.
      estimator_queried: [] bool, whether the single-frame estimator ran.
      accepted: [] bool, whether its estimate counts: it was confident, or the track had long been
        inconsistent.
      replaced: [] bool, whether the estimate took the place of the track.
    """

    measurement: PoseMeasurement
    variance: Float[Array, "3"]
    rotation_votes: Float[Array, "24"]
    estimator_queried: Bool[Array, ""]
    accepted: Bool[Array, ""]
    replaced: Bool[Array, ""]


def update_keyframe(
    variables,
    points,
    labels,
    gravity,
    tracked: PoseMeasurement,
    residual,
    state: TrackerState,
    due,
    num_inconsistent,
    rotation_class,
    category,
    network,
    config: TrackerConfig,
) -> Correction:
    """The pose of a frame that may be a keyframe: the track's, the estimator's, or between them.

    While the track is consistent, the estimate is fused with it by their variances, one Kalman step
    on the manifold. Where the track is lost, or inconsistent and with a larger box residual than
    the estimate, the estimate replaces it. Where the track is off by one of the rotation classes,
    according to stage II or to the votes of the first estimates, the measurement of stage II after
    that rotation replaces it.

    Args:
      variables, points, labels, category, network: as for ``measurement.measure``.
      gravity: of the observation.
      tracked: the track's pose.
      residual: [] the track's ``box_residual`` in this frame.
      state: before this frame.
      due: [] bool, the policy wants a keyframe.
      num_inconsistent: [] int32, frames in a row, this one included, that contradicted the track;
        from ``patience`` on the estimator is queried.
      rotation_class: [] int32, by which rotation the track is off; 0: by none.
      config: static.
    """
    inconsistent = num_inconsistent >= config.patience
    queried = state.lost | inconsistent | (state.init_frames_left > 0)
    if config.policy in ("fixed", "dynamic"):
        queried |= due
    static = jax.lax.cond(
        queried,
        lambda: estimate_measurement(variables, points, labels, gravity, category, network),
        lambda: tracked,
    )
    reason = static.reason  # before stage II, which has none, takes the estimate's place
    accepted = queried & (
        (static.confidence >= config.min_confidence) | (num_inconsistent >= config.patience + _LONG)
    )
    # Later the track has seen more than a single frame shows.
    votes = vote_rotation(state.rotation_votes, tracked.root, static.root, config)
    votes = jnp.where(accepted & (state.init_frames_left > 0), votes, state.rotation_votes)
    outvoted = (votes.max() > config.flip_log_odds) & ~state.lost & (rotation_class == 0)
    rotation_class = jnp.where(outvoted, votes.argmax().astype(jnp.int32), rotation_class)
    reference = rotate_pose(
        tracked.root, jnp.asarray(CUBE_ROTATIONS, tracked.root.dtype)[rotation_class]
    )
    static = jax.lax.cond(
        rotation_class > 0,
        lambda: measure(variables, points, labels, reference, category, network),
        lambda: static,
    )
    better = box_residual(static, points) < _BETTER * residual
    replaced = state.lost | (inconsistent & accepted & better) | (rotation_class > 0)

    static_variance = jnp.square(
        jnp.array([config.static_rotation, config.static_translation, config.static_joint])
    )
    drift = jnp.array([config.drift_rotation, config.drift_translation, config.drift_joint])
    grown = state.variance + jnp.where(due, jnp.square(drift), 0.0)
    if config.kalman:
        # Poses that disagree are not averaged: a mean of the two is neither.
        apart = poses_disagree(tracked.root, static.root, config)
        gain = jnp.where(apart | ~accepted, 0.0, grown / (grown + static_variance))
    else:
        gain = jnp.ones(3)
    gain = jnp.where(queried, gain, 0.0)

    correction = se3.log(se3.compose(se3.inverse(tracked.root), static.root))
    correction *= jnp.repeat(gain[:2], 3, total_repeat_length=6)
    fused = PoseMeasurement(
        root=se3.compose(tracked.root, se3.exp(correction)),
        joint_state=tracked.joint_state + gain[2] * (static.joint_state - tracked.joint_state),
        parts=se3.interpolate(tracked.parts, static.parts, gain[2]),
        labels=tracked.labels,
        parameters=tracked.parameters,
        confidence=tracked.confidence,
        rotation_log_odds=tracked.rotation_log_odds,
        reason=jnp.where(queried, reason, tracked.reason),
    )
    measurement = replace(tree_where(replaced, static, fused), reason=fused.reason)
    # (1 - gain) grown, which would cancel where the gain is nearly one.
    left = jnp.where(gain > 0, gain * static_variance, grown)
    variance = jnp.where(replaced, static_variance, left)
    return Correction(measurement, variance, votes, queried, accepted, replaced)


def vote_rotation(before, tracked, static, config: TrackerConfig):
    """Log odds [24] that a track is off by each rotation class, after one more estimate.

    What a closed object hides must not weigh more than what the open one then shows: there is a
    least value, and the same for what stage II says.

    Args:
      before: [24] the votes so far.
      tracked, static: [4, 4] root poses.
      config: static.
    """
    index, left = nearest_cube_rotation(tracked[:3, :3], static[:3, :3])
    votes = (
        jnp.where(jnp.arange(NUM_CUBE_ROTATIONS) == index, config.log_odds, -config.log_odds)
        .at[0]
        .set(0.0)
    )
    votes = jnp.where(left < jnp.radians(config.gate_deg), votes, 0.0)
    return add_log_odds(before, votes, config)


def add_log_odds(before, votes, config: TrackerConfig):
    """Log odds [24] of rotation classes after one more frame, bounded from below."""
    return jnp.maximum(before + votes, jnp.minimum(before, -config.flip_log_odds))


def make_keyframe(measurement: PoseMeasurement, points) -> Keyframe:
    """A frame of this pose and cloud [N, 3] as keyframe."""
    return Keyframe(
        root=measurement.root,
        joint_state=measurement.joint_state,
        parts=measurement.parts,
        points=se3.act(se3.inverse(measurement.root), points),
        labels=measurement.labels,
        age=jnp.asarray(0, jnp.int32),
    )


def keyframe_cloud(key: Keyframe, measurement: PoseMeasurement):
    """The keyframe's cloud [N, 3], each part moved by its increment, in the root's frame."""
    motions = se3.compose(measurement.parts, se3.inverse(key.parts))
    return se3.act(motions[key.labels], key.points[:, None])[:, 0]


def grow_surface(
    surface: SurfaceMap, measurement: PoseMeasurement, points, config: TrackerConfig
) -> SurfaceMap:
    """The surface and what a new keyframe shows of it for the first time."""
    return extend_surface(
        surface, part_coordinates(measurement, points), measurement.labels, config.registration
    )


def rebase_surface(
    surface: SurfaceMap,
    tracked: PoseMeasurement,
    measurement: PoseMeasurement,
    restart,
    config: TrackerConfig,
) -> SurfaceMap:
    """The surface where it was in the camera frame, in the corrected frames of the parts.

    At a ``restart`` it is empty: an estimate that replaces the track makes its frames worthless.
    """
    old, new = (se3.compose(f.root, f.parts) for f in (tracked, measurement))
    moved = move_surface(surface, se3.compose(se3.inverse(new), old))
    return tree_where(restart, empty_surface(config.registration), moved)


def tree_where(condition, yes, no):
    """``where`` for whole pytrees."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def chamfer_energy(points, labels, key_points, key_labels, num_parts: int, size):
    """Mean over parts of the two-way Chamfer distance, relative to the object's size.

    Both clouds are in one frame, the keyframe's moved by each part's increment (errata: the paper
    mixes frames). Distances are not squared; each way is a mean over the part's points, and the
    two ways are averaged. Parts that either cloud does not show are left out.

    Args:
      points: [N, 3]; labels: [N] int32.
      key_points: [M, 3]; key_labels: [M] int32.
      num_parts: K.
      size: [] the object's diagonal, in the unit of the points.

    Returns:
      []; zero when no part is shown in both.
    """
    squared = squared_distances(points[None], key_points[None])[0]
    squared = jnp.where(labels[:, None] == key_labels, squared, jnp.inf)
    parts = jnp.arange(num_parts)
    first, count = _mean_by_part(squared.min(1), labels, parts)
    second, key_count = _mean_by_part(squared.min(0), key_labels, parts)
    both = (count > 0) & (key_count > 0)
    total = jnp.where(both, 0.5 * (first + second), 0.0).sum()
    return total / jnp.maximum(both.sum(), 1) / size


def _mean_by_part(squared, labels, parts):
    """(mean distance [K], number of points [K]) of the points that have a partner."""
    found = jnp.isfinite(squared) & (squared > 0)
    distance = jnp.where(found, jnp.sqrt(jnp.where(found, squared, 1.0)), 0.0)
    member = (labels[:, None] == parts) & jnp.isfinite(squared)[:, None]
    count = member.sum(0)
    return (distance[:, None] * member).sum(0) / jnp.maximum(count, 1), count
