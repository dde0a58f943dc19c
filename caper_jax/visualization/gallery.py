"""Shaded pictures of generated instances: what a category's shapes look like to a person."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import to_rgb

from caper_jax.articulation.category import Category
from caper_jax.synthetic.frames import draw_state_and_poses
from caper_jax.synthetic.instances import build_bank, draw_instances
from caper_jax.synthetic.ray_casting import cast, projected_bounds
from caper_jax.visualization.plots import save_figure
from caper_jax.visualization.scene import part_color

TILE = 180  # pixels per side
_SAMPLES = 2  # rays per pixel and side
_MARGIN = 1.12
_LIGHT = np.array([-0.35, -0.75, -0.6])  # from the camera's upper left
_DPI = 100


def write_gallery(
    path: str | Path,
    categories: Sequence[Category],
    count: int = 8,
    split: str = "train",
    seed: int = 0,
) -> Path:
    """Writes a PNG with one row per category.

    Args:
      path: the file.
      categories: the rows.
      count: instances per row, each in a random state before a random camera of the category.
      split, seed: as for ``draw_instances``.

    Raises:
      CaperError: a category without procedural shapes.
    """
    from matplotlib.figure import Figure

    rows = [render_instances(category, count, split, seed) for category in categories]
    label = 24  # pixels for a row's name
    width, height = count * TILE, len(rows) * (TILE + label)
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
    for number, (category, images) in enumerate(zip(categories, rows, strict=True)):
        top = 1 - (number * (TILE + label) + label) / height
        axes = figure.add_axes((0, top - TILE / height, 1, TILE / height))
        axes.imshow(np.concatenate(list(images), axis=1), aspect="auto", interpolation="nearest")
        axes.set_axis_off()
        title = f"{category.name} ({', '.join(_parts(category))})"
        figure.text(8 / width, top + 4 / height, title, fontsize=10, va="bottom")
    return save_figure(figure, path, dpi=_DPI)


def _parts(category: Category) -> list[str]:
    """Names of the parts, as many as a title has room for."""
    names = list(category.parts)
    return names if len(names) <= 4 else [names[0], "...", names[-1]]


def render_instances(category: Category, count: int, split: str, seed: int) -> np.ndarray:
    """Shaded images [count, TILE, TILE, 3] in [0, 1] of different instances, parts colored."""
    bank = build_bank(draw_instances(category, count, split, seed))
    # The name enters the key: other cameras for other categories.
    key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(category.name.encode()))
    keys = jax.random.split(key, count)
    render = jax.jit(partial(_render, category=category))
    images = []
    for index in range(count):
        instance = jax.tree.map(lambda values, i=index: jnp.asarray(values[i]), bank)
        images.append(_shade(*map(np.asarray, render(keys[index], instance))))
    return np.stack(images)


def _render(key, instance, category: Category):
    """depth, part, ray x and ray y, [n, n] each, of rays through a square around the object."""
    _, poses, _ = draw_state_and_poses(key, instance, category)
    low, high = projected_bounds(instance.groups, poses)
    side = _MARGIN * (high - low).max()
    count = TILE * _SAMPLES
    steps = ((jnp.arange(count) + 0.5) / count - 0.5) * side
    middle = (low + high) / 2
    x, y = jnp.meshgrid(middle[0] + steps, middle[1] + steps)
    depth, part = cast(instance.groups, poses, (x.ravel(), y.ravel()))
    return depth.reshape(x.shape), part.reshape(x.shape), x, y


def _shade(depth: np.ndarray, part: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[TILE, TILE, 3] of an image of rays, averaged over the rays of a pixel."""
    points = np.stack([x * depth, y * depth, depth], axis=-1)
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    normal *= -np.sign((normal * points).sum(-1, keepdims=True))  # towards the camera
    light = _LIGHT / np.linalg.norm(_LIGHT)
    brightness = 0.55 + 0.5 * np.clip(normal @ light, 0, 1)
    palette = np.array([to_rgb(part_color(k)) for k in range(part.max() + 1)] + [(1.0, 1.0, 1.0)])
    image = palette[part] * np.where(part >= 0, brightness, 1.0)[..., None]
    image = np.clip(image, 0, 1).reshape(TILE, _SAMPLES, TILE, _SAMPLES, 3)
    return image.mean((1, 3))
