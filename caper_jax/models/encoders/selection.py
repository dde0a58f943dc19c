"""The k smallest of each row, faster on a CPU than ``lax.top_k``."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

_FEW = 128  # columns, up to which top_k is as fast
_GROUPS = 32  # at least; more of them for rows longer than its square


def smallest_k(values, k: int):
    """Columns [B, N, k] (int32) of the k smallest of values [B, N, M], in order.

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


def first_smallest(values, axis: int = -1):
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
