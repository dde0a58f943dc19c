"""Geometry: rotations, rigid transforms, directions, boxes and solids."""

from caper_jax.geometry import boxes, directions, linalg, se3, so3, solids

__all__ = ["boxes", "directions", "linalg", "se3", "so3", "solids"]
