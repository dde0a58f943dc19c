"""What stands around an object, and how much of it an imperfect mask takes for the object."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from caper_jax.articulation.category import Viewpoint
from caper_jax.synthetic import masks
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.ray_casting import FAR

_FARTHEST_TABLE_M = 6.0


def table_depth(instance: InstanceBank, poses, view: Viewpoint, rays):
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


def spill_on_table(key, depth, part, hit, table, rate: float, spill: float):
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
    around = masks.rim(width_key, hit) & (part < 0) & (table < FAR)
    count = jnp.where(chance < rate, share * spill * hit.sum(), 0)
    added = masks.nearest_pixels(around, masks.any_pixel(place, around), count)
    return jnp.where(added, table, depth), hit | added


def add_clutter(key, depth, part, hit, table, diagonal, rays, rate: float, spill: float):
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
    center = masks.any_pixel(uniform[0], masks.silhouette(on_object))
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
    added = masks.nearest_pixels(shown, center, count)
    return jnp.where(added, surface, depth), jnp.where(added, -1, part), hit | added
