"""The HS-Encoder as one would write it down: the reference that its fast formulation is held to.

The same weights, with each building block in its obvious form: neighbors by sorting all distances,
maxima over [B, N, k, C] at once with JAX's own derivatives, features of all levels at every point.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from caper_jax.config import HSEncoderConfig


def hs_encoder(variables: Any, points: Any, config: HSEncoderConfig) -> Any:
    """Features [B, N, C] of all levels of points [B, N, 3], in evaluation.

    Args:
      variables: of ``HSEncoder(config)``.
      points: centered, network units.
      config: sizes of the encoder.
    """
    params, statistics = variables["params"], variables["batch_stats"]

    def normalize(features: Any, name: str) -> Any:
        weights, moments = params[name], statistics[name]
        scale = weights["scale"] / jnp.sqrt(moments["var"] + 1e-5)
        return jax.nn.relu((features - moments["mean"]) * scale + weights["bias"])

    def layer(number: int, points: Any, features: Any, around: Any) -> Any:
        scope = around
        if features is not None and config.feature_space:
            scope = neighbors(features, around.shape[-1])
        return _layer(params[f"layer{number}"], config, points, features, scope, around)

    def around(points: Any) -> Any:
        return neighbors(points, max(1, min(config.neighbors, points.shape[1] // 8)))

    def pool(features: Any, around: Any) -> Any:
        return _gather(features, around[..., :4]).max(2)[:, :: config.pooling]

    fine, middle, coarse = (points[:, :: config.pooling**level] for level in range(3))
    around0, around1, around2 = around(fine), around(middle), around(coarse)
    f0 = jax.nn.relu(layer(0, fine, None, around0))
    f1 = normalize(layer(1, fine, f0, around0), "norm1")
    f2 = normalize(layer(2, middle, pool(f1, around0), around1), "norm2")
    f3 = normalize(layer(3, middle, f2, around1), "norm3")
    f4 = layer(4, coarse, pool(f3, around1), around2)
    levels = [f0, f1]
    for features, own in ((f2, middle), (f3, middle), (f4, coarse)):
        levels.append(_gather(features, _distances(fine, own).argmin(-1)))
    return jnp.concatenate(levels, -1)


def neighbors(rows: Any, k: int) -> Any:
    """[B, N, k] the nearest other rows of [B, N, C], by a full sort of [B, N, N]."""
    distance = _distances(rows, rows)
    distance += jnp.diag(jnp.full(distance.shape[-1], jnp.inf, distance.dtype))
    return distance.argsort(-1)[..., :k]


def _layer(
    weights: Any, config: HSEncoderConfig, points: Any, features: Any, scope: Any, around: Any
) -> Any:
    """One hybrid-scope layer and its outlier-robust sum; the surface layer without features."""
    support = weights["directions"]
    support = support / jnp.maximum(jnp.linalg.norm(support, axis=0), 1e-12)
    offset = _gather(points, scope) - points[:, :, None]
    direction = offset / jnp.maximum(jnp.linalg.norm(offset, axis=-1, keepdims=True), 1e-12)
    active = jax.nn.relu(jnp.einsum("bnki,ic->bnkc", direction, support, precision="highest"))
    center: Any = 0.0
    if features is not None:
        channels = active.shape[-1] // config.supports
        mapped = features @ weights["support"]["kernel"] + weights["support"]["bias"]
        center = mapped[..., :channels]
        active = active * _gather(mapped[..., channels:], scope)
    active = active.max(2)
    active = active.reshape(*active.shape[:2], config.supports, -1).mean(2)
    out = center + active
    shared = _gather(out, around).max(2).mean(1, keepdims=True)
    robust = weights["robust"]
    out = out + out @ robust["own"]["kernel"] + shared @ robust["shared"]["kernel"]
    return out + (points if features is None else features) @ weights["skip"]["kernel"]


def _distances(a: Any, b: Any) -> Any:
    """[B, N, M] squared distances of the rows of [B, N, C] and [B, M, C]."""
    return jnp.maximum(
        (a * a).sum(-1)[..., None]
        + (b * b).sum(-1)[:, None]
        - 2 * jnp.einsum("bnc,bmc->bnm", a, b, precision="highest"),
        0.0,
    )


def _gather(rows: Any, index: Any) -> Any:
    """Rows [B, M, C] at [B, ...] -> [B, ..., C]."""
    return jax.vmap(lambda own, at: own[at])(rows, index)
