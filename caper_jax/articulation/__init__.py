"""Articulation: categories as data, poses, kinematics and symmetries."""

from caper_jax.articulation import category, kinematics, pose, symmetry

__all__ = ["category", "kinematics", "pose", "symmetry"]
