"""Geometry: rotations, rigid transforms, directions, boxes and solids."""

from caper_jax.geometry import boxes, solids, two_axis_rotation
from caper_jax.lie import linalg, se3, so3

__all__ = ["boxes", "linalg", "se3", "so3", "solids", "two_axis_rotation"]
