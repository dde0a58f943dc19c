"""What else goes wrong in front of a real camera: wide masks, hands, cables, stray and few points.

Functions of one frame (vmap over batches), camera frame, meters. Those of images [G, G] come before
the sensor, those of points [N, 3] after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from caper_jax.articulation.category import Viewpoint
from caper_jax.synthetic import masks
from caper_jax.synthetic.capsules import (
    cable_capsules,
    capsule_depth,
    hand_capsules,
    hand_scale,
)
from caper_jax.synthetic.instances import InstanceBank
from caper_jax.synthetic.ray_casting import FAR

_FARTHEST_WALL_M = 6.0
_FEWEST_POINTS = 48


class Scene(NamedTuple):
    """Images [G, G] of one frame.

    Attributes:
      depth: meters, of the object and what is in front of it; ``FAR`` elsewhere.
      part: int32, -1 off the object.
      hit: bool, the mask.
      behind: meters, of the table and the wall; ``FAR`` where there is neither.
    """

    depth: Float[Array, "G G"]
    part: Int[Array, "G G"]
    hit: Bool[Array, "G G"]
    behind: Float[Array, "G G"]


# ------------------------------------------------------------------------ table, wall and rim


def object_center(instance: InstanceBank, poses: Float[Any, "K 4 4"]) -> Float[Array, " 3"]:
    """Center [3] of the box along the camera's axes around all parts' boxes."""
    middle = (poses[:, :3, :3] * instance.box_center[:, None]).sum(-1) + poses[:, :3, 3]
    half = (jnp.abs(poses[:, :3, :3]) * instance.size[:, None]).sum(-1) / 2
    return ((middle - half).min(0) + (middle + half).max(0)) / 2


def wall_depth(
    uniform: Float[Any, " 2"],
    instance: InstanceBank,
    poses: Float[Any, "K 4 4"],
    view: Viewpoint,
    diagonal: float | Float[Any, ""],
    rays: Sequence[Float[Any, "G G"]],
) -> Float[Array, "G G"]:
    """Depth of a wall across the table, 0.1 to 1.5 diagonals behind the object's farthest point.

    Args:
      uniform: two numbers in [0, 1): the turn out of the viewing direction (up to 30 deg to either
        side), and the distance.
      instance: InstanceBank without its leading axis.
      poses: [K, 4, 4] part rest frame -> camera.
      view: which axis of the root points up.
      diagonal: of the object at rest, meters.
      rays: (x [G, G], y [G, G]); directions (x, y, 1) in the camera frame.

    Returns:
      [G, G] meters, ``FAR`` for rays that miss it or meet it beyond 6 m.
    """
    x, y = rays
    up = poses[0, :3, "xyz".index(view.up)]
    ahead = object_center(instance, poses)
    ahead -= up * (up * ahead).sum()
    ahead /= jnp.maximum(jnp.linalg.norm(ahead), 1e-6)
    turn = jnp.pi / 3 * (uniform[0] - 0.5)
    normal = jnp.cos(turn) * ahead + jnp.sin(turn) * jnp.cross(up, ahead)
    tilt = (normal[:, None] * poses[:, :3, :3]).sum(1)  # [K, 3] the normal in each part's frame
    middle = (normal * poses[:, :3, 3]).sum(-1) + (tilt * instance.box_center).sum(-1)
    farthest = (middle + (jnp.abs(tilt) * instance.size).sum(-1) / 2).max()
    slope = normal[0] * x + normal[1] * y + normal[2]
    distance = farthest + (0.1 + 1.4 * uniform[1]) * diagonal
    depth = distance / jnp.where(slope > 1e-6, slope, 1e-6)
    return jnp.where((depth > 0) & (depth < _FARTHEST_WALL_M), depth, FAR)


def background(
    key: PRNGKeyArray,
    instance: InstanceBank,
    poses: Float[Any, "K 4 4"],
    view: Viewpoint,
    diagonal: float | Float[Any, ""],
    rays: Sequence[Float[Any, "G G"]],
    wall: bool,
) -> Float[Array, "G G"]:
    """Depth [G, G] of the table and, with ``wall``, in half of the frames of a wall behind it."""
    table = masks.table_depth(instance, poses, view, rays)
    if not wall:
        return table
    uniform = jax.random.uniform(key, (3,))
    behind = wall_depth(uniform[1:], instance, poses, view, diagonal, rays)
    return jnp.where(uniform[0] < 0.5, jnp.minimum(table, behind), table)


def widen(
    key: PRNGKeyArray, scene: Scene, rate: ArrayLike, extent: tuple[float, float] = (0.015, 0.08)
) -> Scene:
    """A mask too wide all around, in a fraction of the frames.

    It takes in what is seen there; pixels without any depth stay out.

    Args:
      key: PRNG key.
      scene: of one frame.
      rate: fraction of frames.
      extent: by how much, least and most, of the grid's side.
    """
    side = scene.hit.shape[0]
    chance, width = jax.random.uniform(key, (2,))
    narrowest, widest = extent
    most = max(1, round(widest * side))
    width = narrowest + (widest - narrowest) * width
    radius = jnp.clip(jnp.round(width * side), 1, most)
    wide = scene.hit
    for step in range(most):
        # Steps to the sides and steps to the corners in turn: an octagon, nearly a disc.
        padded = jnp.pad(wide, 1)
        rows = padded[:-2] | padded[2:] | padded[1:-1]
        if step % 2:
            grown = rows[:, 1:-1] | rows[:, 2:] | rows[:, :-2]
        else:
            grown = rows[:, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
        wide = jnp.where(step < radius, grown, wide)
    seen = jnp.minimum(scene.depth, scene.behind)
    added = wide & ~scene.hit & (scene.part < 0) & (seen < FAR) & (chance < rate)
    return scene._replace(depth=jnp.where(added, seen, scene.depth), hit=scene.hit | added)


# --------------------------------------------------------------------------- hands and cables


def add_hand(
    key: PRNGKeyArray,
    scene: Scene,
    center: Float[Any, " 3"],
    diagonal: float | Float[Any, ""],
    rays: Sequence[Float[Any, "G G"]],
    rate: ArrayLike,
) -> Scene:
    """A hand that touches the object, in a fraction of the frames; in half of them in the mask.

    The mask takes in what is nearest to the touch, 10 to 60 % as many pixels as of the object.
    """
    uniform = jax.random.uniform(key, (15,))
    place = masks.random_pixel(uniform[0], scene.hit)
    touch = scene.depth[place] * jnp.stack([rays[0][place], rays[1][place], jnp.ones(())])
    scale = hand_scale(diagonal)
    along = _hand_direction(uniform[4:9], scene, touch, center, scale, rays)
    surface = capsule_depth(hand_capsules(uniform[9:], touch, along, scale), rays)
    share = jnp.where(uniform[1] < 0.5, 0.1 + 0.5 * uniform[2], 0.0)
    return _cover(scene, surface, place, share, uniform[3] < rate)


def _hand_direction(uniform, scene: Scene, touch, center, scale, rays):
    """Unit vector [3] that leads outward in the image, and up from the object and the table.

    Of four drawn directions it is the one from which the hand comes in least steeply.
    """
    outward = touch[:2] / touch[2] - center[:2] / center[2]
    outward = jnp.arctan2(outward[1], outward[0])
    seen = jnp.minimum(scene.depth, scene.behind)
    x, y = rays[0] * seen - touch[0], rays[1] * seen - touch[1]

    def steepness(angle):
        progress = jnp.cos(angle) * x + jnp.sin(angle) * y
        aside = jnp.abs(jnp.cos(angle) * y - jnp.sin(angle) * x)
        below = (progress > 0.03 * scale) & (aside < 0.04 * scale)
        slope = (touch[2] - seen) / jnp.maximum(progress, 1e-6)
        return jnp.where(below, slope, 0.0).max()

    angles = outward + 1.6 * jnp.pi * (uniform[1:] - 0.5)
    slopes = jax.vmap(steepness)(angles)
    best = slopes.argmin()
    slope = jnp.clip(0.3 + slopes[best], 0.1 + 0.9 * uniform[0], 2.0)
    along = jnp.stack([jnp.cos(angles[best]), jnp.sin(angles[best]), -slope])
    return along / jnp.linalg.norm(along)


def add_cable(
    key: PRNGKeyArray,
    scene: Scene,
    diagonal: float | Float[Any, ""],
    rays: Sequence[Float[Any, "G G"]],
    rate: ArrayLike,
) -> Scene:
    """A cable, in a fraction of the frames, 2 to 15 % of the diagonal nearer or farther.

    One time in three each: in front and in the mask, in front and not, behind and in the mask.
    """
    uniform = jax.random.uniform(key, (9,))
    behind = uniform[0] > 2 / 3
    place = masks.random_pixel(
        uniform[1], jnp.where(behind, masks.silhouette(scene.hit), scene.hit)
    )
    depth = scene.depth[place]
    offset = (0.02 + 0.13 * uniform[2]) * diagonal
    depth = jnp.maximum(depth + jnp.where(behind, offset, -offset), 0.2 * depth)
    middle = depth * jnp.stack([rays[0][place], rays[1][place], jnp.ones(())])
    surface = capsule_depth(cable_capsules(uniform[4:], middle, diagonal), rays)
    share = jnp.where(uniform[0] > 1 / 3, 1.0, 0.0)
    return _cover(scene, surface, place, share, uniform[3] < rate)


def _cover(scene: Scene, surface, place, share, there) -> Scene:
    """The scene with another surface, of which ``share`` times the mask's pixels join the mask."""
    shown = there & (surface < jnp.minimum(scene.depth, scene.behind))
    left = scene.hit & ~shown
    shown &= masks.enough(left, scene.part >= 0)
    added = masks.nearest_pixels(shown, place, share * scene.hit.sum())
    return scene._replace(
        depth=jnp.where(shown, surface, scene.depth),
        part=jnp.where(shown, -1, scene.part),
        hit=(scene.hit & ~shown) | added,
    )


