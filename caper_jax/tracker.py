"""Streaming tracker: a category's trained model, a pure jitted step, and what feeds it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from caper_jax.arrays import unit_gravity
from caper_jax.articulation.category import Category
from caper_jax.config import TrackerConfig, from_dict, override
from caper_jax.data.clouds import FARTHEST_M, MIN_POINTS, as_cloud, sample_points, shows_object
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, load
from caper_jax.tracking.state import Observation, TrackerState
from caper_jax.tracking.step import TrackResult, given_state, initial_state, track_step

_RIGID = 1e-2  # how far R R^T of a given pose may be from the identity


class Tracker:
    """Tracks one object through a stream of clouds.

    The model is the single-frame estimator's: its stage II, shown a cloud canonicalized by a
    keyframe's pose, gives the increment from there.

    Attributes:
      estimator: the trained model.
      config: settings.
      state: TrackerState after the last frame.
      step: ``(variables, state, observation) -> (state, result)``, pure and jitted; for scans,
        vmaps and gradients see ``tracking.step.track_step``.

    Example:
      tracker = load_tracker("laptop")
      for points in clouds:          # [N, 3] meters, camera frame; N may vary, and be 0
          result = tracker(points)
          result.pose.rotation, result.lost
    """

    def __init__(self, estimator: Estimator, config: TrackerConfig | None = None) -> None:
        self.estimator = estimator
        self.config = config or config_for(estimator)
        static: dict[str, Any] = {
            "category": estimator.category,
            "network": estimator.network,
            "config": self.config,
        }
        self.function = partial(track_step, **static)
        self.step = jax.jit(self.function)
        self._given = jax.jit(partial(given_state, **static))
        self._scan = jax.jit(self._through)
        self.state = self.initial_state()

    def initial_state(self) -> TrackerState:
        """The state before a first frame, whose pose the single-frame estimator will give."""
        category, network = self.estimator.category, self.estimator.network
        return initial_state(category, network, self.config)

    def reset(self, points=None, rotation=None, translation=None, labels=None) -> None:
        """Forgets the video, and may begin another one with a known pose.

        Args:
          points: [N, 3] meters, the frame whose pose is known; None to let the estimator begin.
          rotation: [K, 3, 3] part frame -> camera in that frame.
          translation: [K, 3] meters.
          labels: [N] int, parts of the points, where they are known.

        Raises:
          CaperError: too few usable points, no points beside a pose, or poses of other shapes or
            that are no rigid motions in meters. The track goes on as it was.
        """
        if points is None:
            if rotation is not None or translation is not None:
                raise CaperError("a first pose needs the points of its frame")
            self.state = self.initial_state()
            return
        frame = self.observe(points, labels)
        if not frame.present:
            raise CaperError(
                f"the first frame shows too few points to begin with; at least {MIN_POINTS} are "
                "needed"
            )
        pose = _first_pose(rotation, translation, self.estimator.category.num_parts)
        self.state = self._given(self.estimator.variables, frame, *pose)

    def observe(self, points, labels=None, gravity=None) -> Observation:
        """The observation that the step takes, from any number of points.

        Args:
          points: [N, 3] meters, camera frame, N may be 0; NaN, infinite and zero points and those
            beyond 50 m are left out. Fewer than 48 usable points that differ count as a frame
            that does not show the object.
          labels: [N] int parts, -1 where unknown; by default all are predicted.
          gravity: [3] the way things fall in this frame, in the camera's frame and of any length;
            see ``Estimator.__call__``. Zeros where it is unknown in this frame alone.

        Raises:
          CaperError: wrong shape or dtype, points in millimeters or behind the camera, labels that
            are no parts, or a gravity that is no direction.
        """
        count = self.estimator.network.num_points
        points = as_cloud(points)
        if labels is not None:
            labels = self._checked_labels(labels, len(points))
        down = None
        if gravity is not None:
            down = np.asarray(gravity, np.float32)
            if down.shape != (3,) or down.any():
                down = unit_gravity(gravity, 1)[0]
        unknown = np.full(count, -1, np.int32)
        if not shows_object(points):
            nothing = np.zeros((count, 3), np.float32)
            return Observation(nothing, np.asarray(False), unknown, down)
        cloud = sample_points(points, count)
        chosen = unknown if labels is None else labels[cloud.index]
        return Observation(cloud.points, np.asarray(True), chosen, down)

    def _checked_labels(self, labels, count: int) -> np.ndarray:
        labels = np.asarray(labels)
        if labels.shape != (count,):
            raise CaperError(f"labels must be [{count}] like points, got {labels.shape}")
        parts = self.estimator.category.num_parts
        if labels.dtype.kind not in "iu" or not ((labels >= -1) & (labels < parts)).all():
            raise CaperError(f"labels must be integers from -1 to {parts - 1}")
        return labels.astype(np.int32)

    def __call__(self, points, labels=None, gravity=None) -> TrackResult:
        """Tracks through the next frame; see ``observe`` for the arguments."""
        observation = self.observe(points, labels, gravity)
        self.state, result = self.step(self.estimator.variables, self.state, observation)
        return result

    def track(self, observations: Observation, state: TrackerState | None = None) -> TrackResult:
        """Tracks through a recording in one compiled scan; ``self.state`` stays as it is.

        Args:
          observations: with a leading axis of T frames.
          state: where to begin; by default before the first frame.

        Returns:
          TrackResult with a leading axis of T.
        """
        begin = self.initial_state() if state is None else state
        return self._scan(self.estimator.variables, begin, observations)[1]

    def _through(self, variables, state: TrackerState, observations: Observation):
        return jax.lax.scan(partial(self.function, variables), state, observations)


def _first_pose(rotation, translation, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """A given pose as float32 [K, 3, 3] and [K, 3]; CaperError unless it is rigid, in meters."""
    try:
        rotation = np.asarray(rotation, np.float32)
        translation = np.asarray(translation, np.float32)
    except (TypeError, ValueError) as error:
        raise CaperError(f"the first pose must be numbers ({error})") from error
    if rotation.shape != (parts, 3, 3) or translation.shape != (parts, 3):
        raise CaperError(
            f"the first pose must be rotation [{parts}, 3, 3] and translation [{parts}, 3], "
            f"got {list(rotation.shape)} and {list(translation.shape)}"
        )
    off = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)).max()
    if not (off < _RIGID and (np.linalg.det(rotation) > 0).all()):  # NaN is not less
        raise CaperError("the first pose's rotation must hold rotation matrices")
    if not (np.abs(translation) <= FARTHEST_M).all():
        raise CaperError(
            f"the first pose's translation must be meters, at most {FARTHEST_M:g}, "
            f"got {np.abs(translation).max():.4g}"
        )
    return rotation, translation


def config_for(estimator: Estimator, *assignments: str) -> TrackerConfig:
    """The settings that suit a model: the defaults, changed by the "tracker" section of its card.

    Args:
      estimator: the model.
      assignments: "key=value" on top, e.g. "policy=fixed" or "registration.steps=0".

    Raises:
      CaperError: unknown keys or bad values in either.
    """
    section = estimator.card.get("tracker", {})
    return override(from_dict(TrackerConfig, section, "tracker of the model card"), *assignments)


def load_tracker(
    category: str | Category,
    weights: str | Path | None = None,
    config: TrackerConfig | Sequence[str] = (),
    object_scale: float = 1.0,
    camera_roll: float = 0.0,
) -> Tracker:
    """The tracker of a category, with the weights that ``load`` takes.

    Args:
      category: the category itself, its name (e.g. "box"), or "FILE.py:NAME".
      weights: a model directory; by default the one in the package.
      config: settings; or "key=value" changes to those that suit the model, see ``config_for``.
      object_scale, camera_roll: see ``estimator.load``.

    Raises:
      CaperError: see ``estimator.load``.
    """
    estimator = load(category, weights, object_scale, camera_roll)
    if not isinstance(config, TrackerConfig):
        config = config_for(estimator, *config)
    return Tracker(estimator, config)
