"""A picture by which a person checks how an imported object was understood."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from caper_jax.data.urdf import ImportedObject
from caper_jax.synthetic.urdf_frames import PartCaster
from caper_jax.visualization.plots import save_figure
from caper_jax.visualization.scene import part_color

PIXELS = 360
DPI = 100
AXIS_COLORS = ("#C1272D", "#1B7F3B", "#1F4E9E")  # x, y, z
# Rows: right, up and towards the viewer, in canonical axes.
VIEWS = {
    "front: looking along -z": np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], float),
    "side: looking along -x": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]], float),
    "top: looking along -y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float),
}
OPENED = 0.8  # of the range, in the last view


def write_model_check(path: str | Path, item: ImportedObject) -> Path:
    """Draws an object at rest from three sides, and opened from the front left above.

    Parts are colored as everywhere; arrows x, y, z are the canonical axes at the origin, black
    arrows the joints: a positive state turns right-handed about them, or slides along.

    Args:
      path: PNG to write; its folder is created.
      item: the object.

    Returns:
      The path written.

    Raises:
      CaperError: the packages for meshes are not installed, or the file cannot be written.
    """
    figure = Figure(figsize=(16.6, 5.4), dpi=DPI)
    axes = figure.subplots(1, 4)
    caster = PartCaster(item.at_rest.parts)
    rest = np.zeros(item.at_rest.num_joints)
    for axis, (title, view) in zip(axes, VIEWS.items(), strict=False):
        _draw_view(axis, item, caster, rest, view)
        axis.set_title(f"at rest, {title}", fontsize=10)
    low, high = item.states.T
    _draw_view(axes[3], item, caster, low + OPENED * (high - low), _oblique())
    axes[3].set_title(f"joints at {OPENED:.0%} of their ranges", fontsize=10)
    parts = [
        f"{name}: {' x '.join(f'{extent * 1000:.0f}' for extent in size)} mm"
        for name, size in zip(item.category.parts, item.size, strict=True)
    ]
    handles = [
        axes[0].plot([], [], "s", color=part_color(k), label=label)[0]
        for k, label in enumerate(parts)
    ]
    figure.legend(handles=handles, loc="lower center", ncols=4, fontsize=9, frameon=False)
    figure.suptitle(f"{item.category.name} {item.name}", fontsize=12)
    figure.subplots_adjust(left=0.01, right=0.99, top=0.86, bottom=0.14, wspace=0.03)
    return save_figure(figure, path)


def _oblique() -> np.ndarray:
    """From 35 deg to the object's +x side of its front and 25 deg above."""
    azimuth, elevation = np.radians(35), np.radians(25)
    towards = np.array(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
            np.cos(azimuth) * np.cos(elevation),
        ]
    )
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    return np.stack([right, np.cross(towards, right), towards])


def _draw_view(
    axis: Axes, item: ImportedObject, caster: PartCaster, states: np.ndarray, view: np.ndarray
) -> None:
    """One parallel projection with the axes and the joints over it."""
    poses = item.at_rest.poses(states)
    moved = [
        part.moved(pose).vertices for part, pose in zip(item.at_rest.parts, poses, strict=True)
    ]
    seen = np.concatenate(moved) @ view.T
    middle = (seen.max(0) + seen.min(0)) / 2
    half = 0.58 * np.ptp(seen[:, :2], axis=0).max()
    steps = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
    right, down = np.meshgrid(steps * half + middle[0], -steps * half + middle[1])
    start = seen[:, 2].max() + half
    origins = np.stack([right, down, np.full_like(right, start)], -1).reshape(-1, 3) @ view
    reach, faces = caster.cast(poses, origins, np.tile(-view[2], (len(origins), 1)))
    part = np.where(np.isfinite(reach.min(0)), reach.argmin(0), -1)
    light = view.T @ np.array([-0.35, 0.5, 0.79])
    image = np.ones((len(origins), 3))
    for k, pose in enumerate(poses):
        shown = part == k
        normal = caster.normals(k, faces[k, shown], pose)
        normal *= np.sign(normal @ view[2])[:, None]
        shade = 0.35 + 0.65 * np.clip(normal @ light, 0.0, 1.0)
        image[shown] = np.array(to_rgb(part_color(k))) * shade[:, None]
    extent = (middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half)
    axis.imshow(image.reshape(PIXELS, PIXELS, 3), extent=extent, interpolation="nearest")
    for index, (name, color) in enumerate(zip("xyz", AXIS_COLORS, strict=True)):
        _arrow(axis, np.zeros(3), view[:, index] * 0.45 * half, color, name)
    at_rest = item.at_rest
    for joint, parent in enumerate(at_rest.parents):
        carrier = poses[parent]
        # A slide has no place of its own: drawn through the middle of what it carries.
        slides = at_rest.kinds[joint] == "prismatic"
        place = item.box_center[joint + 1] if slides else at_rest.pivot[joint]
        pivot = carrier[:3, :3] @ place + carrier[:3, 3]
        along = carrier[:3, :3] @ at_rest.axis[joint]
        _arrow(axis, view @ pivot, view @ along * 0.3 * half, "black", str(joint + 1))
    axis.set(xlim=extent[:2], ylim=extent[2:], xticks=[], yticks=[])


def _arrow(axis: Axes, start: np.ndarray, along: np.ndarray, color: str, name: str) -> None:
    """An arrow in the picture; a ring with a dot or cross where it points out of it or into it."""
    end = start + along
    if np.hypot(*along[:2]) < 0.05 * np.linalg.norm(along):
        axis.plot(*start[:2], "o", markersize=9, markerfacecolor="white", color=color)
        axis.plot(*start[:2], "." if along[2] > 0 else "x", markersize=5, color=color)
    else:
        style = {"arrowstyle": "-|>", "color": color, "linewidth": 1.6}
        axis.annotate("", tuple(end[:2]), tuple(start[:2]), arrowprops=style)
    axis.annotate(
        name, tuple(end[:2]), (5, 5), textcoords="offset points", color=color, weight="bold"
    )
