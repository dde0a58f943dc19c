# The public names: read by type checkers, and by ``__init__.py`` when it runs.

from . import articulation, categories, geometry
from ._version import __version__
from .articulation.category import Category, Joint, ObjectModel, Symmetry, Viewpoint
from .articulation.kinematics import forward_kinematics
from .articulation.pose import ArticulatedPose, joints_in_camera
from .categories import register
from .config import (
    GeneratorConfig,
    LossConfig,
    LossWeights,
    NetworkConfig,
    RunConfig,
    TrackerConfig,
    TrainingConfig,
    preset,
)
from .data.clouds import cloud_from_depth, mask_from_box, read_points, sample_points
from .data.images import read_depth, read_intrinsics, read_mask
from .data.readers import open_dataset, register_reader
from .data.readers.base import DatasetReader
from .data.types import Batch, Frame
from .errors import CaperError
from .estimator import Estimator, Prediction, estimate, load
from .evaluation.batches import evaluate_models
from .evaluation.metrics import pose_errors
from .evaluation.protocol import evaluate
from .export import export_estimator
from .lie import se3, so3
from .models import encoders
from .models.plausibility import implausible_because
from .synthetic.frames import Generator
from .synthetic.videos import VideoGenerator
from .tracker import Tracker, load_tracker
from .tracking.state import Observation, TrackerState
from .tracking.step import TrackResult, track_step
from .training.objective import Objective
from .training.optimizer import Optimizer
from .training.step import TrainState, train_step
from .training.train import train
from .training.train_many import MemberResult, train_many
from .visualization.picture import write_picture
from .visualization.scene import Scene

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
    "MemberResult",
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
    "evaluate_models",
    "export_estimator",
    "forward_kinematics",
    "geometry",
    "implausible_because",
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
    "train_many",
    "train_step",
    "write_picture",
]
