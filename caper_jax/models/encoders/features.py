"""What an encoder hands to the heads: features at several resolutions, never up-sampled early."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from caper_jax.models.encoders.neighbors import gather
from caper_jax.models.layers import Dense, block_init, mixed_precision_dot


@flax.struct.dataclass
class Level:
    """Features of a subset of the points.

    Attributes:
      features: one row per point of the subset.
      upsample: how rows come back to the N input points: [B, N] the row nearest to each point,
        or [B, N, M] weights that sum to one; None when the rows are the points themselves.
    """

    features: Float[Array, "B M C"]
    upsample: Int[Array, "B N"] | Float[Array, "B N M"] | None = None

    def at_points(self, values: Float[Array, "B M C"]) -> Float[Array, "B N C"]:
        """Rows of the subset brought to the input points."""
        if self.upsample is None:
            return values
        if self.upsample.ndim == 3:
            return jnp.einsum("bnm,bmc->bnc", self.upsample, values)
        return gather(values, self.upsample)


@flax.struct.dataclass
class Features:
    """Encoder output.

    Attributes:
      points: the centered input cloud.
      levels: fine to coarse.
      shared: global feature, or None.
    """

    points: Float[Array, "B N 3"]
    levels: tuple[Level, ...]
    shared: Float[Array, "B G"] | None = None

    def every(self, stride: int) -> Features:
        """The same features at every stride-th input point."""
        if stride == 1:
            return self
        levels = tuple(
            Level(level.features[:, ::stride])
            if level.upsample is None
            else Level(level.features, level.upsample[:, ::stride])
            for level in self.levels
        )
        return Features(self.points[:, ::stride], levels, self.shared)


class BlockDense(nn.Module):
    """A dense layer over the concatenation of all levels at every point, without building it.

    Each level is projected at its own resolution and the sums are up-sampled: the same result as
    concatenating first (paper Sec 5.1.1), for a fraction of the arithmetic. Its weights start as
    those of the one layer would.

    Attributes:
      width: output channels.
      with_points: whether the centered coordinates are part of the concatenation (the translation
        and joint heads of the paper).
      dot_general: of the dense layers, see ``nn.Dense``.
    """

    width: int
    with_points: bool = False
    dot_general: Any = mixed_precision_dot

    @nn.compact
    def __call__(self, features: Features) -> Float[Array, "B N C"]:
        """Features -> ``width`` channels at every point."""
        blocks = [level.features for level in features.levels]
        blocks += [features.points] if self.with_points else []
        blocks += [features.shared] if features.shared is not None else []
        channels = sum(block.shape[-1] for block in blocks)

        def dense(rows, name, use_bias=False):
            start = block_init(rows.shape[-1], channels)
            layer = Dense(
                self.width, use_bias, kernel_init=start, dot_general=self.dot_general, name=name
            )
            return layer(rows)

        total: Any = 0.0
        for number, level in enumerate(features.levels):
            part = dense(level.features, f"level{number}", use_bias=number == 0)
            total += level.at_points(part)
        if self.with_points:
            total += dense(features.points, "points")
        if features.shared is not None:
            total += dense(features.shared, "shared")[:, None, :]
        return total
