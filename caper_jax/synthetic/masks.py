"""Sets of pixels on the grid of rays: what hides an object, and what an imperfect mask does to it.

A mask may be too tight, or too wide and take in the table or clutter around the object.

All work on one frame's [G, G] images (vmap over batches) and cost a few passes over them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from caper_jax.articulation.category import Viewpoint
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.ray_casting import FAR

OCCLUDERS = ("edge", "strip", "blob")
_RIM = 0.04  # widest rim, of the grid's side
_HOLES = 4  # most missing blobs per frame
_FARTHEST_TABLE_M = 6.0
_KEPT = 0.3  # an object of which less would stay is left as it is


def is_on(rate: Any) -> bool:
    """Whether a rate may be above 0; of one that is traced, nobody knows."""
    return isinstance(rate, jax.core.Tracer) or bool(rate > 0)


def keep_most(remaining: Bool[Array, "G G"], hit: Bool[Array, "G G"]) -> Bool[Array, "G G"]:
    """``remaining`` [G, G], or ``hit`` where too little of it would be left."""
    return jnp.where(enough(remaining, hit), remaining, hit)


def enough(remaining: Bool[Array, "G G"], whole: Bool[Array, "G G"]) -> Bool[Array, ""]:
    """Whether over 30 % of the pixels [G, G] remain."""
    return remaining.sum() > _KEPT * whole.sum()


def occlude(
    key: PRNGKeyArray, hit: Bool[Array, "G G"], rate: ArrayLike, shapes: tuple[str, ...]
) -> Bool[Array, "G G"]:
    """The hits that something in front of the object leaves.

    Args:
      key: PRNG key.
      hit: [G, G] bool.
      rate: fraction of frames.
      shapes: of ``OCCLUDERS``, one drawn per frame: "edge" hides all beyond a line, "strip" a
        band across the image, "blob" an ellipse.

    Returns:
      [G, G] bool.
    """
    uniform = jax.random.uniform(key, (3,))
    angle, edge = 2 * jnp.pi * uniform[0], 0.1 + 0.8 * uniform[1]
    axis = jnp.linspace(-1.0, 1.0, hit.shape[0])
    along = jnp.cos(angle) * axis[None, :] + jnp.sin(angle) * axis[:, None]
    kept = along < edge
    if shapes != ("edge",):
        pick, size, width, shift = jax.random.uniform(jax.random.fold_in(key, 1), (4,))
        across = jnp.cos(angle) * axis[:, None] - jnp.sin(angle) * axis[None, :]
        masks = {
            "edge": kept,
            "strip": jnp.abs(along - (1.6 * shift - 0.8)) > 0.04 + 0.16 * width,
            "blob": ((along - edge + 0.1) / (0.12 + 0.4 * size)) ** 2
            + ((across - (1.6 * shift - 0.8)) / (0.12 + 0.4 * width)) ** 2
            > 1.0,
        }
        index = jnp.floor(pick * len(shapes)).astype(jnp.int32)
        kept = jnp.stack([masks[shape] for shape in shapes])[index]
    return keep_most(hit & (kept | (uniform[2] >= rate)), hit)


def erode(
    key: PRNGKeyArray,
    hit: Bool[Array, "G G"],
    rate: ArrayLike,
    extent: tuple[float, float] = (0.0, 0.03),
) -> Bool[Array, "G G"]:
    """The hits left by a mask that is too tight.

    Args:
      key: PRNG key.
      hit: [G, G] bool.
      rate: fraction of frames.
      extent: by how much, least and most, of the grid's side; at least by a pixel.
    """
    uniform = jax.random.uniform(key, (2,))
    least, most = (max(1, round(share * hit.shape[0])) for share in extent)
    radius = jnp.floor(uniform[0] * (most - least + 1)) + least
    eroded = ~_grown(~hit, radius, most, beyond=True)
    return jnp.where(uniform[1] < rate, keep_most(eroded, hit), hit)


def rim(key: PRNGKeyArray, hit: Bool[Array, "G G"]) -> Bool[Array, "G G"]:
    """Pixels [G, G] that a mask too wide, by one pixel up to 4 % of the grid's side, adds."""
    most = max(1, round(_RIM * hit.shape[0]))
    radius = jnp.floor(jax.random.uniform(key) * most) + 1.0
    return _grown(hit, radius, most, beyond=False) & ~hit


def silhouette(pixels: Bool[Array, "G G"]) -> Bool[Array, "G G"]:
    """Those of the ``pixels`` [G, G] that border on others."""
    return pixels & _beside(~pixels, beyond=True)