# ------------------------------------------------------------------------------------- points


def jump_reach(
    depth: Float[Any, "G G"], behind: Float[Any, "G G"], diagonal: float | Float[Any, ""]
) -> Float[Array, "G G"]:
    """Meters [G, G] from each pixel to the farthest beside it, if over 3 % of the depth, else 0.

    Where nothing is behind it is 0.3 diagonals. For ``depth`` and ``behind`` see ``Scene``.
    """
    depth = jnp.minimum(depth, behind)
    # What is just outside the grid is the table or the wall.
    padded = jnp.pad(behind, 1, mode="edge").at[1:-1, 1:-1].set(depth)
    reach = jnp.zeros_like(depth)
    for other in (padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1]):
        reach = jnp.maximum(reach, jnp.where(other < FAR, other - depth, 0.3 * diagonal))
    return jnp.where(reach > 0.03 * depth, reach, 0.0)


def fly(
    key: PRNGKeyArray,
    points: Float[Any, "N 3"],
    labels: Int[Any, " N"],
    reach: Float[Any, " N"],
    largest: ArrayLike,
) -> tuple[Float[Array, "N 3"], Int[Array, " N"]]:
    """Points and labels of which some with a ``reach`` [N] lie anywhere up to it, in depth."""
    uniform = jax.random.uniform(key, (2 * labels.shape[0] + 1,))
    chosen, step = uniform[:-1].reshape(2, -1)
    chosen = (chosen < uniform[-1] * largest) & (reach > 0)
    factor = 1.0 + jnp.where(chosen, step * reach / points[:, 2], 0.0)
    return points * factor[:, None], jnp.where(chosen, -1, labels)


