"""Keyframes (paper Sec 5.3.2): when there is a new one, and what its pose is."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

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
    own_coordinates,
)
from caper_jax.tracking.registration import (
    SurfaceMap,
    empty_surface,
    extend_surface,
    move_surface,
)
from caper_jax.tracking.state import Keyframe, TrackerState

_LONG = 2  # frames beyond the patience after which an estimate that is not sure counts as well
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
    """What ``corrected`` makes of a frame.

    Attributes:
      fix: the pose.
      variance: [3] of the state.
      vote: [24] of the state.
      asked: [] bool, whether the static estimator was asked.
      sure: [] bool, whether its answer counts, as it was sure or the track long doubted.
      replaced: [] bool, whether the track gave way altogether.
    """

    fix: PoseMeasurement
    variance: Any
    vote: Any
    asked: Any
    sure: Any
    replaced: Any


def corrected(
    variables,
    points,
    labels,
    tracked: PoseMeasurement,
    outside,
    state: TrackerState,
    due,
    num_inconsistent,
    turned,
    category,
    network,
    config: TrackerConfig,
) -> Correction:
    """The pose of a frame that may be a keyframe: the track's, the estimator's, or between them.

    Where the track is in order, the static estimator's pose is weighed against it by their
    variances, one Kalman step on the manifold; where it is lost, or doubted and worse than the
    estimate by its own measure, the estimate replaces it. Where it is off by a whole turn, by what
    stage II saw or as estimates outvoted a start on trial, what stage II sees after that turn does.

    Args:
      variables, points, labels, category, network: as for ``fix.measure``.
      tracked: the track's pose.
      outside: [] the track's ``box_residual`` in this frame.
      state: before this frame.
      due: [] bool, the policy wants a keyframe.
      num_inconsistent: [] int32, frames in a row, this one included, that contradicted the track;
        from ``patience`` on it is doubted.
      turned: [] int32, by which turn the track is off; 0: by none.
      config: static.
    """
    doubted = num_inconsistent >= config.patience
    asked = state.lost | doubted | (state.trial > 0)
    if config.policy in ("fixed", "dynamic"):
        asked |= due
    static = jax.lax.cond(
        asked,
        lambda: estimate_measurement(variables, points, labels, category, network),
        lambda: tracked,
    )
    sure = asked & (
        (static.sure >= config.min_confidence) | (num_inconsistent >= config.patience + _LONG)
    )
    # Later the track has seen more than a single frame shows.
    votes = turn_votes(state.vote, tracked.root, static.root, config)
    vote = jnp.where(sure & (state.trial > 0), votes, state.vote)
    outvoted = (vote.max() > config.flip_log_odds) & ~state.lost & (turned == 0)
    turned = jnp.where(outvoted, vote.argmax().astype(jnp.int32), turned)
    reference = rotate_pose(tracked.root, jnp.asarray(CUBE_ROTATIONS, tracked.root.dtype)[turned])
    static = jax.lax.cond(
        turned > 0,
        lambda: measure(variables, points, labels, reference, category, network),
        lambda: static,
    )
    better = box_residual(static, points) < _BETTER * outside
    replaced = state.lost | (doubted & sure & better) | (turned > 0)

    static_variance = jnp.square(
        jnp.array([config.static_rotation, config.static_translation, config.static_joint])
    )
    drift = jnp.array([config.drift_rotation, config.drift_translation, config.drift_joint])
    grown = state.variance + jnp.where(due, jnp.square(drift), 0.0)
    if config.kalman:
        # One that poses_disagree the track is not averaged in: a mean of two poses is neither.
        apart = poses_disagree(tracked.root, static.root, config)
        gain = jnp.where(apart | ~sure, 0.0, grown / (grown + static_variance))
    else:
        gain = jnp.ones(3)
    gain = jnp.where(asked, gain, 0.0)

    correction = se3.log(se3.compose(se3.inverse(tracked.root), static.root))
    correction *= jnp.repeat(gain[:2], 3, total_repeat_length=6)
    fused = PoseMeasurement(
        root=se3.compose(tracked.root, se3.exp(correction)),
        joint_state=tracked.joint_state + gain[2] * (static.joint_state - tracked.joint_state),
        parts=se3.interpolate(tracked.parts, static.parts, gain[2]),
        labels=tracked.labels,
        constants=tracked.constants,
        sure=tracked.sure,
        turn=tracked.turn,
    )
    fix = tree_where(replaced, static, fused)
    # (1 - gain) grown, which would cancel where the gain is nearly one.
    left = jnp.where(gain > 0, gain * static_variance, grown)
    variance = jnp.where(replaced, static_variance, left)
    return Correction(fix, variance, vote, asked, sure, replaced)


def turn_votes(before, tracked, static, config: TrackerConfig):
    """Log odds [24] of turns of a track after a static estimate that differs from it.

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
    return added(before, votes, config)


def added(before, votes, config: TrackerConfig):
    """Log odds [24] of turns and what one frame adds, from a least value up."""
    return jnp.maximum(before + votes, jnp.minimum(before, -config.flip_log_odds))


def make_keyframe(fix: PoseMeasurement, points) -> Keyframe:
    """A frame of this pose and cloud [N, 3] as keyframe."""
    return Keyframe(
        root=fix.root,
        joint_state=fix.joint_state,
        parts=fix.parts,
        points=se3.act(se3.inverse(fix.root), points),
        labels=fix.labels,
        age=jnp.asarray(0, jnp.int32),
    )


def moved_cloud(key: Keyframe, fix: PoseMeasurement):
    """The keyframe's cloud [N, 3], each part moved by its increment, in the root's frame."""
    motions = se3.compose(fix.parts, se3.inverse(key.parts))
    return se3.act(motions[key.labels], key.points[:, None])[:, 0]


def grown_surface(
    surface: SurfaceMap, fix: PoseMeasurement, points, config: TrackerConfig
) -> SurfaceMap:
    """The surface with what a new keyframe shows of it for the first time."""
    return extend_surface(surface, own_coordinates(fix, points), fix.labels, config.registration)


def rebased_surface(
    surface: SurfaceMap, tracked: PoseMeasurement, fix: PoseMeasurement, anew, config: TrackerConfig
) -> SurfaceMap:
    """The surface where it was in the camera's frame, said in corrected part frames.

    Nothing is kept where it begins ``anew``: an estimate that replaces the track says that its
    frames meant nothing.
    """
    old, new = (se3.compose(f.root, f.parts) for f in (tracked, fix))
    moved = move_surface(surface, se3.compose(se3.inverse(new), old))
    return tree_where(anew, empty_surface(config.registration), moved)


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
    first, seen = _mean_by_part(squared.min(1), labels, parts)
    second, key_seen = _mean_by_part(squared.min(0), key_labels, parts)
    both = (seen > 0) & (key_seen > 0)
    total = jnp.where(both, 0.5 * (first + second), 0.0).sum()
    return total / jnp.maximum(both.sum(), 1) / size


def _mean_by_part(squared, labels, parts):
    """(mean distance [K], number of points [K]) of the points that found a partner."""
    found = jnp.isfinite(squared) & (squared > 0)
    distance = jnp.where(found, jnp.sqrt(jnp.where(found, squared, 1.0)), 0.0)
    member = (labels[:, None] == parts) & jnp.isfinite(squared)[:, None]
    count = member.sum(0)
    return (distance[:, None] * member).sum(0) / jnp.maximum(count, 1), count
