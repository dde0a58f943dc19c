"""Neighborhoods of point clouds and the two reductions over them, fast forwards and backwards.

Both reductions are maxima over k neighbors. They loop over the neighbors with a running maximum
(the [N, k, C] tensor is never built) and keep the winner's number, so that the backward pass
scatters once; plain automatic differentiation costs some thirty times the forward pass. Forward
mode and higher derivatives work as well.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Shaped

from caper_jax.models.linear_map import linear_map

BLOCK_ABOVE = 4096  # points, beyond which distances are not held all at once
_BLOCK = 512  # queries whose distances are
_FEW = 128  # columns, up to which top_k is as fast
_GROUPS = 32  # at least; more of them for rows longer than its square


def squared_distances(a: Float[Array, "B N C"], b: Float[Array, "B M C"]) -> Float[Array, "B N M"]:
    """Squared distances of all pairs."""
    if a.shape[-1] == 3:
        # One coordinate at a time: exact, and ten times as fast on a CPU as a sum over an axis of
        # three.
        total: Any = 0.0
        for axis in range(3):
            difference = a[:, :, None, axis] - b[:, None, :, axis]
            total += difference * difference
        return total
    cross = jnp.einsum("bnc,bmc->bnm", a, b)
    norms = (a * a).sum(-1)[:, :, None] + (b * b).sum(-1)[:, None, :]
    return jnp.maximum(norms - 2.0 * cross, 0.0)


def nearest(
    query: Float[Array, "B N C"], points: Float[Array, "B M C"], k: int, exclude_self: bool = False
) -> Int[Array, "B N k"]:
    """Indices of the k nearest of ``points`` to each ``query``.

    No gradient passes through the choice. With ``exclude_self`` query and points are the same
    array and no point is its own neighbor.
    """

    def choose(distance, first):
        if exclude_self:
            own = first + jnp.arange(distance.shape[1])
            itself = own[:, None] == jnp.arange(distance.shape[2])
            distance = jnp.where(itself, jnp.inf, distance)
        return smallest_k(distance, k)

    return _by_distance(choose, query, points)


def nearest_row(query: Float[Array, "B N C"], points: Float[Array, "B M C"]) -> Int[Array, "B N"]:
    """Index of the nearest of ``points`` to each ``query``."""
    return _by_distance(lambda distance, _: first_smallest(distance), query, points)


def _by_distance(choose, query, points):
    """``choose(squared distances [B, n, M], number of the first of the n queries)`` of all queries.

    Up to ``BLOCK_ABOVE`` points of all at once, else of blocks of queries in turn, so that memory
    grows with the number of points, not with its square.
    """
    query, points = lax.stop_gradient(query), lax.stop_gradient(points)
    batch, count, channels = query.shape
    if max(count, points.shape[1]) <= BLOCK_ABOVE:
        return choose(squared_distances(query, points), 0)
    blocks = -(-count // _BLOCK)
    padded = jnp.pad(query, ((0, 0), (0, blocks * _BLOCK - count), (0, 0)))
    rows = jnp.moveaxis(padded.reshape(batch, blocks, _BLOCK, channels), 1, 0)

    def one(block):
        first, own = block
        return choose(squared_distances(own, points), first)

    chosen = jnp.moveaxis(lax.map(one, (jnp.arange(blocks) * _BLOCK, rows)), 0, 1)
    return chosen.reshape(batch, blocks * _BLOCK, *chosen.shape[3:])[:, :count]


def smallest_k(values: Float[Array, "B N M"], k: int) -> Int[Array, "B N k"]:
    """Columns (int32) of the k smallest of each row, in order.

    Equal ones come by column; inf counts as absent while enough others are left. The same as
    ``lax.top_k(-values, k)[1]``, in a third of its time on a CPU.
    """
    columns = values.shape[-1]

    def by_top_k(values):
        return lax.top_k(-values, k)[1]

    if columns <= _FEW:
        chosen = by_top_k(values)
    else:
        # A GPU would be bound by the launches of the k rounds.
        chosen = lax.platform_dependent(
            values, cpu=lambda values: _by_groups(values, k), default=by_top_k
        )
    # Without the barrier a slice of the result ([..., :4], say) turns top_k into a full sort.
    return lax.optimization_barrier(chosen)


def first_smallest(values: Shaped[Array, "..."], axis: int = -1) -> Int[Array, "..."]:
    """As ``values.argmin(axis)``: two plain minima, which a CPU takes several at a time.

    Where values are NaN the index is any valid one.
    """
    axis %= values.ndim
    smallest = values.min(axis, keepdims=True)
    size = values.shape[axis]
    number = lax.broadcasted_iota(jnp.int32, values.shape, axis)
    return jnp.where(values == smallest, number, np.int32(size - 1)).min(axis)


def _by_groups(values, k: int):
    """k rounds: the smallest of the groups' smallest, then the next one of its group.

    Each round touches one value per group and one group per row, not the whole row.
    """
    batch, count, columns = values.shape
    groups = max(_GROUPS, 1 << (int(columns**0.5) - 1).bit_length())
    size = -(-columns // groups)
    padding = ((0, 0), (0, 0), (0, groups * size - columns))
    padded = jnp.pad(values, padding, constant_values=jnp.inf)
    rows = padded.reshape(-1, size)
    first = jnp.arange(batch * count, dtype=jnp.int32) * groups  # each row's first group
    members = jnp.arange(size, dtype=jnp.int32)
    numbers = jnp.arange(groups, dtype=jnp.int32)[:, None]

    def of_group(row):
        return row.min(-1), first_smallest(row)

    def take(heads, _):
        value, member = heads  # [groups, B N]: the smallest left in each group, and its place
        group = first_smallest(value, 0)
        head = numbers == group
        smallest, place = value.min(0), jnp.where(head, member, 0).max(0)
        row = rows.at[first + group].get(mode="promise_in_bounds")
        left = row > smallest[:, None]
        left |= (row == smallest[:, None]) & (members > place[:, None])
        following = of_group(jnp.where(left, row, jnp.inf))
        value, member = (
            jnp.where(head, new, old) for new, old in zip(following, heads, strict=True)
        )
        column = jnp.minimum(group * size + place, columns - 1)  # NaN must not lead outside
        return (value, member), column

    heads = of_group(padded.reshape(batch * count, groups, size))
    _, chosen = lax.scan(take, tuple(part.T for part in heads), length=k)
    return chosen.T.reshape(batch, count, k)


def smallest(squared: Float[Array, "*batch M"]) -> Int[Array, "*batch"]:
    """Index of the smallest of squared distances; no gradient passes.

    Float32 ones are compared as integers that carry the index in their lowest bits: a minimum is
    three times as fast as an argmin on a CPU. Distances that agree to 2^-13 may change places.
    """
    squared = lax.stop_gradient(squared)
    size = squared.shape[-1]
    bits = (size - 1).bit_length()
    if squared.dtype != jnp.float32 or bits > 10:
        return squared.argmin(-1)
    mask = (1 << bits) - 1
    packed = lax.bitcast_convert_type(squared, jnp.int32) & ~mask
    return (packed | jnp.arange(size, dtype=jnp.int32)).min(-1) & mask


def gather(
    features: Shaped[Array, "B M *row"], index: Int[Array, "B *at"]
) -> Shaped[Array, "B *at *row"]:
    """Rows of each batch element at its indices."""
    return jax.vmap(lambda rows, at: rows.at[at].get(mode="promise_in_bounds"))(features, index)


def directions(
    points: Float[Array, "B N 3"], index: Int[Array, "B N k"]
) -> Float[Array, "B N k 3"]:
    """Unit vectors from each point to its neighbors; zero if they meet."""
    offset = gather(points, index) - points[:, :, None, :]
    squared = (offset * offset).sum(-1, keepdims=True)
    apart = squared > 1e-24
    # Double where: the root's slope at zero never meets a zero cotangent.
    return jnp.where(apart, offset * lax.rsqrt(jnp.where(apart, squared, 1.0)), 0.0)


def _theta(direction, weights):
    """relu(direction [B, N, 3] . weights [3, C]) written out: full precision everywhere."""
    x, y, z = direction[..., 0:1], direction[..., 1:2], direction[..., 2:3]
    return jax.nn.relu(x * weights[0] + y * weights[1] + z * weights[2])


def _term(direction, at, features, weights):
    theta = _theta(direction, weights)
    return theta if features is None else theta * gather(features, at)


def _winners(direction, index, features, weights):
    """Maximum over neighbors [B, N, C] and the number [B, N, C] (uint8) of the first winner."""
    direction, index = jnp.moveaxis(direction, 2, 0), jnp.moveaxis(index, 2, 0)

    def body(carry, neighbor):
        best, winner = carry
        number, toward, at = neighbor
        value = _term(toward, at, features, weights)
        return (jnp.maximum(best, value), jnp.where(value > best, number, winner)), None

    first = _term(direction[0], index[0], features, weights)
    numbers = jnp.arange(1, index.shape[0], dtype=jnp.uint8)
    start = (first, jnp.zeros(first.shape, jnp.uint8))
    (best, winner), _ = lax.scan(body, start, (numbers, direction[1:], index[1:]))
    return best, winner


@jax.custom_jvp
def directional_max(
    direction: Float[Array, "B N k 3"],
    index: Int[Array, "B N k"],
    features: Float[Array, "B M C"] | None,
    weights: Float[Array, "3 C"],
) -> Float[Array, "B N C"]:
    """max over neighbors j of relu(d_j . W) * f_j: the core of the HS layer (3D-GCN kernel).

    Args:
      direction: unit vectors to the neighbors.
      index: their rows in ``features``; k at most 256.
      features: supports, or None for the surface layer (f_j = 1).
      weights: unit support directions.
    """
    return _winners(direction, index, features, weights)[0]


@directional_max.defjvp
def _directional_max_jvp(primals, tangents):
    direction, index, features, weights = primals
    best, winner = _winners(direction, index, features, weights)
    changes = tangents[0], tangents[2], tangents[3]
    # Of the residuals only the winner's number is [N, C]: the rest is found again from it.
    return best, linear_map(
        _directional_change, _directional_transpose, (*primals, winner), changes
    )


def _directional_change(residuals, changes):
    """How the winners' terms change with direction, features and weights."""
    direction, index, features, weights, winner = residuals
    d_direction, d_features, d_weights = changes
    parts = (jnp.moveaxis(array, 2, 0) for array in (direction, index, d_direction))

    def body(total, neighbor):
        number, toward, at, d_toward = neighbor
        _, change = jax.jvp(
            lambda toward, features, weights: _term(toward, at, features, weights),
            (toward, features, weights),
            (d_toward, d_features, d_weights),
        )
        return jnp.where(winner == number, change, total), None

    numbers = jnp.arange(index.shape[2], dtype=jnp.uint8)
    start = jnp.zeros(winner.shape, jnp.result_type(*jax.tree.leaves((direction, *residuals[2:4]))))
    return lax.scan(body, start, (numbers, *parts))[0]


