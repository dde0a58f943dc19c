"""caper_jax: category-level articulated object pose perception in JAX (CAPER++).

Example:
  import caper_jax as caper

  estimator = caper.load("box")
  prediction = estimator(points)  # points [B, N, 3] meters, OpenCV camera frame
  prediction.pose.rotation  # [B, K, 3, 3]

Names are imported when they are first used, so that ``import caper_jax`` takes no time of its own.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from caper_jax._version import __version__

if TYPE_CHECKING:
    from caper_jax import articulation, categories, geometry
    from caper_jax.articulation.category import Category, Joint, ObjectModel, Symmetry, Viewpoint
    from caper_jax.articulation.kinematics import forward_kinematics
    from caper_jax.articulation.pose import ArticulatedPose, joints_in_camera
    from caper_jax.categories import register
    from caper_jax.config import (
        GeneratorConfig,
        LossConfig,
        LossWeights,
        NetworkConfig,
        RunConfig,
        TrackerConfig,
        TrainingConfig,
        preset,
    )
    from caper_jax.data.clouds import cloud_from_depth, mask_from_box, read_points, sample_points
    from caper_jax.data.images import read_depth, read_intrinsics, read_mask
    from caper_jax.data.readers import open_dataset
    from caper_jax.data.readers import register as register_reader
    from caper_jax.data.readers.base import DatasetReader
    from caper_jax.data.types import Batch, Frame
    from caper_jax.errors import CaperError
    from caper_jax.estimator import Estimator, Prediction, estimate, load
    from caper_jax.evaluation.metrics import pose_errors
    from caper_jax.evaluation.protocol import evaluate
    from caper_jax.export import export_estimator
    from caper_jax.lie import se3, so3
    from caper_jax.models import encoders
    from caper_jax.synthetic.frames import Generator
    from caper_jax.synthetic.videos import VideoGenerator
    from caper_jax.tracker import Tracker, load_tracker
    from caper_jax.tracking.state import Observation, TrackerState
    from caper_jax.tracking.step import TrackResult, track_step
    from caper_jax.training.objective import Objective
    from caper_jax.training.optimizer import Optimizer
    from caper_jax.training.step import TrainState, train_step
    from caper_jax.training.train import train
    from caper_jax.visualization.picture import write_picture
    from caper_jax.visualization.scene import Scene

__all__ = [
    "ArticulatedPose",
    "Batch",
    "CaperError",
    "Category",
    "DatasetReader",
    "Estimator",
    "Frame",
    "Generator",
    "GeneratorConfig",
    "Joint",
    "LossConfig",
    "LossWeights",
    "NetworkConfig",
    "ObjectModel",
    "Objective",
    "Observation",
    "Optimizer",
    "Prediction",
    "RunConfig",
    "Scene",
    "Symmetry",
    "TrackResult",
    "Tracker",
    "TrackerConfig",
    "TrackerState",
    "TrainState",
    "TrainingConfig",
    "VideoGenerator",
    "Viewpoint",
    "__version__",
    "articulation",
    "categories",
    "cloud_from_depth",
    "encoders",
    "estimate",
    "evaluate",
    "export_estimator",
    "forward_kinematics",
    "geometry",
    "joints_in_camera",
    "load",
    "load_tracker",
    "mask_from_box",
    "open_dataset",
    "pose_errors",
    "preset",
    "read_depth",
    "read_intrinsics",
    "read_mask",
    "read_points",
    "register",
    "register_reader",
    "sample_points",
    "se3",
    "so3",
    "track_step",
    "train",
    "train_step",
    "write_picture",
]

# Where each name is defined; "module:name" where it is called otherwise there.
_HOME = {
    "ArticulatedPose": "articulation.pose",
    "Batch": "data.types",
    "CaperError": "errors",
    "Category": "articulation.category",
    "DatasetReader": "data.readers.base",
    "Estimator": "estimator",
    "Frame": "data.types",
    "Generator": "synthetic.frames",
    "GeneratorConfig": "config",
    "Joint": "articulation.category",
    "LossConfig": "config",
    "LossWeights": "config",
    "NetworkConfig": "config",
    "ObjectModel": "articulation.category",
    "Objective": "training.objective",
    "Observation": "tracking.state",
    "Optimizer": "training.optimizer",
    "Prediction": "estimator",
    "RunConfig": "config",
    "Scene": "visualization.scene",
    "Symmetry": "articulation.category",
    "TrackResult": "tracking.step",
    "Tracker": "tracker",
    "TrackerConfig": "config",
    "TrackerState": "tracking.state",
    "TrainState": "training.step",
    "TrainingConfig": "config",
    "VideoGenerator": "synthetic.videos",
    "Viewpoint": "articulation.category",
    "cloud_from_depth": "data.clouds",
    "estimate": "estimator",
    "evaluate": "evaluation.protocol",
    "export_estimator": "export",
    "forward_kinematics": "articulation.kinematics",
    "joints_in_camera": "articulation.pose",
    "load": "estimator",
    "load_tracker": "tracker",
    "mask_from_box": "data.clouds",
    "open_dataset": "data.readers",
    "pose_errors": "evaluation.metrics",
    "preset": "config",
    "read_depth": "data.images",
    "read_intrinsics": "data.images",
    "read_mask": "data.images",
    "read_points": "data.clouds",
    "register": "categories",
    "register_reader": "data.readers:register",
    "sample_points": "data.clouds",
    "track_step": "tracking.step",
    "train": "training.train",
    "train_step": "training.step",
    "write_picture": "visualization.picture",
}
_MODULES = {
    "articulation": "articulation",
    "categories": "categories",
    "encoders": "models.encoders",
    "geometry": "geometry",
    "se3": "lie.se3",
    "so3": "lie.so3",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value: Any = importlib.import_module(f"{__name__}.{_MODULES[name]}")
    elif name in _HOME:
        module, _, there = _HOME[name].partition(":")
        value = getattr(importlib.import_module(f"{__name__}.{module}"), there or name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
