"""One PNG that shows at a glance what was estimated: a row per scene. Needs no display."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.patheffects as effects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError
from caper_jax.visualization.plots import save_figure
from caper_jax.visualization.scene import (
    BOX_EDGES,
    NEAREST,
    Scene,
    box_corners,
    crop_box,
    depth_range,
    format_state,
    hidden_edges,
    joint_name,
    joint_segments,
    part_color,
    project,
)

TITLES = ("Depth image and mask", "Estimate over the depth image", "Seen from another side")
CLOUD_TITLES = ("Points by distance", "Estimate over the points", TITLES[2])
DPI = 110
ROW_HEIGHT = 3.9  # inches
WIDTHS = (3.4, 3.4, 3.4, 4.3)  # inches: three views and the legend
STRAY, WARNING = "#9a9a9a", "#B3261E"
GHOST = 0.45  # opacity of other readings
INK, PAPER, TRUTH = "#1a1a1a", "#f4f4f2", "#333333"

Projection = Callable[[np.ndarray], np.ndarray]


def write_picture(path: str | Path, scenes: Sequence[Scene]) -> Path:
    """Draws a row per scene: depth image, estimate over it, another side, sizes and states.

    Boxes and points carry the color of their part; edges behind the box are thin and dotted, the
    truth thin and dashed, joint axes black arrows about which a positive state turns.

    Args:
      path: PNG to write; its folder is created.
      scenes: at least one.

    Returns:
      The path written.

    Raises:
      CaperError: no scene, or a file that cannot be written.
    """
    if not scenes:
        raise CaperError("a picture needs at least one scene")
    figure = Figure(figsize=(sum(WIDTHS) + 0.9, ROW_HEIGHT * len(scenes) + 0.35), dpi=DPI)
    top = 1 - 0.45 / figure.get_figheight()
    bottom = 0.35 / figure.get_figheight()
    grid = figure.add_gridspec(
        len(scenes), 4, width_ratios=WIDTHS, left=0.015, right=0.985, top=top, bottom=bottom
    )
    grid.update(wspace=0.05, hspace=0.16)
    for row, scene in enumerate(scenes):
        axes = [figure.add_subplot(grid[row, column]) for column in range(4)]
        _draw_input(axes[0], scene)
        draw_estimate(axes[1], scene)
        _draw_side(axes[2], scene)
        _draw_legend(axes[3], scene)
        if row == 0:
            titles = CLOUD_TITLES if all(s.depth is None for s in scenes) else TITLES
            for axis, title in zip(axes, titles, strict=False):
                axis.set_title(title, fontsize=12, color=INK, pad=8)
    return save_figure(figure, path, dpi=DPI, facecolor="white")


def _draw_input(axes: Axes, scene: Scene) -> None:
    """The depth image around the object; without an image, the points by distance."""
    _frame(axes)
    near, far = depth_range(scene)
    colors = matplotlib.colormaps["viridis_r"].with_extremes(bad="#d9d9d9")
    if scene.depth is None:
        pixels = project(scene.points, _intrinsics(scene))
        shown: ScalarMappable = axes.scatter(
            pixels[:, 0],
            pixels[:, 1],
            c=scene.points[:, 2],
            s=4,
            cmap=colors,
            vmin=near,
            vmax=far,
            linewidths=0,
        )
        axes.set_facecolor(PAPER)
    else:
        image = np.where(np.nan_to_num(scene.depth) > 0, scene.depth, np.nan)
        shown = axes.imshow(image, cmap=colors, vmin=near, vmax=far, interpolation="nearest")
        if scene.mask is not None and scene.mask.any() and not scene.mask.all():
            for width, color in ((2.6, "black"), (1.2, "white")):
                axes.contour(scene.mask.astype(float), [0.5], colors=color, linewidths=width)
    _limit(axes, *crop_box(scene))
    bar = axes.inset_axes((0.0, -0.055, 1.0, 0.03))
    axes.figure.colorbar(shown, cax=bar, orientation="horizontal", extend="both")
    bar.xaxis.set_major_locator(MaxNLocator(4))
    bar.xaxis.set_major_formatter("{x:g} m")
    bar.tick_params(labelsize=8, length=2, pad=1)


def draw_estimate(axes: Axes, scene: Scene) -> None:
    """The estimate of a scene with points, projected into its image."""
    _frame(axes)
    axes.set_facecolor(PAPER)
    if scene.depth is not None:
        near, far = depth_range(scene)
        image = np.where(np.nan_to_num(scene.depth) > 0, scene.depth, np.nan)
        axes.imshow(image, cmap="gray_r", vmin=near, vmax=far, alpha=0.35, interpolation="nearest")
    intrinsics = _intrinsics(scene)

    def flat(points: np.ndarray) -> np.ndarray:
        # What lies behind the camera is left out by giving it no place.
        seen = np.where(points[..., 2:] > NEAREST, points, np.nan)
        return project(seen, intrinsics)

    _draw_objects(axes, scene, flat, eye=np.zeros(3), far_first=np.argsort(-scene.points[:, 2]))
    _limit(axes, *crop_box(scene))


def _draw_side(axes: Axes, scene: Scene) -> None:
    """An orthographic view from another azimuth about the object's up axis."""
    _frame(axes)
    axes.set_facecolor(PAPER)
    right, down, forward = _side_view(scene)
    plane = np.stack([right, down], axis=-1)
    middle = box_corners(scene.pose).reshape(-1, 3).mean(0)

    def flat(points: np.ndarray) -> np.ndarray:
        return (points - middle) @ plane

    far_first = np.argsort(-(scene.points @ forward))
    _draw_objects(axes, scene, flat, eye=middle - 1e3 * forward, far_first=far_first)
    drawn = (box_corners(scene.pose), joint_segments(scene.pose, scene.category))
    shown = [flat(scene.object_points), *(flat(points).reshape(-1, 2) for points in drawn)]
    extent = np.concatenate(shown)
    center, half = (extent.min(0) + extent.max(0)) / 2, 0.57 * np.ptp(extent, axis=0).max()
    _limit(axes, center - half, center + half)
    _draw_scale(axes)


