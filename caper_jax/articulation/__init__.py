"""Articulation: categories as data, poses, joints and forward kinematics."""

from caper_jax.articulation import category, joints, kinematics, pose

__all__ = ["category", "joints", "kinematics", "pose"]
