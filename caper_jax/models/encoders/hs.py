"""The HS-Encoder: hybrid-scope graph convolutions (paper Sec 5.1.1; HS-Pose, CVPR 2023)."""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from caper_jax.config import HSEncoderConfig
from caper_jax.models.encoders.features import Features, Level
from caper_jax.models.encoders.neighbors import (
    directional_max,
    directions,
    gather,
    nearest,
    nearest_row,
    neighbor_max,
)
from caper_jax.models.layers import (
    BatchNorm,
    Dense,
    Weights,
    block_init,
    max_over_points,
    weights_first,
)

dense = partial(Dense, dot_general=weights_first)


def _uniform(bound: float):
    def init(key, shape, dtype=jnp.float32):
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


class OutlierRobust(nn.Module):
    """ORL: adds a global feature that single outliers do not move.

    Maximum over each point's neighbors in space, mean over all points, then a linear map of
    [feature, global] added to the feature.
    """

    @nn.compact
    def __call__(
        self, features: Float[Array, "B N C"], around: Int[Array, "B N k"]
    ) -> Float[Array, "B N C"]:
        """Features and each point's neighbors in space -> features."""
        channels = features.shape[-1]
        shared = neighbor_max(features, around).mean(1, keepdims=True)
        half = partial(
            dense, channels, use_bias=False, kernel_init=block_init(channels, 2 * channels)
        )
        return features + half(name="own")(features) + half(name="shared")(shared)


class HSLayer(Weights, nn.Module):
    """One hybrid-scope layer; the surface layer when it gets no features.

    Attributes:
      channels: output channels C.
      supports: s support directions.
    """

    channels: int
    supports: int

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "B N 3"],
        features: Float[Array, "B N C"] | None,
        scope: Int[Array, "B N k"],
        around: Int[Array, "B N n"],
    ) -> Float[Array, "B N D"]:
        """Convolves over ``scope`` and makes the result robust over ``around``.

        Args:
          points: the cloud.
          features: of the last layer, or None for the surface layer.
          scope: receptive field (neighbors in feature space, or in space).
          around: neighbors in space.
        """
        width = self.supports * self.channels
        scale = width if features is None else self.channels * (self.supports + 1)
        bound = scale**-0.5
        weights = self.param("directions", _uniform(bound), (3, width))
        weights = weights / jnp.maximum(jnp.linalg.norm(weights, axis=0), 1e-12)
        toward = directions(points, scope)
        if features is None:
            skip = dense(self.channels, use_bias=False, name="skip")(points)
            center: Any = 0.0
            active = directional_max(toward, scope, None, weights)
        else:
            skip = dense(self.channels, use_bias=False, name="skip")(features)
            kernel = _uniform(bound)
            supports = dense(
                width + self.channels, kernel_init=kernel, bias_init=kernel, name="support"
            )(features)
            center = supports[..., : self.channels]
            support = supports[..., self.channels :]
            active = directional_max(toward, scope, support, weights)
        active = active.reshape(*active.shape[:2], self.supports, self.channels).mean(2)
        return OutlierRobust(name="robust")(center + active, around) + skip


@flax.struct.dataclass
class Neighborhoods:
    """Which points are near which in space; a rigid motion of the cloud does not change it.

    Attributes:
      around: per resolution, the neighbors of each point, nearest first.
      kept: per pooling, the N / 4 rows that it keeps.
      upsample: per pooling, the row it kept that is nearest to each input point.
    """

    around: tuple[Int[Array, "B M k"], ...]
    kept: tuple[Int[Array, "B M"], ...]
    upsample: tuple[Int[Array, "B N"], ...]


def neighborhoods(
    points: Float[Array, "B N 3"], config: HSEncoderConfig, keys=(None, None)
) -> Neighborhoods:
    """The neighborhoods of points at N, N/4 and N/16 of them.

    Args:
      points: the cloud.
      config: sizes of the encoder.
      keys: per pooling, draws the subset that is kept, per cloud; None: every fourth point.
    """

    def neighbors(cloud):
        k = max(1, min(config.neighbors, cloud.shape[1] // 8))
        return nearest(cloud, cloud, k, exclude_self=True)

    around, kept, upsample = [neighbors(points)], [], []
    cloud = points
    for key in keys:
        batch, count = cloud.shape[:2]
        left = count // config.pooling
        if key is None:
            rows = jnp.broadcast_to(jnp.arange(left) * config.pooling, (batch, left))
        else:
            rows = jax.vmap(lambda key, n=count, m=left: jax.random.permutation(key, n)[:m])(
                jax.random.split(key, batch)
            )
        cloud = gather(cloud, rows)
        around.append(neighbors(cloud))
        kept.append(rows)
        upsample.append(nearest_row(points, cloud))
    return Neighborhoods(tuple(around), tuple(kept), tuple(upsample))


class HSEncoder(nn.Module):
    """Surface layer and four HS layers with two poolings (architecture of HS-Pose).

    Attributes:
      config: sizes.
    """

    config: HSEncoderConfig = HSEncoderConfig()

    @nn.nowrap
    def neighborhoods(self, points: Float[Array, "B N 3"]) -> Neighborhoods:
        """``neighborhoods`` as evaluation pools them."""
        return neighborhoods(points, self.config)

    @nn.compact
    def __call__(
        self, points: Float[Array, "B N 3"], train: bool, space: Neighborhoods | None = None
    ) -> Features:
        """Points, centered, network units -> Features at N, N/4 and N/16 points.

        In training the pooled subset is drawn from the rng stream "sample", per cloud; in
        evaluation it is every fourth point. ``space`` saves finding the neighbors again.
        """
        config = self.config
        layer = [
            HSLayer(channels, config.supports, name=f"layer{number}")
            for number, channels in enumerate(config.channels)
        ]

        def normalize(features, number):
            norm = BatchNorm(use_running_average=not train, momentum=0.9, name=f"norm{number}")
            return nn.relu(norm(features))

        def scope(features, around):
            if not config.feature_space:
                return around
            return nearest(features, features, around.shape[-1], exclude_self=True)

        def pool(features, around, kept):
            """Maximum over the four nearest neighbors, at the points that are kept."""
            return neighbor_max(features, gather(around[..., :4], kept))

        if space is None:
            keys = [self.make_rng("sample") if train else None for _ in range(2)]
            space = neighborhoods(points, config, keys)
        around0, around1, around2 = space.around
        points1 = gather(points, space.kept[0])
        points2 = gather(points1, space.kept[1])

        f0 = nn.relu(layer[0](points, None, around0, around0))
        f1 = normalize(layer[1](points, f0, scope(f0, around0), around0), 1)

        f1_pooled = pool(f1, around0, space.kept[0])
        f2 = normalize(layer[2](points1, f1_pooled, scope(f1_pooled, around1), around1), 2)
        f3 = normalize(layer[3](points1, f2, scope(f2, around1), around1), 3)

        f3_pooled = pool(f3, around1, space.kept[1])
        f4 = layer[4](points2, f3_pooled, scope(f3_pooled, around2), around2)

        levels = (
            Level(jnp.concatenate([f0, f1], -1)),
            Level(jnp.concatenate([f2, f3], -1), space.upsample[0]),
            Level(f4, space.upsample[1]),
        )
        return Features(points, levels, max_over_points(f4) if config.global_feature else None)
