"""Checks of arrays from outside: shape, dtype, range, and where they go wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from caper_jax.errors import CaperError


def array_problem(
    name: str,
    value: Any,
    shape: tuple[int | None, ...],
    dtype: type = np.floating,
    low: float = -np.inf,
    high: float = np.inf,
) -> str | None:
    """What is wrong with an array from outside, as a phrase that begins with its name, or None.

    Args:
      name: of the array or field.
      value: anything that numpy takes for an array.
      shape: what its shape must be; None stands for any length but 0.
      dtype: its dtype, or an abstract one such as ``np.integer``.
      low, high: range of its entries, ends included; none may be NaN or infinite in any case.
    """
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different length
        return f"{name} must be an array of shape {_shape_text(shape)}"
    if array.ndim != len(shape) or any(
        length != known if known is not None else length == 0
        for known, length in zip(shape, array.shape, strict=True)
    ):
        return f"{name} has shape {array.shape}, expected {_shape_text(shape)}"
    if not np.issubdtype(array.dtype, dtype):
        return f"{name} is {array.dtype}, expected {dtype.__name__}"
    if array.dtype.kind in "fc" and not np.isfinite(array).all():
        return f"{name} has NaN or infinite entries{first_entry(~np.isfinite(array))}"
    outside = (array < low) | (array > high)
    if outside.any():
        worst = array[tuple(np.argwhere(outside)[0])]
        limits = f"at least {low:g}" if high == np.inf else f"from {low:g} to {high:g}"
        return f"{name} must be {limits}, got {worst}{first_entry(outside)}"
    return None


def checked_array(
    where: str,
    value: Any,
    shape: tuple[int | None, ...],
    dtype: type = np.number,
    low: float = -np.inf,
    high: float = np.inf,
) -> np.ndarray:
    """An array from outside; CaperError, which begins with ``where``, for a wrong one."""
    problem = array_problem(where, value, shape, dtype, low, high)
    if problem:
        raise CaperError(problem)
    return np.asarray(value)


def finite_array(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Float64 numbers of a shape from (nested lists of) numbers; ValueError for anything else."""
    try:
        array = np.asarray(value, np.float64).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        array = np.full(1, np.nan)
    if not np.isfinite(array).all():
        raise ValueError(f"must be {' x '.join(map(str, shape))} finite numbers")
    return array


def first_entry(bad: np.ndarray) -> str:
    """Where the first true entry is, as " at [i, j]"; nothing for a scalar."""
    index = np.argwhere(bad)[0]
    return f" at {index.tolist()}" if index.size else ""


def _shape_text(shape: tuple[int | None, ...]) -> str:
    """(N, 3) for (None, 3)."""
    axes = ["N" if length is None else str(length) for length in shape]
    return f"({', '.join(axes)}{',' if len(axes) == 1 else ''})"


def unit_gravity(gravity: Any, batch: int) -> Float[np.ndarray, "B 3"]:
    """Directions of gravity as unit vectors, one per cloud.

    Args:
      gravity: [3] or [B, 3], of any length.
      batch: B.

    Raises:
      CaperError: another shape, or a vector that is zero or not finite.
    """
    try:
        down = np.asarray(gravity, np.float64)
        if down.shape[-1:] != (3,):
            raise ValueError(f"got shape {down.shape}")
        down = np.broadcast_to(down, (batch, 3))
    except (TypeError, ValueError) as error:
        raise CaperError(
            f"gravity must be three numbers, or three for each of {batch} clouds ({error})"
        ) from error
    length = np.linalg.norm(down, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 1e-6)).all():
        raise CaperError(f"gravity must be a direction in the camera frame, got {down.tolist()}")
    return (down / length).astype(np.float32)
