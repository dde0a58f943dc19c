"""The encoder of the `fast` preset: analytic local shape instead of searched neighborhoods.

A few centers take every point's weighted mean and covariance at several scales: local normal,
curvature and density, by one exponential and one matrix product, with no neighbor search and no
gather. Residual layers then mix each center with the maximum and mean over all of them. What it
keeps of the HS-Encoder: hybrid scopes (several receptive fields per center), global features in
every layer, and the interface.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from caper_jax.config import FastEncoderConfig
from caper_jax.models.encoders.features import Features, Level
from caper_jax.models.encoders.neighbors import squared_distances
from caper_jax.models.layers import BatchNorm, Dense, max_over_points


def local_moments(
    centers: Float[Array, "B M 3"], points: Float[Array, "B N 3"], scale: Float[Array, "B"]
) -> Float[Array, "B M 11"]:
    """Weighted mean, covariance and density of the points around each center.

    Args:
      centers: where.
      points: the cloud.
      scale: standard deviation of the Gaussian window, same unit.

    Returns:
      Covariance over its trace (6), mean offset (3) and radius (1) in windows, share
      of all points (1). All are independent of the unit.
    """
    scale = scale[:, None, None]
    weight = jnp.exp(-0.5 * squared_distances(centers, points) / (scale * scale))
    x, y, z = (points[..., i : i + 1] for i in range(3))
    products = jnp.concatenate([points, x * x, y * y, z * z, x * y, x * z, y * z], -1)
    total = weight.sum(-1, keepdims=True) + 1e-6
    moment = jnp.einsum("bmn,bnc->bmc", weight, products, precision="highest") / total
    mean = moment[..., :3]
    x, y, z = (mean[..., i : i + 1] for i in range(3))
    outer = jnp.concatenate([x * x, y * y, z * z, x * y, x * z, y * z], -1)
    covariance = moment[..., 3:] - outer
    trace = jnp.maximum(covariance[..., :3].sum(-1, keepdims=True), 0.0) + 1e-8
    return jnp.concatenate(
        [
            3.0 * covariance / trace,
            (mean - centers) / scale,
            jnp.sqrt(trace) / scale,
            10.0 * total / points.shape[1],
        ],
        -1,
    )


class FastEncoder(nn.Module):
    """Local moments at centers, then residual layers with global features.

    Attributes:
      config: sizes.
    """

    config: FastEncoderConfig = FastEncoderConfig()

    @nn.compact
    def __call__(self, points: Float[Array, "B N 3"], train: bool) -> Features:
        """Points in network units -> Features at ``centers`` points."""
        config = self.config

        def norm_relu(features):
            return nn.relu(BatchNorm(use_running_average=not train, momentum=0.9)(features))

        count = config.centers if train else config.eval_centers
        total = points.shape[1]
        count = min(count, total)
        places = jnp.arange(count) * total // count
        if config.center_order == "random":
            places = jnp.asarray(np.random.default_rng(0).permutation(total)[:count])
        centers = points[:, places]
        middle = points.mean(axis=1, keepdims=True)
        radius = jnp.sqrt(((points - middle) ** 2).sum(-1).mean(-1) + 1e-8)
        window = points[:, :: config.stride]
        local = [local_moments(centers, window, radius * scale) for scale in config.scales]
        relative = (centers - middle) / radius[:, None, None]
        features = jnp.concatenate([*local, centers, relative], -1)
        features = norm_relu(Dense(config.width)(features))
        features = norm_relu(Dense(config.width)(features))
        for _ in range(config.blocks):
            shared = jnp.concatenate([max_over_points(features), features.mean(axis=1)], -1)
            mixed = Dense(config.width)(features)
            mixed += Dense(config.width, use_bias=False)(shared)[:, None, :]
            features += norm_relu(mixed)
        last = norm_relu(Dense(config.last)(features))
        # Interpolation, not the nearest center: smooth in the points, and a matrix product.
        window = radius * config.scales[0]
        closeness = -squared_distances(points, centers) / (2.0 * window * window)[:, None, None]
        level = Level(last, jax.nn.softmax(closeness))
        pooled = max_over_points(last) if config.global_feature else None
        return Features(points, (level,), pooled)
