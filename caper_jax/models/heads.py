"""Decoders on top of an encoder: pooled (one output per cloud) and point-wise (Sec 5.1-5.2)."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from caper_jax.config import HeadConfig
from caper_jax.models.encoders.features import BlockDense, Features
from caper_jax.models.layers import (
    BatchNorm,
    Dense,
    max_over_points,
    mixed_precision_dot,
    weights_first,
)


def _norm_relu(features, train: bool):
    return nn.relu(BatchNorm(use_running_average=not train, momentum=0.9)(features))


def _pointwise(features: Features, first: int, second: int, with_points: bool, train: bool):
    """The two layers at every point, [B, N, second]."""
    dot_general = weights_first if train else mixed_precision_dot
    hidden = BlockDense(first, with_points, dot_general)(features)
    return _norm_relu(Dense(second, dot_general=dot_general)(_norm_relu(hidden, train)), train)


class PooledHead(nn.Module):
    """Two point-wise layers, maximum over points, two more layers.

    Attributes:
      outputs: numbers per cloud.
      config: sizes.
      with_points: concatenates the centered coordinates to the features.
    """

    outputs: int
    config: HeadConfig
    with_points: bool = False

    @nn.compact
    def __call__(self, features: Features, train: bool) -> Float[Array, "B D"]:
        """Features -> ``outputs`` numbers per cloud."""
        first, second, third = self.config.widths
        if self.config.pool_first:
            rows = features.levels[-1].features
            hidden = jnp.concatenate([max_over_points(rows), rows.mean(axis=1)], -1)
            # Leaky: without a norm before them, plain rectifiers can all die in the first steps,
            # and the head then predicts one constant for every cloud.
            hidden = nn.leaky_relu(Dense(first)(hidden))
            hidden = nn.leaky_relu(Dense(second)(hidden))
        else:
            rows = _pointwise(features, first, second, self.with_points, train)
            hidden = max_over_points(rows)
            hidden = _norm_relu(Dense(third)(hidden), train)
        hidden = nn.Dropout(self.config.dropout, deterministic=not train)(hidden)
        return Dense(self.outputs)(hidden)


class PointHead(nn.Module):
    """Two point-wise layers and an output per point.

    Attributes:
      outputs: numbers per point.
      config: sizes.
    """

    outputs: int
    config: HeadConfig

    @nn.compact
    def __call__(self, features: Features, train: bool) -> Float[Array, "B N D"]:
        """Features -> ``outputs`` numbers per point."""
        first, second, _ = self.config.widths
        hidden = _pointwise(features, first, second, True, train)
        hidden = nn.Dropout(self.config.dropout, deterministic=not train)(hidden)
        return Dense(self.outputs)(hidden)


def unit_vectors(raw: Float[Array, "*batch D"]) -> Float[Array, "*batch D"]:
    """Unit vectors; the slope stays finite at zero, where the result is zero."""
    squared = (raw * raw).sum(-1, keepdims=True)
    return raw / jnp.sqrt(squared + 1e-12)