def _beside(pixels, beyond: bool):
    """All that have one of the ``pixels`` beside, above or below; outside lies ``beyond``."""
    padded = jnp.pad(pixels, 1, constant_values=beyond)
    return padded[1:-1, 2:] | padded[1:-1, :-2] | padded[2:, 1:-1] | padded[:-2, 1:-1]


def _grown(pixels, radius, most: int, beyond: bool):
    """``pixels`` and all within ``radius`` (at most ``most``) steps to a side, up or down."""
    for step in range(most):
        pixels |= (step < radius) & _beside(pixels, beyond)
    return pixels


def random_pixel(
    uniform: Float[Any, ""], pixels: Bool[Array, "G G"]
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """(row, column) of one of the ``pixels`` [G, G], drawn with ``uniform`` in [0, 1)."""
    running = jnp.cumsum(pixels.ravel())
    rank = jnp.floor(uniform * running[-1]).astype(running.dtype) + 1
    index = jnp.searchsorted(running, rank, side="left")
    return jnp.divmod(jnp.minimum(index, running.shape[0] - 1), pixels.shape[1])


def nearest_pixels(
    pixels: Bool[Array, "G G"],
    center: tuple[int | Int[Array, ""], int | Int[Array, ""]],
    count: float | Shaped[Array, ""],
) -> Bool[Array, "G G"]:
    """At most ``count`` of the ``pixels`` [G, G]: those around ``center`` (row, column)."""
    rows, columns = (jnp.arange(side) + 0.0 for side in pixels.shape)
    distance = jnp.hypot(rows[:, None] - center[0], columns[None, :] - center[1])
    distance = jnp.where(pixels, distance, jnp.inf)
    low, high = jnp.zeros(()), jnp.asarray(1.5 * max(pixels.shape))
    # Bisection for the radius: a sort of the pixels would cost ten times as much.
    for _ in range(9):
        middle = (low + high) / 2
        fits = (distance < middle).sum() <= count
        low, high = jnp.where(fits, middle, low), jnp.where(fits, high, middle)
    return distance < low


def missing_depth(
    key: PRNGKeyArray, hit: Bool[Array, "G G"], share: ArrayLike, holes: ArrayLike
) -> Bool[Array, "G G"]:
    """Pixels without depth.

    Args:
      key: PRNG key.
      hit: [G, G] bool.
      share: largest fraction of lone pixels that are missing; each frame draws its own.
      holes: fraction of frames in which 1 to 4 elliptic blobs are missing, each 2 to 8 % of the
        grid's side in radius.

    Returns:
      [G, G] bool, True where the depth is missing.
    """
    lone_key, share_key, hole_key = jax.random.split(key, 3)
    missing = jnp.zeros_like(hit)
    if is_on(share):
        # Eight random bits per pixel are enough and cost a quarter of 32.
        bits = jax.random.bits(lone_key, hit.shape, jnp.uint8)
        missing |= bits < share * jax.random.uniform(share_key) * 256.0
    if is_on(holes):
        uniform = jax.random.uniform(hole_key, (_HOLES, 5))
        number = jnp.where(uniform[0, 3] < holes, 1.0 + jnp.floor(uniform[1, 3] * _HOLES), 0.0)
        rows, columns = (jnp.arange(side) + 0.0 for side in hit.shape)
        for index, (place, long, flat, _, turn) in enumerate(uniform):
            row, column = random_pixel(place, hit)
            cos, sin = jnp.cos(jnp.pi * turn), jnp.sin(jnp.pi * turn)
            y, x = rows[:, None] - row, columns[None, :] - column
            radius = (0.02 + 0.06 * long) * hit.shape[0]
            inside = (cos * x + sin * y) ** 2 + ((cos * y - sin * x) / (0.4 + 0.6 * flat)) ** 2
            missing |= (inside < radius**2) & (index < number)
    return missing


def table_depth(
    instance: InstanceBank,
    poses: Float[Any, "K 4 4"],
    view: Viewpoint,
    rays: Sequence[Any],
) -> Float[Array, " ..."]:
    """Depth of the table: the plane through the object's lowest point, across ``view.up``.

    The camera is above the table; where the object lies upside down, it sees its underside.

    Args:
      instance: InstanceBank without its leading axis; the boxes of its parts give the lowest point.
      poses: [K, 4, 4] part rest frame -> camera.
      view: which axis of the root points up.
      rays: (x [...], y [...]); directions (x, y, 1) in the camera frame.

    Returns:
      [...] meters, ``FAR`` for rays that miss it or meet it beyond 6 m.
    """
    x, y = rays
    normal = poses[0, :3, "xyz".index(view.up)]
    if view.either_side:
        normal *= jnp.where((normal * poses[0, :3, 3]).sum() < 0, 1.0, -1.0)
    # Elementwise products: exact in float32 on every backend.
    tilt = (normal[:, None] * poses[:, :3, :3]).sum(1)  # [K, 3] the normal in each part's frame
    height = (normal * poses[:, :3, 3]).sum(-1) + (tilt * instance.box_center).sum(-1)
    lowest = (height - (jnp.abs(tilt) * instance.size).sum(-1) / 2).min()
    slope = normal[0] * x + normal[1] * y + normal[2]
    depth = lowest / jnp.where(slope < -1e-6, slope, -1e-6)
    return jnp.where((depth > 0) & (depth < _FARTHEST_TABLE_M), depth, FAR)


def spill_on_table(
    key: PRNGKeyArray,
    depth: Float[Any, "G G"],
    part: Int[Any, "G G"],
    hit: Bool[Array, "G G"],
    table: Float[Any, "G G"],
    rate: ArrayLike,
    spill: ArrayLike,
) -> tuple[Float[Array, "G G"], Bool[Array, "G G"]]:
    """A mask that is too wide along a stretch of the silhouette and takes in the table there.

    Args:
      key: PRNG key.
      depth: [G, G] meters; part: [G, G] int32, -1 off the object; hit: [G, G] bool, the mask.
      table: [G, G] meters, from ``table_depth``.
      rate: fraction of frames.
      spill: largest number of such pixels, as a fraction of the mask's; each frame draws its own.

    Returns:
      depth and hit with the table's pixels (their part is -1).
    """
    width_key, key = jax.random.split(key)
    chance, share, place = jax.random.uniform(key, (3,))
    around = rim(width_key, hit) & (part < 0) & (table < FAR)
    count = jnp.where(chance < rate, share * spill * hit.sum(), 0)
    added = nearest_pixels(around, random_pixel(place, around), count)
    return jnp.where(added, table, depth), hit | added


def add_clutter(
    key: PRNGKeyArray,
    depth: Float[Any, "G G"],
    part: Int[Any, "G G"],
    hit: Bool[Array, "G G"],
    table: Float[Any, "G G"],
    diagonal: float | Float[Any, ""],
    rays: Sequence[Float[Any, "G G"]],
    rate: ArrayLike,
    spill: ArrayLike,
) -> tuple[Float[Array, "G G"], Int[Array, "G G"], Bool[Array, "G G"]]:
    """A blob of some other surface at the silhouette, in front of the object or behind it.

    The surface is a plane tilted by up to 60 deg, 3 to 30 % of the object's diagonal nearer or
    farther than the silhouette but never below the table. It hides what is behind it.

    Args:
      key: PRNG key.
      depth: [G, G] meters; part: [G, G] int32, -1 off the object; hit: [G, G] bool, the mask.
      table: [G, G] meters, from ``table_depth``.
      diagonal: of the object at rest, meters.
      rays: (x [G, G], y [G, G]).
      rate: fraction of frames.
      spill: largest number of such pixels, as a fraction of the mask's; each frame draws its own.

    Returns:
      depth, part and hit with the clutter's pixels (part -1).
    """
    x, y = rays
    uniform = jax.random.uniform(key, (7,))
    on_object = hit & (part >= 0)
    center = random_pixel(uniform[0], silhouette(on_object))
    in_front = uniform[1] < 0.5
    offset = (0.03 + 0.27 * uniform[4]) * diagonal
    at = depth[center] + jnp.where(in_front, -offset, offset)
    at = jnp.maximum(at, 0.2 * depth[center])
    # The plane z (1 + a (x - x0) + b (y - y0)) = z0 is tilted by atan |(a, b)| to the image.
    turn, slope = 2 * jnp.pi * uniform[5], jnp.sqrt(3.0) * uniform[6]
    tilt = jnp.cos(turn) * (x - x[center]) + jnp.sin(turn) * (y - y[center])
    surface = jnp.minimum(at / jnp.clip(1.0 + slope * tilt, 0.5, 2.0), table)

    shown = (surface < depth) & (in_front | (part < 0))
    count = jnp.where(uniform[2] < rate, uniform[3] * spill * on_object.sum(), 0)
    added = nearest_pixels(shown, center, count)
    return jnp.where(added, surface, depth), jnp.where(added, -1, part), hit | added