def _draw_objects(
    axes: Axes, scene: Scene, flat: Projection, eye: np.ndarray, far_first: np.ndarray
) -> None:
    """Points, boxes and joint axes through one projection."""
    # Strays, with label -1, take the last color.
    colors = np.array([*map(part_color, range(scene.category.num_parts)), STRAY])
    points = flat(scene.points)[far_first]
    x, y = points.T
    axes.scatter(x, y, c=colors[scene.labels[far_first]], s=5, linewidths=0, alpha=0.75)
    halo = [effects.withStroke(linewidth=3.4, foreground="white", alpha=0.8)]
    if scene.truth is not None:
        for corners in box_corners(scene.truth):
            for a, b in BOX_EDGES:
                line = flat(corners[[a, b]])
                axes.plot(*line.T, color=TRUTH, linewidth=0.9, linestyle=(0, (5, 3)), zorder=3)
    for _, other in scene.others:
        for part, corners in enumerate(box_corners(other)):
            for a, b in BOX_EDGES:
                line = flat(corners[[a, b]])
                axes.plot(*line.T, color=colors[part], linewidth=1.2, alpha=GHOST, zorder=3)
    for part, corners in enumerate(box_corners(scene.pose)):
        for (a, b), hidden in zip(BOX_EDGES, hidden_edges(corners, eye), strict=True):
            style: dict[str, Any] = (
                {"linewidth": 1.0, "linestyle": (0, (1, 2)), "zorder": 4}
                if hidden
                else {"linewidth": 2.0, "path_effects": halo, "zorder": 5}
            )
            axes.plot(*flat(corners[[a, b]]).T, color=colors[part], **style)
    for pose, dashed in ((scene.truth, True), (scene.pose, False)):
        if pose is not None:
            _draw_joints(axes, scene, pose, flat, dashed)


def _draw_joints(
    axes: Axes, scene: Scene, pose: ArticulatedPose, flat: Projection, dashed: bool
) -> None:
    for segment in joint_segments(pose, scene.category):
        start, end = flat(segment)
        if not np.isfinite([start, end]).all():
            continue
        if dashed:
            axes.plot(*np.stack([start, end]).T, color=TRUTH, linewidth=1, linestyle=(0, (5, 3)))
            continue
        arrow: dict[str, Any] = {
            "arrowstyle": "-|>,head_length=0.6,head_width=0.25",
            "color": "black",
            "linewidth": 1.8,
            "shrinkA": 0,
            "shrinkB": 0,
            "path_effects": [effects.withStroke(linewidth=3.6, foreground="white")],
        }
        axes.annotate("", xy=end, xytext=start, arrowprops=arrow, zorder=6)


