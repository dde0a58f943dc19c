"""Networks small enough to compile in a test, with weights that cost no compilation."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.config import (
    FastEncoderConfig,
    HeadConfig,
    HSEncoderConfig,
    LossConfig,
    NetworkConfig,
)
from caper_jax.models.hypotheses import ReadingScorer, num_features
from caper_jax.training.objective import Objective

HS = HSEncoderConfig(channels=(4, 4, 8, 8, 16), neighbors=4, supports=2)
FAST = FastEncoderConfig(centers=16, eval_centers=16, scales=(0.2, 0.4), width=8, blocks=1, last=8)


def network(encoder: str = "fast", pool_first: bool = False, **changes: Any) -> NetworkConfig:
    """Both stages for clouds of 64 points."""
    heads = HeadConfig(widths=(8, 8, 8), dropout=0.0, pool_first=pool_first)
    pointwise = HeadConfig(widths=(8, 8, 8), dropout=0.0)
    sizes = {
        "hs": HS,
        "fast": FAST,
        "root_heads": heads,
        "pooled_heads": heads,
        "point_heads": pointwise,
        "num_points": 64,
    }
    return NetworkConfig(encoder=encoder, **(sizes | changes))


def random_like(shapes: Any, seed: int = 0) -> Any:
    """Float32 arrays of the shapes in a tree: kernels by fan-in, positive scales and variances."""
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        if path[-1].key in ("var", "scale"):
            return rng.uniform(0.5, 1.5, leaf.shape).astype(np.float32)
        fan_in = leaf.shape[0] if len(leaf.shape) > 1 else 10.0
        return (rng.normal(size=leaf.shape) / np.sqrt(fan_in)).astype(np.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def random_scorer(num_parts: int = 2, seed: int = 3) -> Any:
    """The weights that state readings (``models.hypotheses``), as fitting would leave them."""
    features = np.zeros((1, num_features(num_parts)), np.float32)
    shapes = jax.eval_shape(
        ReadingScorer().init, jax.random.key(0), features, np.zeros(1, np.int32)
    )["params"]
    return {**random_like(shapes, seed), "sharpness": np.ones(2, np.float32)}


def random_variables(category: Category, config: NetworkConfig, seed: int = 0) -> Any:
    """{"params": {"root", "parts"}, "batch_stats": {...}} as training would leave them."""
    task = Objective(category, config, LossConfig())
    return random_like(jax.eval_shape(task.init, jax.random.key(0)), seed)
