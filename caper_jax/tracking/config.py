"""Settings of a tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from caper_jax.errors import CaperError
from caper_jax.tracking.registration import RegistrationConfig

Policy = Literal["none", "fixed", "dynamic", "promote"]
POLICIES: tuple[Policy, ...] = ("none", "fixed", "dynamic", "promote")


@dataclass(frozen=True)
class TrackerConfig:
    """How a tracker works; the defaults are what the shipped models are measured with.

    Attributes:
      policy: when a frame becomes the keyframe that increments refer to (Sec 5.3.2, Alg 1).
        "dynamic": when the energy exceeds ``threshold`` or the share of unmatched points
        ``unseen``; its pose then comes from the static estimator. "fixed": every ``interval``
        frames, likewise. "none": every frame, with the tracked pose and nothing else kept, so that
        errors add up. "promote": like "dynamic", but with the tracked pose (errata:
        the reading of Algorithm 1's l. 8 in the code it goes back to); the static estimator only
        helps where the track is lost.
      interval: of "fixed", in frames.
      threshold: phi of Eq 16, relative to the object's diagonal.
      unseen: share of points off the surface seen so far that asks for a new keyframe.
      filtered: weigh the static estimator's pose at a keyframe against the tracked one by their
        variances; off, the keyframe takes the estimator's as it is (the paper's text).
      anchored: let the network see the cloud canonicalised by the predicted pose, a step on from
        the keyframe's, instead of the keyframe's own; the increment is the same, but small.
      registration: of the cloud to the surface seen so far; ``registration.steps = 0`` leaves the
        network's increment alone (the paper's tracker).
      damping: how much of the velocity is kept from frame to frame.
      velocity_gain: how much of what the prediction missed goes into the velocity.
      gate_deg, gate: rotation and distance (network units) beyond which a static estimate or the
        network contradicts the track, not only differs from it.
      patience: frames in a row that contradict the track before the static estimator may replace
        it; it does so where it fits its own boxes clearly better.
      sure: least confidence in both of the root's directions (Eq 18) at which a static estimate may
        correct or replace a track: from a closed drawer's back any side may be the front.
      trial: frames after a start from the static estimator in which it is asked again, as long as
        it is sure: its poses are averaged, and vote on turns.
      vote: nats by which such an estimate, a quarter or half turn from the track, speaks for that
        turn, and one that is not speaks against.
      turned: sum over frames of the log odds that the track is off by a quarter or half turn, at
        which that turn is made: of stage II's, at most 1 nat per frame, for networks with a turn
        head; or of the votes.
      misfit: mean distance of the points from their parts' boxes, relative to the object's
        diagonal, above which a frame contradicts the track.
      mismatch: share of unmatched points above which a frame contradicts the track.
      static_rotation, static_translation, static_joint: standard deviations of the static
        estimator: radians, units, radians or units.
      drift_rotation, drift_translation, drift_joint: likewise, what one change of keyframe adds.
    """

    policy: Policy = "dynamic"
    interval: int = 10
    threshold: float = 0.03
    unseen: float = 0.12
    filtered: bool = True
    anchored: bool = True
    registration: RegistrationConfig = RegistrationConfig()
    damping: float = 0.8
    velocity_gain: float = 1.0
    gate_deg: float = 15.0
    gate: float = 0.4
    patience: int = 3
    sure: float = 0.5
    trial: int = 5
    vote: float = 1.5
    turned: float = 2.0
    misfit: float = 0.03
    mismatch: float = 0.5
    static_rotation: float = 0.1
    static_translation: float = 0.1
    static_joint: float = 0.15
    drift_rotation: float = 0.01
    drift_translation: float = 0.01
    drift_joint: float = 0.02

    def __post_init__(self) -> None:
        if self.policy not in POLICIES:
            raise CaperError(f"tracker policy {self.policy!r} is none of {', '.join(POLICIES)}")
        if self.interval < 1 or self.patience < 1:
            raise CaperError("tracker interval and patience must be 1 or more")
