"""caper_jax: category-level articulated object pose perception in JAX (CAPER++).

Example:
  import caper_jax as caper

  estimator = caper.load("box")
  prediction = estimator(points)  # points [B, N, 3] meters, OpenCV camera frame
  prediction.pose.rotation  # [B, K, 3, 3]

The public names stand in ``__init__.pyi``; each is imported when it is first used, so that
``import caper_jax`` takes no time of its own.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
