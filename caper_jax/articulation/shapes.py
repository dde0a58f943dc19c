"""Objects drawn from a category's shape function: how they are seeded, checked and averaged."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from caper_jax.arrays import array_problem
from caper_jax.articulation.category import Category, ObjectModel
from caper_jax.errors import CaperError
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.geometry.solids import bounds

# Splits never share an instance: each draws from its own family of seeds.
SPLITS = {"train": 0, "val": 1, "test": 2}
_DRAWN = 200  # instances from which what a category leaves out is computed
_COMPARED = 16  # instances with which what a category declares is compared
_NETWORK_DIAGONAL = 2.0  # of the mean object, in network units
_FACTOR = 3.0  # by which declared sizes may differ from drawn ones
_LARGEST_ANGLE = 4 * np.pi  # radians; more are degrees


class ShapeStatistics(NamedTuple):
    """Means over drawn objects.

    Attributes:
      unit: network units per meter at which the mean diagonal of the whole object is 2.
      mean_size: [K, 3] meters.
      mean_center: [K, 3] meters, centers of the parts' boxes in the rest-canonical frame.
      mean_diagonal: meters, of the whole object at rest.
    """

    unit: float
    mean_size: Float[np.ndarray, "K 3"]
    mean_center: Float[np.ndarray, "K 3"]
    mean_diagonal: float


def centered(model: ObjectModel) -> ObjectModel:
    """The model with its origin at the center of the whole object's box at rest."""
    low, high = bounds([solid for part in model.parts for solid in part])
    offset = -(low + high) / 2
    parts = [[solid.moved(offset) for solid in part] for part in model.parts]
    return ObjectModel(parts, model.axis, model.pivot + offset, model.limits)


def draw_shapes(category: Category, count: int, split: str, seed: int) -> list[ObjectModel]:
    """``count`` objects as the shape function gives them, not centered yet.

    Raises:
      CaperError: unknown split, a category without a shape function, or an object that is no
        instance of it.
    """
    if split not in SPLITS:
        raise CaperError(f"unknown split {split!r} (known: {', '.join(SPLITS)})")
    if category.shape is None:
        raise CaperError(
            f"category {category.name!r} has no shape function to draw objects from: give it one "
            "(Category.shape), or use a dataset (--data) instead of generated frames"
        )
    # The name enters the seed so that categories do not share their random streams.
    root = [zlib.crc32(category.name.encode()), SPLITS[split], seed]
    models = []
    for index in range(count):
        model = category.shape(np.random.default_rng([*root, index]))
        problem = _problem(category, model)
        if problem:
            raise CaperError(f"category {category.name!r}: a drawn shape is wrong: {problem}")
        models.append(model)
    return models


def _problem(category: Category, model: Any) -> str | None:
    """What keeps an object from being an instance of a category, or None."""
    if not isinstance(model, ObjectModel):
        return f"{type(model).__name__} is no ObjectModel"
    if len(model.parts) != category.num_parts or not all(model.parts):
        solids = ", ".join(str(len(part)) for part in model.parts)
        return f"parts have {solids} solids; each of {', '.join(category.parts)} needs one or more"
    count = category.num_joints
    for name, columns in (("axis", 3), ("pivot", 3), ("limits", 2)):
        problem = array_problem(name, getattr(model, name), (count, columns), np.number)
        if problem:
            return problem
    lengths = np.linalg.norm(model.axis, axis=-1)
    for part, joint, length, (low, high) in zip(
        category.parts[1:], category.joints, lengths, model.limits, strict=True
    ):
        if abs(length - 1) > 1e-3:
            return f"the joint of {part!r} has an axis of length {length:.4g}, not 1"
        if low > high:
            return f"the joint of {part!r} has limits that are no range: {low:.4g} to {high:.4g}"
        if joint.type == "revolute" and max(abs(low), abs(high)) > _LARGEST_ANGLE:
            return f"the joint of {part!r} has limits {low:.4g} to {high:.4g}; they are radians"
    return None


def shape_statistics(models: Sequence[ObjectModel]) -> ShapeStatistics:
    """Means over objects drawn from one category, at least one."""
    boxes = np.array([[bounds(part) for part in model.parts] for model in models])
    middles = (boxes[:, :, 0].min(1) + boxes[:, :, 1].max(1)) / 2
    size = boxes[:, :, 1] - boxes[:, :, 0]
    center = boxes.mean(axis=2) - middles[:, None]
    diagonal = float(rest_diagonal(size, center).mean())
    return ShapeStatistics(
        _NETWORK_DIAGONAL / diagonal, size.mean(axis=0), center.mean(axis=0), diagonal
    )


def left_out(category: Category) -> dict[str, Any]:
    """Those of unit, mean_size and mean_center that a category leaves out, from its shapes."""
    drawn = shape_statistics(draw_shapes(category, _DRAWN, "train", 0))

    def rows(values: np.ndarray) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(_rounded(value) for value in row) for row in values)

    computed = {
        "unit": _rounded(drawn.unit),
        "mean_size": rows(drawn.mean_size),
        "mean_center": rows(drawn.mean_center),
    }
    return {name: value for name, value in computed.items() if not getattr(category, name)}


def _rounded(value: float) -> float:
    """Few digits, so that random streams of other versions of numpy hardly change a category."""
    return float(f"{value:.3g}")


def check_declared(category: Category, models: Sequence[ObjectModel]) -> None:
    """Compares what a category declares with what its shape function draws.

    Raises:
      CaperError: unit, mean_size or mean_center are not those of its shapes, by a factor of 3:
        placeholders, or another unit of length.
    """
    drawn = shape_statistics(models[:_COMPARED])
    size, center = np.array(category.mean_size), np.array(category.mean_center)
    wrong = {}
    if not 1 / _FACTOR < category.unit / drawn.unit < _FACTOR:
        wrong["unit"] = f"{category.unit:g} (drawn: {drawn.unit:.3g})"
    ratio = np.linalg.norm(size, axis=-1) / np.linalg.norm(drawn.mean_size, axis=-1)
    far = np.linalg.norm(center - drawn.mean_center, axis=-1).max()
    placeholder = not center.any() and far > 0.1 * drawn.mean_diagonal
    for name, is_wrong, declared, mean in (
        ("mean_size", not ((ratio > 1 / _FACTOR) & (ratio < _FACTOR)).all(), size, drawn.mean_size),
        ("mean_center", placeholder or far > drawn.mean_diagonal, center, drawn.mean_center),
    ):
        if is_wrong:
            wrong[name] = f"{declared.tolist()} (drawn: {np.round(mean, 3).tolist()})"
    if wrong:
        named = "; ".join(f"{name} {text}" for name, text in wrong.items())
        raise CaperError(
            f"category {category.name!r} declares other sizes than its shape function draws: "
            f"{named}; correct them, or leave them out to have them computed"
        )