def add_speckle(
    key: PRNGKeyArray,
    points: Float[Any, "N 3"],
    labels: Int[Any, " N"],
    diagonal: float | Float[Any, ""],
    largest: ArrayLike,
) -> tuple[Float[Array, "N 3"], Int[Array, " N"]]:
    """Points and labels of which some are moved along their rays, Laplace-distributed."""
    count = labels.shape[0]
    uniform = jax.random.uniform(key, (2 * count + 1,), minval=1e-7)
    chosen = uniform[:count] < uniform[-1] * largest
    signed = 2 * uniform[count:-1] - 1
    push = -jnp.sign(signed) * jnp.log1p(-jnp.abs(signed)) * 0.1 * diagonal
    factor = jnp.maximum(1.0 + push / jnp.linalg.norm(points, axis=-1), 0.2)
    moved = points * factor[:, None]
    return jnp.where(chosen[:, None], moved, points), jnp.where(chosen, -1, labels)


def add_specks(
    key: PRNGKeyArray,
    points: Float[Any, "N 3"],
    labels: Int[Any, " N"],
    center: Float[Any, " 3"],
    diagonal: float | Float[Any, ""],
    largest: ArrayLike,
) -> tuple[Float[Array, "N 3"], Int[Array, " N"]]:
    """Points and labels of which some lie in a ball of 0.75 diagonals around ``center``."""
    count = labels.shape[0]
    uniform = jax.random.uniform(key, (4 * count + 1,))
    draws = uniform[:-1].reshape(4, count)
    chosen = draws[0] < uniform[-1] * largest
    height, turn = 2 * draws[1] - 1, 2 * jnp.pi * draws[2]
    level = jnp.sqrt(1 - height**2)
    direction = jnp.stack([level * jnp.cos(turn), level * jnp.sin(turn), height], -1)
    specks = center + 0.75 * diagonal * jnp.cbrt(draws[3])[:, None] * direction
    return jnp.where(chosen[:, None], specks, points), jnp.where(chosen, -1, labels)


