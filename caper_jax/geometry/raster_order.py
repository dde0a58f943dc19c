"""Raster order: points along the rows of the image that they fall on, alternately left and right.

Networks look at every n-th point of a cloud in several places; what those show of the object
depends on the order of the points. In raster order they are spread evenly over the image, whatever
order the points came in, and so is every pick of evenly spaced ones.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int, Integer, Shaped

ROWS = 32  # over an object that fills its box
_ROW_BITS = 6
_LINE_BITS = 3  # of a row: what decides between points in the same column
_EVEN_STD = 12**-0.5  # standard deviation of what spreads evenly over a length of 1
_REACH = 4.0  # standard deviations; points farther out share the outermost column


def raster_order(points) -> Any:
    """The order that sorts points into image rows, alternately left to right and back.

    Works on numpy and JAX arrays; a function of the set of points but for the places of points in
    equal places. Piecewise constant: no gradient passes.

    Args:
      points: [..., N, 3] camera or viewing frame, any unit, finite, mostly in front of the camera.

    Returns:
      [..., N] indices: unsigned integers, int64 for numpy.
    """
    xp = points.__array_namespace__()
    on_host = isinstance(points, np.ndarray)
    if not on_host:
        points = lax.stop_gradient(points)
    depth = points[..., 2]
    # What lies close to the camera, or behind it, must not stretch the image.
    nearest = xp.maximum(0.5 * depth.mean(axis=-1, keepdims=True), 1e-6)
    depth = xp.maximum(depth, nearest)
    across, down = (_standardized(points[..., i] / depth, xp) for i in range(2))

    # One integer holds row, column, line within the row and index: sorting these takes a fraction
    # of the time of argsort.
    dtype = xp.uint64 if on_host else xp.uint32
    count = points.shape[-2]
    index_bits = max(count - 1, 1).bit_length()
    column_bits = (64 if on_host else 32) - _ROW_BITS - _LINE_BITS - index_bits
    rows, lines, columns = 1 << _ROW_BITS, 1 << _LINE_BITS, 1 << min(column_bits, 16)
    down = xp.clip(down * (ROWS * _EVEN_STD) + rows // 2, 0.0, rows - 1.0)
    row = xp.floor(down)
    line = xp.floor((down - row) * lines).astype(dtype)
    row = row.astype(dtype)
    across = xp.where(row & 1 == 1, -across, across) * (columns / (2 * _REACH))
    column = xp.clip(across + columns // 2, 0, columns - 1).astype(dtype)
    packed = (row * columns + column) * lines + line
    packed = packed * (1 << index_bits) + xp.arange(count, dtype=dtype)
    order = xp.sort(packed, axis=-1) & ((1 << index_bits) - 1)
    return order.astype(np.int64) if on_host else order


def to_raster_order(
    values: Shaped[Array, "B N C"], order: Integer[Array, "B N"]
) -> Shaped[Array, "B N C"]:
    """Rows of values in the order of ``raster_order``."""
    return jnp.take_along_axis(values, order[..., None], axis=-2, mode="promise_in_bounds")


def from_raster_order(
    values: Shaped[Array, "B N C"], order: Integer[Array, "B N"]
) -> Shaped[Array, "B N C"]:
    """Rows of values back where they were before ``to_raster_order``."""

    def put(rows, order):
        nothing = jnp.zeros_like(rows)
        return nothing.at[order].set(rows, unique_indices=True, mode="promise_in_bounds")

    return jax.vmap(put)(values, order)


def grid_raster_order(lines: int) -> Int[np.ndarray, "pixels"]:
    """The raster order of all pixels of an image of ``lines`` by ``lines``: raster indices.

    Subsets in this order are nearly in that of ``raster_order``, without a sort.
    """
    row, column = np.divmod(np.arange(lines * lines), lines)
    band = row // max(1, round(lines / ROWS))
    return np.lexsort((row, np.where(band % 2 == 1, -column, column), band))


def _standardized(values, xp):
    """[..., N] less their mean, over their standard deviation."""
    values = values - values.mean(axis=-1, keepdims=True)
    deviation = xp.sqrt((values * values).mean(axis=-1, keepdims=True))
    return values / xp.maximum(deviation, 1e-9)
