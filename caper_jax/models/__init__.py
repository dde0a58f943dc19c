"""Networks: encoders, heads, both stages, and how they are run and stored."""

from caper_jax.models import encoders

__all__ = ["encoders"]