def thin_out(
    key: PRNGKeyArray, labels: Int[Any, " N"], parts: int, rate: ArrayLike
) -> Int[Array, " N"]:
    """Indices [N] of the points that stay, in a fraction of the frames fewer and repeated evenly.

    Args:
      key: PRNG key.
      labels: [N] int32, -1 off the object.
      parts: K.
      rate: fraction of frames.
    """
    count = labels.shape[0]
    chance, size, half, pick, share, offset = jax.random.uniform(key, (6,))
    fewest = min(_FEWEST_POINTS, count)
    drawn = fewest * (count / fewest) ** size
    counts = (labels[:, None] == jnp.arange(parts)).sum(0)
    large = counts >= fewest
    part = jnp.searchsorted(jnp.cumsum(large), jnp.floor(pick * large.sum()) + 1)
    share = 0.7 + 0.25 * share
    inside = labels == part
    of_part, others = inside.sum(), (~inside).sum()
    number = jnp.minimum(jnp.minimum(drawn, of_part / share), others / (1 - share))
    weight = number * jnp.where(inside, share / of_part, (1 - share) / others)
    concentrated = (half < 0.5) & (of_part > 0) & (number >= fewest)
    weight = jnp.where(concentrated, weight, drawn / count)
    # Systematic picks: no weight exceeds one step, so that none repeats before all are through.
    running = jnp.cumsum(weight)
    distinct = jnp.maximum(jnp.floor(running[-1] + 1e-3), 1.0)
    rank = jnp.floor((jnp.arange(count) + 0.5) * distinct / count)
    index = jnp.searchsorted(running, (rank + offset) * running[-1] / distinct, side="right")
    return jnp.where(chance < rate, jnp.minimum(index, count - 1), jnp.arange(count))
