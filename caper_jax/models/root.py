"""Stage I: the root's pose as two directions with confidences and a translation (Sec 5.1)."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from caper_jax.config import NetworkConfig
from caper_jax.models.encoders import encode
from caper_jax.models.heads import PooledHead, unit_vectors


@flax.struct.dataclass
class RootOutput:
    """Stage I, in the frame and units of its input cloud.

    Attributes:
      directions: unit vectors, two axes of the root's frame.
      confidence: in (0, 1); the correction factors of Eq 3.
      translation: of the root's origin.
    """

    directions: Float[Array, "B 2 3"]
    confidence: Float[Array, "B 2"]
    translation: Float[Array, "B 3"]


class RootNetwork(nn.Module):
    """Stage I: two directions with confidence, and the translation as a residual to the mean."""

    config: NetworkConfig

    @nn.compact
    def __call__(self, points: Float[Array, "B N 3"], train: bool, space: Any = None) -> RootOutput:
        """Points in network units -> RootOutput; for ``space`` see ``shared_neighborhoods``."""
        mean = points.mean(axis=1, keepdims=True)
        features = encode(self.config, points - mean, train, space)
        heads = self.config.root_heads
        residual = PooledHead(3, heads, with_points=True, name="translation")(features, train)
        if self.config.rotation == "quaternion":
            numbers = PooledHead(4, heads, name="quaternion")(features, train)
            directions = quaternion_axes(numbers)
            confidence = jnp.full(directions.shape[:2], 0.5, directions.dtype)
        else:
            raw = jnp.stack(
                [PooledHead(4, heads, name=f"direction{i}")(features, train) for i in range(2)],
                axis=1,
            )
            directions, confidence = unit_vectors(raw[..., 1:]), jax.nn.sigmoid(raw[..., 0])
            if not self.config.vertical_correction:
                confidence = jnp.broadcast_to(
                    jnp.array([1.0, 0.0], confidence.dtype), confidence.shape
                )
        return RootOutput(directions, confidence, residual + mean[:, 0])


def quaternion_axes(numbers: Float[Array, "B 4"]) -> Float[Array, "B 2 3"]:
    """Two axes at right angles, from a quaternion less the identity's."""
    w, x, y, z = jnp.moveaxis(unit_vectors(numbers + jnp.array([1.0, 0, 0, 0])), -1, 0)
    first = jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    second = jnp.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1)
    return jnp.stack([first, second], axis=1)
