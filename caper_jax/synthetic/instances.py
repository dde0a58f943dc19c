"""The instance bank: many procedural objects packed into fixed-size arrays for the ray caster."""

from __future__ import annotations

import zlib
from collections import Counter
from typing import Any

import flax.struct
import jax
import numpy as np

from caper_jax.articulation.category import Category, ObjectModel
from caper_jax.errors import CaperError
from caper_jax.geometry.solids import TAPERED, Kind, Solid, bounds

# Splits never share an instance: each draws from its own family of seeds.
SPLITS = {"train": 0, "val": 1, "test": 2}


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

    to_unit: Any
    center: Any
    half_axes: Any
    valid: Any
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
    joint_axis: Any
    joint_pivot: Any
    limits: Any
    size: Any
    box_center: Any

    @property
    def num_instances(self) -> int:
        return self.size.shape[0]


def _group_name(solid: Solid) -> str:
    return solid.kind if solid.hole is None else f"{solid.kind}-{solid.hole.kind}"


def centered(model: ObjectModel) -> ObjectModel:
    """The model with its origin at the center of the whole object's box at rest."""
    low, high = bounds([solid for part in model.parts for solid in part])
    offset = -(low + high) / 2
    parts = [[solid.moved(offset) for solid in part] for part in model.parts]
    return ObjectModel(parts, model.axis, model.pivot + offset, model.limits)


def draw_instances(category: Category, count: int, split: str, seed: int) -> list[ObjectModel]:
    """``count`` instances of a category; other splits and seeds give other instances.

    Raises:
      CaperError: unknown split, or a category without a procedural shape.
    """
    if split not in SPLITS:
        raise CaperError(f"unknown split {split!r} (known: {', '.join(SPLITS)})")
    if category.shape is None:
        raise CaperError(f"category {category.name!r} has no procedural shape to generate from")
    # The name enters the seed so that categories do not share their random streams.
    root = [zlib.crc32(category.name.encode()), SPLITS[split], seed]
    return [
        centered(category.shape(np.random.default_rng([*root, index]))) for index in range(count)
    ]


def split_key(split: str, seed: int):
    """PRNG key of the frames of a split: cameras, states, sensors and which instances they show.

    "test" has the plain key of the seed, for the published figures rest on its frames; the others
    fold their name in, or their frames would show the same views of other instances.
    """
    key = jax.random.key(seed)
    return key if split == "test" else jax.random.fold_in(key, zlib.crc32(split.encode()))


def build_bank(models: list[ObjectModel]) -> InstanceBank:
    """Packs models (origins already centered) into one InstanceBank of float32 numpy arrays."""
    kinds: dict[str, Solid] = {}
    slots: Counter[tuple[str, int]] = Counter()  # of a kind and a part: the most of any instance
    for model in models:
        used: Counter[tuple[str, int]] = Counter()
        for part, solids in enumerate(model.parts):
            for solid in solids:
                kinds.setdefault(_group_name(solid), solid)
                used[_group_name(solid), part] += 1
        slots |= used
    groups, first = {}, {}
    for name in sorted(kinds):
        order = sorted(part for key, part in slots.elements() if key == name)
        # Never a single slot: XLA merges a loop of one turn into what uses its result, where it
        # costs more than a further slot.
        order = order if len(order) > 1 else 2 * order
        groups[name] = _empty_group(kinds[name], len(models), tuple(order))
        first.update({(name, part): order.index(part) for part in set(order)})
    for index, model in enumerate(models):
        free = dict(first)
        for part, solids in enumerate(model.parts):
            for solid in solids:
                name = _group_name(solid)
                _fill_slot(groups[name], index, free[name, part], solid)
                free[name, part] += 1
    boxes = np.array([[bounds(part) for part in model.parts] for model in models])
    return InstanceBank(
        groups=groups,
        joint_axis=np.array([model.axis for model in models], np.float32),
        joint_pivot=np.array([model.pivot for model in models], np.float32),
        limits=np.array([model.limits for model in models], np.float32),
        size=(boxes[:, :, 1] - boxes[:, :, 0]).astype(np.float32),
        box_center=((boxes[:, :, 1] + boxes[:, :, 0]) / 2).astype(np.float32),
    )


def _empty_group(like: Solid, count: int, part: tuple[int, ...]) -> SolidGroup:
    """Free slots, one for each entry of ``part``, for solids of the kind of ``like``."""
    slots = len(part)
    eye = np.tile(np.eye(3, dtype=np.float32), (count, slots, 1, 1))
    zeros = np.zeros((count, slots, 3), np.float32)
    ones = np.ones((count, slots, 2), np.float32)
    hole = None if like.hole is None else like.hole.kind
    return SolidGroup(
        to_unit=eye.copy(),
        center=zeros.copy(),
        half_axes=np.zeros_like(eye),
        valid=np.zeros((count, slots), bool),
        taper=ones.copy() if like.kind in TAPERED else None,
        hole_to_unit=eye.copy() if hole else None,
        hole_center=zeros.copy() if hole else None,
        hole_taper=ones.copy() if hole in TAPERED else None,
        part=part,
        kind=like.kind,
        hole=hole,
    )


def _fill_slot(group: SolidGroup, index: int, slot: int, solid: Solid) -> None:
    group.to_unit[index, slot] = solid.rotation.T / solid.half[:, None]
    group.center[index, slot] = solid.center
    group.half_axes[index, slot] = solid.rotation * solid.half
    group.valid[index, slot] = True
    if group.taper is not None:
        group.taper[index, slot] = solid.taper
    if solid.hole is not None:
        group.hole_to_unit[index, slot] = solid.hole.rotation.T / solid.hole.half[:, None]
        group.hole_center[index, slot] = solid.hole.center
        if group.hole_taper is not None:
            group.hole_taper[index, slot] = solid.hole.taper
