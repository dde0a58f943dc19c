"""Geometry: frames, rotations from two directions, boxes, solids and the order of points."""

from caper_jax.geometry import boxes, frames, raster_order, solids, two_axis_rotation

__all__ = ["boxes", "frames", "raster_order", "solids", "two_axis_rotation"]
