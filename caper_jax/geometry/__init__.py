"""Geometry: rotations, rigid transforms and solids."""

from caper_jax.geometry import linalg, se3, so3, solids

__all__ = ["linalg", "se3", "so3", "solids"]
