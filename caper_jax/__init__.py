"""caper_jax: category-level articulated object pose perception in JAX (CAPER++).

Example:
  import caper_jax as caper

  estimator = caper.load("box")
  prediction = estimator(points)  # points [B, N, 3] metres, OpenCV camera frame
  prediction.pose.rotation  # [B, K, 3, 3]
"""

from caper_jax import articulation, categories, geometry
from caper_jax._version import __version__
from caper_jax.articulation.category import Category, Equivalence, Joint, ObjectModel, Viewpoint
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, Prediction, estimate, load
from caper_jax.tracker import Tracker, load_tracker
from caper_jax.tracking.config import TrackerConfig
from caper_jax.tracking.state import Observation, TrackerState
from caper_jax.tracking.step import Tracked, track_step

__all__ = [
    "ArticulatedPose",
    "CaperError",
    "Category",
    "Equivalence",
    "Estimator",
    "Joint",
    "ObjectModel",
    "Observation",
    "Prediction",
    "Tracked",
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
