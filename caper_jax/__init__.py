"""caper_jax: category-level articulated object pose perception in JAX (CAPER++).

Example:
  import caper_jax as caper

  estimator = caper.load("box")
  prediction = estimator(points)  # points [B, N, 3] meters, OpenCV camera frame
  prediction.pose.rotation  # [B, K, 3, 3]
"""

from caper_jax import articulation, categories, geometry
from caper_jax._version import __version__
from caper_jax.articulation.category import Category, Joint, ObjectModel, Symmetry, Viewpoint
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import TrackerConfig
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
    "ObjectModel",
    "Observation",
    "Prediction",
    "Symmetry",
    "TrackResult",
    "Tracker",
    "TrackerConfig",
    "TrackerState",
    "Viewpoint",
    "__version__",
    "articulation",
    "categories",
    "estimate",
    "geometry",
    "load",
    "load_tracker",
    "track_step",
]
