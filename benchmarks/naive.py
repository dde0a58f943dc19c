"""The HS-Encoder as one would write it down: the reference that its fast formulation is held to.

The same networks and weights, with each building block in its obvious form: neighbors by sorting
all distances, maxima over [B, N, k, C] at once with JAX's own derivatives, features brought to
every point before the heads' first layer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

from caper_jax.models import encoders
from caper_jax.models.encoders import hs as hs_encoder
from caper_jax.models.encoders.features import Features, Level
from caper_jax.models.encoders.neighbors import gather, squared_distances


def nearest(query, points, k: int, exclude_self: bool = False):
    """As ``graph.nearest``, by a full sort of [B, N, M]."""
    distance = squared_distances(query, points)
    if exclude_self:
        distance += jnp.diag(jnp.full(distance.shape[-1], jnp.inf, distance.dtype))
    return distance.argsort(-1)[..., :k]


def directional_max(direction, index, features, weights):
    """As ``graph.directional_max``, through [B, N, k, C]."""
    theta = jax.nn.relu(jnp.einsum("bnki,ic->bnkc", direction, weights, precision="highest"))
    if features is not None:
        theta = theta * gather(features, index)
    return theta.max(2)


def neighbor_max(features, index):
    """As ``graph.neighbor_max``, through [B, N, k, C]."""
    return gather(features, index).max(2)


class Encoder(hs_encoder.HSEncoder):
    """The encoder with all its features at every point."""

    def __call__(self, points, train: bool, space: Any = None) -> Features:
        del space  # found anew by each network
        features = super().__call__(points, train)
        levels = tuple(Level(level.at_points(level.features)) for level in features.levels)
        return Features(features.points, levels, features.shared)


@contextmanager
def formulation() -> Iterator[None]:
    """Networks traced inside are the naive ones."""
    reductions: Any = {
        "nearest": nearest,
        "directional_max": directional_max,
        "neighbor_max": neighbor_max,
    }
    with (
        mock.patch.multiple(hs_encoder, **reductions),
        mock.patch.dict(encoders.ENCODERS, {"hs": Encoder}),
    ):
        yield