def _directional_transpose(residuals, cotangent):
    direction, index, features, weights, winner = residuals
    channels = weights.shape[1]
    batch = cotangent.shape[0]
    numbers = jnp.arange(index.shape[2], dtype=jnp.uint8)
    per_neighbor = (numbers, jnp.moveaxis(direction, 2, 0), jnp.moveaxis(index, 2, 0))

    # The winner's direction and row, densely, so that one scatter is enough.
    def pick(carry, neighbor):
        number, toward, at = neighbor
        won = winner == number
        x, y, z, row = carry
        x = jnp.where(won, toward[..., 0:1], x)
        y = jnp.where(won, toward[..., 1:2], y)
        z = jnp.where(won, toward[..., 2:3], z)
        return (x, y, z, jnp.where(won, at[..., None], row)), None

    zeros = jnp.zeros_like(cotangent)
    start = (zeros, zeros, zeros, jnp.zeros(cotangent.shape, index.dtype))
    (x, y, z, row), _ = lax.scan(pick, start, per_neighbor)
    theta = x * weights[0] + y * weights[1] + z * weights[2]
    active = jnp.where(theta > 0, cotangent, 0.0)
    if features is None:
        d_features, d_theta = None, active
    else:
        size = features.shape[1] * channels
        flat = (row * channels + jnp.arange(channels)).reshape(batch, -1)

        def scatter(at, value):
            return jnp.zeros(size, value.dtype).at[at].add(value, mode="promise_in_bounds")

        d_features = jax.vmap(scatter)(flat, (active * theta).reshape(batch, -1))
        d_features = d_features.reshape(features.shape).astype(features.dtype)
        won = gather(features.reshape(batch, -1), flat).reshape(active.shape)
        d_theta = active * won
    d_weights = jnp.stack([(d_theta * axis).sum((0, 1)) for axis in (x, y, z)])

    # Needed only for derivatives with respect to the points; otherwise dead code under jit.
    def toward_points(_, neighbor):
        share = jnp.where(winner == neighbor[0], d_theta, 0.0)
        return None, jnp.einsum("bnc,ic->bni", share, weights, precision="highest")

    _, d_direction = lax.scan(toward_points, None, per_neighbor)
    d_direction = jnp.moveaxis(d_direction, 0, 2).astype(direction.dtype)
    return d_direction, d_features, d_weights.astype(weights.dtype)


@jax.custom_jvp
def neighbor_max(
    features: Float[Array, "B M C"], index: Int[Array, "B N k"]
) -> Float[Array, "B N C"]:
    """max over neighbors j of f_j."""
    return _neighbor_winners(features, index)[0]


def _neighbor_winners(features, index):
    index = jnp.moveaxis(index, 2, 0)
    first = gather(features, index[0])

    def body(carry, at):
        best, row = carry
        value = gather(features, at)
        return (jnp.maximum(best, value), jnp.where(value > best, at[..., None], row)), None

    start = (first, jnp.broadcast_to(index[0][..., None], first.shape))
    return lax.scan(body, start, index[1:])[0]


@neighbor_max.defjvp
def _neighbor_max_jvp(primals, tangents):
    best, row = _neighbor_winners(*primals)
    change, _ = tangents
    batch, _, channels = change.shape
    # Of one flat row, which transposes to one scatter.
    flat = (row * channels + jnp.arange(channels)).reshape(batch, -1)
    return best, gather(change.reshape(batch, -1), flat).reshape(best.shape)
