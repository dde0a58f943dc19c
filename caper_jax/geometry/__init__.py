"""Geometry: rotations, rigid transforms and solids."""

from caper_jax.geometry import se3, so3, solids

__all__ = ["se3", "so3", "solids"]