def _draw_legend(axes: Axes, scene: Scene) -> None:
    """Names, sizes and states as text beside the colors and line styles they belong to."""
    axes.set_axis_off()
    axes.set_xlim(0, 1)
    category, pose, truth = scene.category, scene.pose, scene.truth
    rows: list[tuple[str, str, str]] = []  # (kind, color or nothing, text)
    for part, name in enumerate(category.parts):
        size = " × ".join(f"{100 * extent:.1f}" for extent in np.asarray(pose.size)[part])
        rows.append(("part", part_color(part), f"{name}   {size} cm"))
    for index, joint in enumerate(category.joints):
        state = format_state(float(pose.joint_state[index]), joint.type)
        known = ""
        if truth is not None:
            known = f"   (truth {format_state(float(truth.joint_state[index]), joint.type)})"
        rows.append(("joint", "black", f"{joint_name(category, index)}   {state}{known}"))
    if truth is not None:
        rows.append(("truth", TRUTH, "ground truth"))
    for chance, _ in scene.others:
        rows.append(("other", part_color(0), f"may also be this ({100 * chance:.0f} %)"))
    if (np.asarray(scene.labels) < 0).any():
        rows.append(("part", STRAY, "stray points, left out"))
    pitch = min(0.095, 0.9 / (len(rows) + 1))
    axes.set_ylim(1, 0)
    axes.text(0.05, 0.045, scene.name, fontsize=13, fontweight="bold", color=INK, va="center")
    if scene.warning:
        text = "\n".join(textwrap.wrap(f"Do not believe this: {scene.warning}", 46))
        style: dict[str, Any] = {
            "fontsize": 11,
            "fontweight": "bold",
            "color": WARNING,
            "parse_math": False,
        }
        axes.text(0.05, 0.99, text, va="bottom", **style)
    for index, (kind, color, text) in enumerate(rows):
        y = 0.05 + pitch * (index + 1.1)
        if kind == "part":
            axes.scatter([0.09], [y], s=90, c=color, marker="s", linewidths=0)
        elif kind == "joint":
            arrow = {"arrowstyle": "-|>", "color": color, "linewidth": 1.8}
            axes.annotate("", xy=(0.135, y), xytext=(0.045, y), arrowprops=arrow)
        elif kind == "other":
            axes.plot([0.045, 0.135], [y, y], color=color, linewidth=1.2, alpha=GHOST)
        else:
            axes.plot([0.045, 0.135], [y, y], color=color, linewidth=1, linestyle=(0, (5, 3)))
        axes.text(0.17, y, text, fontsize=11, color=INK, va="center", parse_math=False)


def _draw_scale(axes: Axes) -> None:
    """A bar of a round length, in the lower left corner of a view in meters."""
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    span = right - left
    lengths = [digit * 10.0**power for power in range(-3, 3) for digit in (1, 2, 5)]
    length = max((value for value in lengths if value < 0.3 * span), default=lengths[0])
    x, y = left + 0.05 * span, low + 0.05 * (high - low)
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    text = f"{100 * length:g} cm" if length < 1 else f"{length:g} m"
    axes.text(x, y + 0.02 * (high - low), text, fontsize=9, color=INK)


def _side_view(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit right, down and forward vectors of a viewer 25 degrees above the object.

    Of several directions around it, at least 50 degrees from the camera's, the one in which no
    part is seen edge-on.
    """
    root = np.asarray(scene.pose.rotation, float)[0]
    up = root[:, "xyz".index(scene.category.viewpoint.up)]
    corners = box_corners(scene.pose)
    toward = corners.reshape(-1, 3).mean(0)
    level = toward - np.dot(toward, up) * up
    if np.linalg.norm(level) < 0.1 * np.linalg.norm(toward):  # seen from straight above
        level = root[:, 0] - np.dot(root[:, 0], up) * up
    level /= max(np.linalg.norm(level), 1e-9)
    elevation = np.radians(25)

    def forward(azimuth: float) -> np.ndarray:
        horizontal = np.cos(azimuth) * level + np.sin(azimuth) * np.cross(up, level)
        return np.cos(elevation) * horizontal - np.sin(elevation) * up

    # A box shows each pair of faces by their area times the cosine of the viewing angle.
    edges = corners[:, [4, 2, 1]] - corners[:, :1]
    areas = np.cross(edges[:, [0, 1, 2]], edges[:, [1, 2, 0]])
    most = np.maximum(np.linalg.norm(areas, axis=-1).max(-1), 1e-12)

    def clearest(azimuth: float) -> float:
        return float((np.abs(areas @ forward(azimuth)).sum(-1) / most).min())

    chosen = forward(max(np.radians([65, -65, 50, -50, 95, -95]), key=clearest))
    right = np.cross(chosen, up)
    right /= np.linalg.norm(right)
    return right, np.cross(chosen, right), chosen


def _intrinsics(scene: Scene) -> np.ndarray:
    return np.eye(3) if scene.intrinsics is None else np.asarray(scene.intrinsics, float)


def _limit(axes: Axes, low: np.ndarray, high: np.ndarray) -> None:
    """Shows the square from ``low`` to ``high``, y downwards."""
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(high[1], low[1])
    axes.set_aspect("equal")


def _frame(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#bbbbbb")
