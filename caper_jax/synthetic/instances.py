"""The instance bank: many procedural objects packed into fixed-size arrays for the ray caster."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from caper_jax.articulation.category import Category, ObjectModel
from caper_jax.articulation.shapes import (
    centered,
    check_declared,
    draw_shapes,
    shape_statistics,
)
from caper_jax.geometry.solids import TAPERED, Kind, Solid, bounds


@flax.struct.dataclass
class SolidGroup:
    """All solids of one kind (e.g. box minus cylinder); M slots per instance.

    Attributes:
      to_unit: [n, M, 3, 3] rest-canonical offsets -> unit solid.
      center: [n, M, 3] meters.
      half_axes: [n, M, 3, 3] columns are the solid's half axes (for its corners).
      valid: [n, M] bool; unused slots are False.
      taper: [n, M, 2], or None for kinds that have none.
      hole_to_unit, hole_center, hole_taper: the same for the solid cut away, or None.
      part: M indices in ascending order: each slot serves one part. Static, as are the next two.
      kind: see ``Solid``.
      hole: kind of the solid cut away, or None.
    """

    to_unit: Float[Any, "*n M 3 3"]
    center: Float[Any, "*n M 3"]
    half_axes: Float[Any, "*n M 3 3"]
    valid: Bool[Any, "*n M"]
    taper: Any
    hole_to_unit: Any
    hole_center: Any
    hole_taper: Any
    part: tuple[int, ...] = flax.struct.field(pytree_node=False)
    kind: Kind = flax.struct.field(pytree_node=False)
    hole: Kind | None = flax.struct.field(pytree_node=False)


@flax.struct.dataclass
class InstanceBank:
    """n instances; leading axis n everywhere.

    Attributes:
      groups: {"box", "box-box", "cylinder", ...: SolidGroup}; the names are static.
      joint_axis: [n, J, 3]; joint_pivot: [n, J, 3] meters, rest-canonical frame.
      limits: [n, J, 2] radians or meters.
      size: [n, K, 3]; box_center: [n, K, 3] meters, rest-canonical frame.
    """

    groups: dict[str, SolidGroup]
    joint_axis: Float[Any, "*n J 3"]
    joint_pivot: Float[Any, "*n J 3"]
    limits: Float[Any, "*n J 2"]
    size: Float[Any, "*n K 3"]
    box_center: Float[Any, "*n K 3"]

    @property
    def num_instances(self) -> int:
        return self.size.shape[0]


def draw_instances(category: Category, count: int, split: str, seed: int) -> list[ObjectModel]:
    """``count`` instances of a category; other splits and seeds give other instances.

    Raises:
      CaperError: unknown split, a category without a procedural shape, or one whose shapes are not
        what it declares: parts, joints, unit axes, sizes, unit.
    """
    models = draw_shapes(category, count, split, seed)
    check_declared(category, models)
    return [centered(model) for model in models]


def statistics(category: Category, count: int = 1500, seed: int = 0) -> dict[str, Any]:
    """What a category's shape function draws on average.

    Args:
      category: with a shape function.
      count: instances of the training split.
      seed: of their draws.

    Returns:
      "unit" (network units per meter at which the mean diagonal is 2), "mean_size" and
      "mean_center" (K rows of x, y, z; meters), "mean_diagonal" (meters).

    Raises:
      CaperError: a category without a procedural shape, or shapes that are not its instances.
    """
    drawn = shape_statistics(draw_shapes(category, count, "train", seed))
    return {name: np.asarray(value).tolist() for name, value in drawn._asdict().items()}


def split_key(split: str, seed: int) -> PRNGKeyArray:
    """PRNG key of the frames of a split: cameras, states, sensors and which instances they show.

    "test" has the plain key of the seed, for the published figures rest on its frames; the others
    fold their name in, or their frames would show the same views of other instances.
    """
    key = jax.random.key(seed)
    return key if split == "test" else jax.random.fold_in(key, zlib.crc32(split.encode()))


def build_bank(models: list[ObjectModel]) -> InstanceBank:
    """Packs models (origins already centered) into one InstanceBank of float32 numpy arrays."""
    # Of each kind, the solids of each part of each model.
    found: dict[str, list[list[list[Solid]]]] = {}
    for index, model in enumerate(models):
        for part, solids in enumerate(model.parts):
            for solid in solids:
                name = solid.kind if solid.hole is None else f"{solid.kind}-{solid.hole.kind}"
                if name not in found:
                    found[name] = [[[] for _ in model.parts] for _ in models]
                found[name][index][part].append(solid)
    boxes = np.array([[bounds(part) for part in model.parts] for model in models])
    return InstanceBank(
        groups={name: _group(found[name]) for name in sorted(found)},
        joint_axis=np.array([model.axis for model in models], np.float32),
        joint_pivot=np.array([model.pivot for model in models], np.float32),
        limits=np.array([model.limits for model in models], np.float32),
        size=(boxes[:, :, 1] - boxes[:, :, 0]).astype(np.float32),
        box_center=((boxes[:, :, 1] + boxes[:, :, 0]) / 2).astype(np.float32),
    )


def _group(models: list[list[list[Solid]]]) -> SolidGroup:
    """Packs the solids of one kind of each part of each model."""
    # Of each part, as many slots as any model needs.
    slots = [max(map(len, solids)) for solids in zip(*models, strict=True)]
    if sum(slots) == 1:
        # Never a single slot: XLA merges a loop of one turn into what uses its result, where it
        # costs more than a further slot.
        slots[slots.index(1)] = 2
    rows: list[list[Solid | None]] = [[] for _ in models]
    for row, parts in zip(rows, models, strict=True):
        for solids, count in zip(parts, slots, strict=True):
            row += [*solids, *[None] * (count - len(solids))]
    like = next(solid for row in rows for solid in row if solid is not None)
    hole = None if like.hole is None else like.hole.kind

    def pack(value: Callable[[Any], Any], free: np.ndarray) -> np.ndarray:
        """A value of every solid, ``free`` in free slots."""
        values = [[free if solid is None else value(solid) for solid in row] for row in rows]
        return np.array(values, np.float32)

    def to_unit(solid: Any) -> np.ndarray:
        return solid.rotation.T / solid.half[:, None]

    eye, zeros, ones = np.eye(3), np.zeros(3), np.ones(2)
    return SolidGroup(
        to_unit=pack(to_unit, eye),
        center=pack(lambda solid: solid.center, zeros),
        half_axes=pack(lambda solid: solid.rotation * solid.half, np.zeros((3, 3))),
        valid=np.array([[solid is not None for solid in row] for row in rows]),
        taper=pack(lambda solid: solid.taper, ones) if like.kind in TAPERED else None,
        hole_to_unit=pack(lambda solid: to_unit(solid.hole), eye) if hole else None,
        hole_center=pack(lambda solid: solid.hole.center, zeros) if hole else None,
        hole_taper=pack(lambda solid: solid.hole.taper, ones) if hole in TAPERED else None,
        part=tuple(part for part, count in enumerate(slots) for _ in range(count)),
        kind=like.kind,
        hole=hole,
    )
