"""Oriented boxes: corners, distances of points, exact intersection over union.

The intersection of two boxes is the convex polyhedron of 12 half-spaces n_i . x <= b_i. Its volume
follows from the areas A_i of its faces, and those from the lengths L_ij of their edges (the
divergence theorem, one dimension at a time; Lasserre, "An analytical expression and an algorithm
for the volume of a convex polyhedron in R^n", 1983):

    V = 1/3 sum_i b_i A_i,    A_i = 1/2 sum_j d_ij L_ij,

with d_ij the distance, in face i, from a point of the face's plane to the line it shares with plane
j. An edge is that line cut to an interval by the other planes: 12 x 11 lines, 10 cuts each, no
branches and no vertices to sort.

Predictions nearly equal to the truth make planes that nearly coincide, and there rounding must not
let both planes, or neither, claim the same face. So each cut is written with a difference that is
the same number, up to sign, for both sides: on plane i,

    n_k . x <= b_k    is    (n_k - n_i) . x <= b_k - b_i,

on plane k the reverse; whatever rounding does, the two faces complement each other. (Of planes
facing each other it is the sum, the same for both.) Lines within a
face are held by the angle of their normal and their distance, for the same reason: sin(f_k - f_j)
changes sign with the order, to the last bit and however a compiler contracts sums of products.
Only exact ties are left: of planes facing the same way the one with the lower index stands, between
planes facing each other nothing is left. There is no tolerance to choose.

Derivatives use the geometry, not the arithmetic: moving plane i sweeps its face, so
dV = sum_i A_i db_i - (A_i c_i) . dn_i with c_i the centroid of face i.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from caper_jax.lie.linalg import apply, as_floating, dot, entries, multiply, norm, transpose

# Faces are numbered box * 6 + axis * 2 + (0 for the positive side, 1 for the negative).
_INDEX = np.arange(12)
_SIGN = np.array([1.0, -1.0])
# Planes that can cut face i: all but itself and the opposite face of its own box.
_CUTS = (_INDEX[:, None] // 2) != (_INDEX[None, :] // 2)
_FIRST = _INDEX[:, None] < _INDEX[None, :]
# How far out (meters) a line stands for a plane that never cuts a face, or leaves none of it.
_FAR = 1e6


def corners(
    rotation: ArrayLike, translation: ArrayLike, center: ArrayLike, size: ArrayLike
) -> Float[Array, "... 8 3"]:
    """Corners [..., 8, 3] of posed boxes, in the order (-,-,-), (-,-,+), (-,+,-), ... of x, y, z.

    Args:
      rotation: [..., 3, 3] part frame -> camera.
      translation: [..., 3] meters.
      center: [..., 3] meters, box center in the part frame.
      size: [..., 3] meters, full extents.
    """
    rotation = as_floating(rotation, (3, 3), "rotation")
    translation = as_floating(translation, (3,), "translation")
    center = as_floating(center, (3,), "center")
    size = as_floating(size, (3,), "size")
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)), dtype=size.dtype)
    local = center[..., None, :] + signs * size[..., None, :]
    return apply(rotation[..., None, :, :], local) + translation[..., None, :]


def signed_distance(points: ArrayLike, center: ArrayLike, size: ArrayLike) -> Float[Array, "..."]:
    """Distance [...] of points from the surface of axis-aligned boxes, negative inside.

    Residuals for fitting boxes to clouds: derivatives are finite everywhere.

    Args:
      points: [..., 3] in the frame of the box (the part's rest frame), any unit.
      center: [..., 3] of the box, same frame and unit.
      size: [..., 3] full extents.
    """
    points = as_floating(points, (3,), "points")
    center = as_floating(center, (3,), "center")
    beyond = jnp.abs(points - center) - as_floating(size, (3,), "size") / 2
    # Not max(-1): its derivative divides by how many entries equal the maximum, and a compiler that
    # rounds them once more may find none.
    x, y, z = entries(beyond)
    farthest = jnp.maximum(jnp.maximum(x, y), z)
    return norm(jnp.maximum(beyond, 0.0)) + jnp.minimum(farthest, 0.0)


def rest_diagonal(
    size: Float[Any, "*batch K 3"], center: Float[Any, "*batch K 3"]
) -> Float[Any, "*batch"]:
    """Diagonal [...] of the axis-aligned box around all parts of an object at rest.

    Args:
      size: [..., K, 3] full extents of the parts' boxes, any unit.
      center: [..., K, 3] their centers, same unit.

    Returns:
      [...], a numpy array where both are, in their own precision.
    """
    numpy = isinstance(size, np.ndarray) and isinstance(center, np.ndarray)
    low = (center - size / 2).min(-2)
    high = (center + size / 2).max(-2)
    return (np if numpy else jnp).linalg.norm(high - low, axis=-1)


def iou_size(size_a: ArrayLike, size_b: ArrayLike) -> Float[Array, "..."]:
    """Intersection over union [...] of two boxes of sizes [..., 3] with common center and axes.

    0 where a size is not finite or not positive.
    """
    size_a = as_floating(size_a, (3,), "size_a")
    size_b = as_floating(size_b, (3,), "size_b")
    good = _is_box(size_a) & _is_box(size_b)
    size_a, size_b = (jnp.where(good[..., None], size, 1.0) for size in (size_a, size_b))
    common = jnp.prod(jnp.minimum(size_a, size_b), axis=-1)
    union = jnp.prod(size_a, axis=-1) + jnp.prod(size_b, axis=-1) - common
    return jnp.where(good, common / union, 0.0)


@jax.jit
def iou_full(
    rotation_a: ArrayLike,
    center_a: ArrayLike,
    size_a: ArrayLike,
    rotation_b: ArrayLike,
    center_b: ArrayLike,
    size_b: ArrayLike,
) -> Float[Array, "..."]:
    """Exact intersection over union [...] of oriented boxes, batched by broadcasting.

    Args:
      rotation_a: [..., 3, 3] box axes (columns) in a common frame.
      center_a: [..., 3] meters, box center in that frame.
      size_a: [..., 3] meters, full extents.
      rotation_b: [..., 3, 3].
      center_b: [..., 3].
      size_b: [..., 3].

    Returns:
      [...] in [0, 1]; 0 where a box has a size that is not positive, or anything is not finite.
      Derivatives are right along rotations, as through ``so3.exp``.
    """
    rotation_a = as_floating(rotation_a, (3, 3), "rotation_a")
    rotation_b = as_floating(rotation_b, (3, 3), "rotation_b")
    center_a, center_b = (
        as_floating(center_a, (3,), "center_a"),
        as_floating(center_b, (3,), "center_b"),
    )
    size_a, size_b = as_floating(size_a, (3,), "size_a"), as_floating(size_b, (3,), "size_b")
    good = _is_box(size_a) & _is_box(size_b)
    for rotation in (rotation_a, rotation_b):
        good &= jnp.all(jnp.isfinite(rotation), axis=(-2, -1))
    for center in (center_a, center_b):
        good &= jnp.all(jnp.isfinite(center), axis=-1)
    # Unit boxes instead of bad ones, before any arithmetic: NaN would reach the derivatives.
    identity = jnp.eye(3, dtype=rotation_a.dtype)
    rotation_a, rotation_b = (
        jnp.where(good[..., None, None], r, identity) for r in (rotation_a, rotation_b)
    )
    center_a, center_b = (jnp.where(good[..., None], c, 0.0) for c in (center_a, center_b))
    size_a, size_b = (jnp.where(good[..., None], size, 1.0) for size in (size_a, size_b))

    # In the frame of box a. I + A^T (B - A) is A^T B, and exactly I for equal boxes.
    back = transpose(rotation_a)
    rotation = identity + multiply(back, rotation_b - rotation_a)
    center = apply(back, center_b - center_a)
    volume_a, volume_b = jnp.prod(size_a, axis=-1), jnp.prod(size_b, axis=-1)
    common = _common_volume(rotation, center, size_a / 2, size_b / 2)
    # Rounding stays within the bounds; the derivative is that of the volume.
    bounded = jnp.clip(common, 0.0, jnp.minimum(volume_a, volume_b))
    common = common + jax.lax.stop_gradient(bounded - common)
    return jnp.where(good, common / (volume_a + volume_b - common), 0.0)


def _is_box(size: jax.Array) -> jax.Array:
    return jnp.all((size > 0) & jnp.isfinite(size), axis=-1)


@jax.custom_jvp
def _common_volume(
    rotation: jax.Array, center: jax.Array, half_a: jax.Array, half_b: jax.Array
) -> jax.Array:
    """Volume [...] of the intersection, in the frame of box a; half extents [..., 3]."""
    areas, _ = _faces(rotation, center, half_a, half_b)
    _, offsets = _half_spaces(rotation, center, half_a, half_b)
    return jnp.sum(offsets * areas, axis=-1) / 3


@_common_volume.defjvp
def _common_volume_jvp(primals, tangents):
    areas, moments = _faces(*primals)
    (_, offsets), (d_normals, d_offsets) = jax.jvp(_half_spaces, primals, tangents)
    change = jnp.sum(areas * d_offsets, axis=-1) - jnp.sum(moments * d_normals, axis=(-2, -1))
    return jnp.sum(offsets * areas, axis=-1) / 3, change


def _half_spaces(
    rotation: jax.Array, center: jax.Array, half_a: jax.Array, half_b: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Outward normals [..., 12, 3] and offsets [..., 12]: ``n . x <= b``."""
    axes, origins, halves = _both(rotation, center, half_a, half_b)
    normals = axes[..., :, :, None, :] * _SIGN.astype(axes.dtype)[:, None]
    offsets = halves[..., None] + dot(normals, origins[..., :, None, None, :])
    batch = axes.shape[:-3]
    return normals.reshape(*batch, 12, 3), offsets.reshape(*batch, 12)


def _both(
    rotation: jax.Array, center: jax.Array, half_a: jax.Array, half_b: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Axes [..., 2, 3 (axis), 3], centers [..., 2, 3] and half extents [..., 2, 3] of the boxes."""
    batch = jnp.broadcast_shapes(
        rotation.shape[:-2], center.shape[:-1], half_a.shape[:-1], half_b.shape[:-1]
    )
    rotation = jnp.broadcast_to(rotation, (*batch, 3, 3))
    center, half_a, half_b = (jnp.broadcast_to(v, (*batch, 3)) for v in (center, half_a, half_b))
    identity = jnp.broadcast_to(jnp.eye(3, dtype=rotation.dtype), rotation.shape)
    return (
        jnp.stack([identity, transpose(rotation)], axis=-3),
        jnp.stack([jnp.zeros_like(center), center], axis=-2),
        jnp.stack([half_a, half_b], axis=-2),
    )


def _faces(
    rotation: jax.Array, center: jax.Array, half_a: jax.Array, half_b: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Area [..., 12] of each face of the intersection, and area times centroid [..., 12, 3]."""
    axes, origins, halves = _both(rotation, center, half_a, half_b)
    normals, offsets = _half_spaces(rotation, center, half_a, half_b)
    # Coordinates in the plane of a face: its center, and the two other axes of its own box.
    batch = normals.shape[:-2]
    tangents = [
        jnp.repeat(jnp.roll(axes, -turn, axis=-2), 2, axis=-2).reshape(*batch, 12, 3)
        for turn in (1, 2)
    ]
    reach = jnp.repeat(halves.reshape(*batch, 6), 2, axis=-1)
    middles = jnp.repeat(origins, 6, axis=-2) + reach[..., None] * normals

    # On plane i, plane k leaves the half-plane  across . y <= room.  [..., i, k, (3)]
    # 1 for planes facing the same way, -1 for the opposite, 0 for those well apart.
    sign = jnp.round(dot(normals[..., None, :, :], normals[..., :, None, :]))
    difference = normals[..., None, :, :] - sign[..., None] * normals[..., :, None, :]
    across = [dot(difference, t[..., :, None, :]) for t in tangents]
    room = offsets[..., None, :] - sign * offsets[..., :, None]
    room = room - dot(difference, middles[..., :, None, :])
    # A parallel plane becomes a line far out, on the side that keeps all or nothing of the face;
    # one that coincides, too. The least steepness is far below any rounding, so a tie shifts
    # nothing else.
    least = float(jnp.finfo(room.dtype).tiny) ** 0.9
    tie = jnp.where((sign > 0) & _FIRST, least * _FAR, -least * _FAR).astype(room.dtype)
    room = jnp.where(room == 0, tie, room)
    steepness = jnp.maximum(jnp.hypot(*across), least)
    pieces, middle_of_edge = _edges(jnp.arctan2(across[1], across[0]), room / steepness)
    areas = jnp.sum(pieces, axis=-1)
    # A triangle from the origin to an edge has its centroid at 2/3 of the way.
    first, second = (
        jnp.sum(pieces * middle_of_edge[..., c], axis=-1)[..., None] * (2 / 3) for c in range(2)
    )
    moments = areas[..., None] * middles + first * tangents[0] + second * tangents[1]
    return areas, moments


def _edges(angle: jax.Array, distance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The polygon that the lines k leave of each face i, as triangles from its origin.

    Args:
      angle: [..., 12, 12] direction of the outward normal of line k in face i, radians.
      distance: [..., 12, 12] of the line from the origin, signed.

    Returns:
      pieces: [..., 12, 12] signed area of the triangle from the origin to edge j.
      middle: [..., 12, 12, 2] middle of edge j; 0 where there is no edge.
    """
    # From the point of line j nearest to the origin, t along it: line k leaves  t sin <= room,
    # room = distance_k - distance_j cos, with sine and cosine of the turn from j to k.
    # Turns are kept as quarters and a rest, which makes right angles exact; no product is rounded
    # before a subtraction, so a compiler that fuses the two changes nothing.
    quarters = jnp.round(angle * (2 / math.pi))
    rest = angle - quarters * (math.pi / 2)
    quarters = quarters[..., None, :] - quarters[..., :, None]
    rest = rest[..., None, :] - rest[..., :, None]
    carry = jnp.round(rest * (2 / math.pi))
    quarters, rest = quarters + carry, rest - carry * (math.pi / 2)
    versine = 2 * jnp.sin(rest / 2) ** 2
    sin, cos = 2 * jnp.sin(rest / 2) * jnp.cos(rest / 2), 1 - versine
    even = jnp.mod(quarters, 2) == 0
    sign = jnp.where(jnp.mod(quarters, 4) < 2, 1.0, -1.0)
    slope = sign * jnp.where(even, sin, cos)
    distance_j, distance_k = sign * distance[..., :, None], distance[..., None, :]
    room = jnp.where(
        even, (distance_k - distance_j) + versine * distance_j, distance_k + sin * distance_j
    )
    at = room / jnp.where(slope == 0, 1.0, slope)
    wins_tie = _FIRST & (sign > 0)
    outside = (slope == 0) & ((room < 0) | ((room == 0) & ~wins_tie))
    others = _CUTS[:, None, :] & (_INDEX[:, None] != _INDEX[None, :])
    upper = jnp.where(outside, -jnp.inf, jnp.where(slope > 0, at, jnp.inf))
    lower = jnp.where(slope < 0, at, -jnp.inf)
    upper = jnp.min(jnp.where(others, upper, jnp.inf), axis=-1)
    lower = jnp.max(jnp.where(others, lower, -jnp.inf), axis=-1)

    present = _CUTS & (upper > lower)
    upper, lower = jnp.where(present, upper, 0.0), jnp.where(present, lower, 0.0)
    pieces = jnp.where(present, distance * (upper - lower) / 2, 0.0)
    across, along = jnp.where(present, distance, 0.0), (upper + lower) / 2
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return pieces, jnp.stack([across * cos - along * sin, across * sin + along * cos], axis=-1)
