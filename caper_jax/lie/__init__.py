"""The Lie groups SO(3) and SE(3)."""

from caper_jax.lie import se3, so3

__all__ = ["se3", "so3"]
