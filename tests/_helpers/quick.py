"""Programs of which shapes alone matter are traced, not compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def traced_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Stands for ``jax.jit`` where shapes alone matter: traces, and answers with random numbers."""
    rng = np.random.default_rng(0)

    def draw(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        return rng.uniform(0.5, 1.0, leaf.shape).astype(leaf.dtype)

    return lambda *arguments, **named: jax.tree.map(
        draw, jax.eval_shape(function, *arguments, **named)
    )
