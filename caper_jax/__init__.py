"""caper_jax: category-level articulated object pose perception in JAX (CAPER++).

Example:
  import caper_jax as caper

  estimator = caper.load("box")
  prediction = estimator(points)  # points [B, N, 3] meters, OpenCV camera frame
  prediction.pose.rotation  # [B, K, 3, 3]
"""

import importlib as _importlib
from typing import Any as _Any

from caper_jax import articulation, categories, geometry
from caper_jax._version import __version__
from caper_jax.articulation.category import Category, Joint, ObjectModel, Symmetry, Viewpoint
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import LossConfig, LossWeights, TrackerConfig, preset
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, Prediction, estimate, load
from caper_jax.tracker import Tracker, load_tracker
from caper_jax.tracking.state import Observation, TrackerState
from caper_jax.tracking.step import TrackResult, track_step

__all__ = [
    "ArticulatedPose",
    "CaperError",
    "Category",
    "Estimator",
    "Joint",
    "LossConfig",
    "LossWeights",
    "ObjectModel",
    "Objective",
    "Observation",
    "Optimizer",
    "Prediction",
    "Symmetry",
    "TrackResult",
    "Tracker",
    "TrackerConfig",
    "TrackerState",
    "TrainState",
    "Viewpoint",
    "__version__",
    "articulation",
    "categories",
    "estimate",
    "geometry",
    "load",
    "load_tracker",
    "preset",
    "track_step",
    "train",
    "train_step",
]

# Loaded at first use: optax and Orbax take longer to import than the estimator's first pose.
_TRAINING = {
    "Objective": "objective",
    "Optimizer": "optimizer",
    "TrainState": "step",
    "train": "train",
    "train_step": "step",
}


def __getattr__(name: str) -> _Any:
    if name not in _TRAINING:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_importlib.import_module(f"caper_jax.training.{_TRAINING[name]}"), name)
    globals()[name] = value
    return value
