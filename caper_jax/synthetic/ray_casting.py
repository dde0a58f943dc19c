"""Exact ray casting of an articulated object made of solids (one instance; vmap over batches).

A solid minus a convex hole is hit at its near side unless that lies inside the hole, then where the
ray leaves the hole. No iteration, no mesh; ``intervals`` holds the formulas.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from caper_jax.geometry.solids import Kind
from caper_jax.synthetic.instances import SolidGroup
from caper_jax.synthetic.intervals import (
    INTERVAL,
    LIMIT,
    SURFACE,
    at,
    camera_frame,
    larger,
    matvec,
    smaller,
)

FAR = 1e9
# x and y of directions (x, y, 1) in the camera frame.
Rays = tuple[Float[Any, " R"], Float[Any, " R"]] | Float[Any, "2 R"]
_UNIT_CORNERS = [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]


def _surfaces(groups: dict[str, SolidGroup], poses):
    """What is the same for all rays, by name of the group and role, "solid" or "hole".

    Solids of a kind are worked out together, whatever part they belong to: fewer, larger
    operations compile and run faster.
    """
    rows: dict[Kind, list[Any]] = {}
    places: dict[tuple[str, str], tuple[Kind, slice]] = {}
    for name, group in groups.items():
        solid = (group.to_unit, group.center, group.taper)
        hole = (group.hole_to_unit, group.hole_center, group.hole_taper)
        roles: tuple[tuple[str, Kind | None, Any], ...] = (
            ("solid", group.kind, solid),
            ("hole", group.hole, hole),
        )
        for role, kind, row in roles:
            if kind is not None:
                stack = rows.setdefault(kind, [])
                start = sum(len(part) for _, part in stack)
                places[name, role] = kind, slice(start, start + len(group.part))
                stack.append((row, group.part))
    found = {}
    for of_kind, stack in rows.items():
        to_unit, center, taper = jax.tree.map(
            lambda *values: jnp.concatenate(values), *(row for row, _ in stack)
        )
        parts = np.concatenate([part for _, part in stack])
        found[of_kind] = SURFACE[of_kind](camera_frame(to_unit, center, taper, poses[parts]))
    return {key: at(found[kind], place) for key, (kind, place) in places.items()}


def part_depths(
    groups: dict[str, SolidGroup], poses: Float[Any, "K 4 4"], rays: Rays
) -> Float[Array, "K R"]:
    """First hit of each ray on each part, as if the other parts were not there.

    Args:
      groups: one instance's solids (no leading instance axis).
      poses: [K, 4, 4] part rest frame -> camera.
      rays: (x [R], y [R]); directions (x, y, 1) in the camera frame.

    Returns:
      [K, R] meters, ``FAR`` where nothing is hit.
    """
    surfaces = _surfaces(groups, poses)
    nearest = jnp.zeros((len(poses), *rays[0].shape))
    for name, group in groups.items():
        surface, visible = surfaces[name, "solid"]
        hole = None
        if group.hole is not None:
            hole, outside = surfaces[name, "hole"]
            visible |= ~outside  # from inside the hole its walls are seen
        # No hit behind the camera, none at all on a free slot.
        least = jnp.where(group.valid & visible, 0.0, LIMIT)

        def body(nearest, row, group=group):
            surface, hole, least, part = row
            near, far = INTERVAL[group.kind](surface, rays)
            first = near
            if hole is not None:
                enter, leave = INTERVAL[group.hole](hole, rays)
                first = jnp.where((near <= enter) & (near >= leave), leave, near)
            first = jnp.where(first > larger(far, least), first, 0.0)
            return nearest.at[part].set(larger(nearest[part], first)), None

        # A scan with a running maximum: one result per step, or XLA works out each solid twice.
        nearest, _ = jax.lax.scan(body, nearest, (surface, hole, least, np.array(group.part)))
    return smaller(1.0 / nearest, FAR)


def cast(
    groups: dict[str, SolidGroup], poses: Float[Any, "K 4 4"], rays: Rays
) -> tuple[Float[Array, " R"], Int[Array, " R"]]:
    """First hit of each ray on the object; arguments as of ``part_depths``.

    Returns:
      depth [R] meters (``FAR`` where nothing is hit) and part [R] int32 (-1 where nothing).
    """
    return nearest_part(part_depths(groups, poses, rays))


def nearest_part(
    depths: Float[Array, K * R],
) -> tuple[Float[Array, "*R"], Int[Array, "*R"]]:
    """Depth [R] and part [R] (-1 where there is none) from the depths [K, R] of all parts."""
    depth, part = jnp.full(depths.shape[1:], FAR), jnp.full(depths.shape[1:], -1, jnp.int32)
    for index, other in enumerate(depths):
        part = jnp.where(other < depth, index, part)
        depth = smaller(other, depth)
    return depth, part


def projected_bounds(
    groups: dict[str, SolidGroup], poses: Float[Any, "K 4 4"]
) -> tuple[Float[Array, " 2"], Float[Array, " 2"]]:
    """Bounds (low [2], high [2]) of the object on the plane z = 1, from its solids' corners."""
    solids = list(groups.values())
    part = np.concatenate([group.part for group in solids])
    axes, center, valid = (
        jnp.concatenate([getattr(group, name) for group in solids])
        for name in ("half_axes", "center", "valid")
    )
    points = matvec(axes[:, None], jnp.asarray(_UNIT_CORNERS)) + center[:, None]
    pose = poses[part]
    points = matvec(pose[:, None, :3, :3], points) + pose[:, None, :3, 3]
    plane = points[..., :2] / points[..., 2:]
    low = jnp.where(valid[:, None, None], plane, FAR).min((0, 1))
    high = jnp.where(valid[:, None, None], plane, -FAR).max((0, 1))
    return low, high
