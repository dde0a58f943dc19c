"""Sets of pixels on the grid of rays: what hides an object, and what an imperfect mask does to it.

All work on one frame's [G, G] images (vmap over batches) and cost a few passes over them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

OCCLUDERS = ("edge", "strip", "blob")
_EROSION = 0.03  # largest erosion and
_RIM = 0.04  # widest rim, of the grid's side
_HOLES = 4  # most missing blobs per frame
_KEPT = 0.3  # an object of which less would stay is left as it is


def keep_most(remaining, hit):
    """``remaining`` [G, G], or ``hit`` where too little of it would be left."""
    return jnp.where(remaining.sum() > _KEPT * hit.sum(), remaining, hit)


def occlude(key, hit, rate: float, shapes: tuple[str, ...]):
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


def erode(key, hit, rate: float):
    """The hits left by a mask that is too tight, by 1 to 3 % of the grid's side.

    Args:
      key: PRNG key.
      hit: [G, G] bool.
      rate: fraction of frames.
    """
    uniform = jax.random.uniform(key, (2,))
    most = max(1, round(_EROSION * hit.shape[0]))
    radius = jnp.floor(uniform[0] * most) + 1.0
    eroded = ~_grown(~hit, radius, most, beyond=True)
    return jnp.where(uniform[1] < rate, keep_most(eroded, hit), hit)


def rim(key, hit):
    """Pixels [G, G] that a mask too wide, by one pixel up to 4 % of the grid's side, adds."""
    most = max(1, round(_RIM * hit.shape[0]))
    radius = jnp.floor(jax.random.uniform(key) * most) + 1.0
    return _grown(hit, radius, most, beyond=False) & ~hit


def silhouette(pixels):
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


def any_pixel(uniform, pixels):
    """(row, column) of one of the ``pixels`` [G, G], drawn with ``uniform`` in [0, 1)."""
    running = jnp.cumsum(pixels.ravel())
    rank = jnp.floor(uniform * running[-1]).astype(running.dtype) + 1
    index = jnp.searchsorted(running, rank, side="left")
    return jnp.divmod(jnp.minimum(index, running.shape[0] - 1), pixels.shape[1])


def nearest_pixels(pixels, center, count):
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


def drop(key, hit, share: float, holes: float):
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
    if share > 0:
        # Eight random bits per pixel are enough and cost a quarter of 32.
        bits = jax.random.bits(lone_key, hit.shape, jnp.uint8)
        missing |= bits < share * jax.random.uniform(share_key) * 256.0
    if holes > 0:
        uniform = jax.random.uniform(hole_key, (_HOLES, 5))
        number = jnp.where(uniform[0, 3] < holes, 1.0 + jnp.floor(uniform[1, 3] * _HOLES), 0.0)
        rows, columns = (jnp.arange(side) + 0.0 for side in hit.shape)
        for index, (place, long, flat, _, turn) in enumerate(uniform):
            row, column = any_pixel(place, hit)
            cos, sin = jnp.cos(jnp.pi * turn), jnp.sin(jnp.pi * turn)
            y, x = rows[:, None] - row, columns[None, :] - column
            radius = (0.02 + 0.06 * long) * hit.shape[0]
            inside = (cos * x + sin * y) ** 2 + ((cos * y - sin * x) / (0.4 + 0.6 * flat)) ** 2
            missing |= (inside < radius**2) & (index < number)
    return missing
