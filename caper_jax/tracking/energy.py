"""Energy of a keyframe (paper Eq 16): does its cloud, moved by the increment, explain the frame?"""

from __future__ import annotations

import jax.numpy as jnp

from caper_jax.models.encoders.neighbors import squared_distances


def chamfer_energy(points, labels, key_points, key_labels, num_parts: int, size):
    """Mean over parts of the two-way Chamfer distance, relative to the object's size.

    Both clouds are in one frame, the keyframe's moved by each part's increment (errata: the paper
    mixes frames). Distances are not squared; each way is a mean over the part's points, and the
    two ways are averaged. Parts that either cloud does not show are left out.

    Args:
      points: [N, 3]; labels: [N] int32.
      key_points: [M, 3]; key_labels: [M] int32.
      num_parts: K.
      size: [] the object's diagonal, in the unit of the points.

    Returns:
      []; zero when no part is shown in both.
    """
    squared = squared_distances(points[None], key_points[None])[0]
    squared = jnp.where(labels[:, None] == key_labels, squared, jnp.inf)
    parts = jnp.arange(num_parts)
    first, seen = _mean_by_part(squared.min(1), labels, parts)
    second, key_seen = _mean_by_part(squared.min(0), key_labels, parts)
    both = (seen > 0) & (key_seen > 0)
    total = jnp.where(both, 0.5 * (first + second), 0.0).sum()
    return total / jnp.maximum(both.sum(), 1) / size


def _mean_by_part(squared, labels, parts):
    """(mean distance [K], number of points [K]) of the points that found a partner."""
    found = jnp.isfinite(squared) & (squared > 0)
    distance = jnp.where(found, jnp.sqrt(jnp.where(found, squared, 1.0)), 0.0)
    member = (labels[:, None] == parts) & jnp.isfinite(squared)[:, None]
    count = member.sum(0)
    return (distance[:, None] * member).sum(0) / jnp.maximum(count, 1), count
