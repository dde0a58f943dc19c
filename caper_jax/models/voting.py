"""Scale-aware heatmap voting for joint parameters (paper Sec 5.2.1, Eqs 6 and 7)."""

from __future__ import annotations

from caper_jax.models.heads import unit_vectors


def vote(points, heatmap, offset, direction):
    """Joint pivot and direction as heatmap-weighted means of the points' votes.

    The weights are divided by their sum: with the 1/N of the printed equations the pivot shrinks
    towards the origin (errata). The pivot is a point on the axis; where along it is arbitrary.

    Args:
      points: [B, N, 3].
      heatmap: [B, N, J] >= 0.
      offset: [B, N, J, 3] from each point to its foot on the axis.
      direction: [B, N, J, 3].

    Returns:
      axis [B, J, 3] unit vectors and pivot [B, J, 3].
    """
    weight = heatmap + 1e-9  # where no point has any, all have the same
    share = weight / weight.sum(axis=1, keepdims=True)
    pivot = (share[..., None] * (points[:, :, None, :] + offset)).sum(axis=1)
    axis = (share[..., None] * direction).sum(axis=1)
    return unit_vectors(axis), pivot
