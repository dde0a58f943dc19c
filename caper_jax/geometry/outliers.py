"""Points that do not belong: radius outlier removal on a voxel grid, at a fixed number of points.

Raw clouds have specks, flying pixels at depth jumps and ghosts along the rays. A few of them move
mean, radius and maxima of a cloud far more than their number says. What lies alone, compared with
how densely the rest lies, is left out before scale and order are taken.

A grid of counts costs a tenth of all distances between points, and finds the same ones.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Shaped

# Side of a voxel over the median distance from the median point, at _DENSITY distinct points; how
# many others a point needs in the 27 voxels around its own; and voxels per side of the grid.
_COARSE = (0.25, 2, 27)
_FINE = (0.15, 3, 35)
_DENSITY = 1024
# Shares of points alone on the coarse grid, from which on one neighbor more is asked for, and the
# fine grid is used as well: surfaces seen at a grazing angle are sparse in clean clouds, too.
_SPECKLED, _DIRTY = 0.005, 0.02
_STRIDE = 8  # every n-th point is enough for medians
_LEAST = 0.5  # of which share of the points are never fewer kept: else nothing is left out


@flax.struct.dataclass
class Inliers:
    """Which points of a cloud belong to its object, and the cloud that they make.

    Attributes:
      kept: of the points as they came.
      index: for each point of the cloud without strays, which one of those that came it is;
        ascending, kept ones repeated evenly.
      position: for each point that came, a place where it stands in that cloud; of strays that of
        the kept one before it.
      distinct: number of different points among the kept.
    """

    kept: Bool[Array, "B N"]
    index: Int[Array, "B N"]
    position: Int[Array, "B N"]
    distinct: Int[Array, "B"]

    def apply(self, values: Shaped[Array, "B N C"]) -> Shaped[Array, "B N C"]:
        """The rows of the kept points, repeated evenly in the places of the others."""
        return jnp.take_along_axis(values, self.index[..., None], axis=1, mode="clip")

    def undo(self, values: Shaped[Array, "B N C"]) -> Shaped[Array, "B N C"]:
        """Rows for the points as they came, from rows for the cloud without strays."""
        return jnp.take_along_axis(values, self.position[..., None], axis=1, mode="clip")


def find_inliers(points: Float[Array, "B N 3"]) -> Inliers:
    """Leaves out points that lie alone; the number of points stays.

    The choice is piecewise constant: no gradient passes through it, while gradients pass through
    the points that are kept. Where nothing lies alone, the cloud stays as it is, to the bit.

    Args:
      points: any frame and unit, in raster order (``raster_order``): equal points then follow each
        other, and the choice does not depend on the order in which points came.
    """
    points = lax.stop_gradient(points)
    # Clouds in turn: a CPU keeps one grid in its cache, a GPU would wait for each.
    kept = lax.platform_dependent(
        points, cpu=lambda points: lax.map(_is_kept, points), default=jax.vmap(_is_kept)
    )
    index, position = _repeat_kept(kept)
    cloud = jnp.take_along_axis(points, index[..., None], axis=1, mode="clip")
    return Inliers(kept, index, position, count_distinct(cloud))


def _is_kept(points: Float[Array, "N 3"]) -> Bool[Array, "N"]:
    """``Inliers.kept`` of one cloud."""
    sample = points[::_STRIDE]
    center = jnp.median(sample, axis=0)
    scale = jnp.sqrt(jnp.median(jnp.square(sample - center).sum(-1)))
    offset = (points - center) / jnp.maximum(scale, 1e-12)
    # Fewer points lie farther apart; repeated ones are counted as often as they are repeated.
    distinct = count_distinct(points[None])[0]
    sparsity = jnp.sqrt(jnp.maximum(_DENSITY / distinct, 1.0))
    repeats = points.shape[0] / distinct

    def others(side, _, voxels):
        return neighbor_counts(offset / (side * sparsity), voxels) / repeats - 1.0

    coarse = others(*_COARSE)
    alone = (coarse < _COARSE[1] - 0.5).mean()
    kept = coarse >= _COARSE[1] - 0.5 + (alone > _SPECKLED)
    kept &= (others(*_FINE) >= _FINE[1] - 0.5) | (alone <= _DIRTY)
    return kept | (kept.mean() < _LEAST)


def count_distinct(points: Float[Array, "B N 3"]) -> Int[Array, "B"]:
    """How many different points a cloud in raster order has."""
    changes = (points[:, 1:] != points[:, :-1]).any(-1)
    return changes.sum(-1, dtype=jnp.int32) + 1


def neighbor_counts(offset: Float[Array, "N 3"], voxels: int) -> Float[Array, "N"]:
    """Points in the 27 voxels around each point, itself included.

    Args:
      offset: from the middle of the grid, in voxels; what lies beyond shares the outermost ones.
      voxels: per side.
    """
    cell = jnp.clip(jnp.floor(offset + voxels / 2), 1, voxels - 2).astype(jnp.int32)
    flat = (cell[:, 0] * voxels + cell[:, 1]) * voxels + cell[:, 2]
    count = jnp.zeros(voxels**3, jnp.int32).at[flat].add(1, mode="promise_in_bounds")
    count = count.reshape(voxels, voxels, voxels)
    for axis in range(3):  # the outermost voxels are empty: nothing wraps around
        # Without the barrier each sum is computed again for every one that needs it.
        count = lax.optimization_barrier(count)
        count = count + jnp.roll(count, 1, axis) + jnp.roll(count, -1, axis)
    return count.ravel().at[flat].get(mode="promise_in_bounds").astype(offset.dtype)


def _repeat_kept(kept: Bool[Array, "B N"]) -> tuple[Int[Array, "B N"], Int[Array, "B N"]]:
    """(index, position) of ``Inliers``: place i takes the kept point of rank floor(i K / N)."""
    number = kept.shape[1]
    rank = jnp.cumsum(kept, axis=1, dtype=jnp.int32)
    total = rank[:, -1:]
    wanted = jnp.arange(number, dtype=jnp.int32) * total // number + 1
    index = jax.vmap(lambda ranks, of: jnp.searchsorted(ranks, of, side="left"))(rank, wanted)
    first = jnp.maximum(rank - 1, 0)
    position = -(-first * number // total)  # the first place that takes it
    return index.astype(jnp.int32), position
