"""Pictures of a tracked video: a contact sheet of its frames, and curves over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from caper_jax.articulation.category import Category
from caper_jax.errors import CaperError
from caper_jax.evaluation.tracking import Track
from caper_jax.visualization.picture import DPI, INK, PAPER, TRUTH, draw_estimate
from caper_jax.visualization.plots import save_figure
from caper_jax.visualization.scene import Scene, format_state, joint_name, part_color

MAX_TILES = 12
_COLUMNS = 4
_TILE = 2.9  # inches
_STATES_SHOWN = 3  # joint states that a tile has room for
_ENERGY_SHOWN = 6  # times the threshold, in the plot of the energy
LOST, KEY = "#B3261E", "#555555"
_DASHES = (0, (5, 3))


@dataclass(frozen=True)
class Tile:
    """One frame of a contact sheet.

    Attributes:
      number: of the frame in its video.
      scene: what it shows; without points where the object was not seen.
      keyframe, lost: what the tracker said about it.
    """

    number: int
    scene: Scene
    keyframe: bool
    lost: bool


def evenly_spaced(count: int, most: int = MAX_TILES) -> list[int]:
    """At most ``most`` of the numbers 0 to count - 1, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def write_sheet(path: str | Path, title: str, tiles: Sequence[Tile]) -> Path:
    """Draws frames side by side, with the points by part, the boxes and the joint axes.

    Args:
      path: PNG to write.
      title: over the sheet.
      tiles: at least one, all of one category.

    Returns:
      The path written.

    Raises:
      CaperError: no tiles, or a file that cannot be written.
    """
    if not tiles:
        raise CaperError("a contact sheet needs at least one frame")
    columns = min(_COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    width, height = max(columns, 2) * _TILE, rows * (_TILE + 0.45) + 0.7
    figure = Figure(figsize=(width, height), dpi=DPI)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    figure.subplots_adjust(
        left=0.01,
        right=0.99,
        top=1 - 0.75 / height,
        bottom=0.4 / height,
        wspace=0.04,
        hspace=0.45 / _TILE,
    )
    for axis in axes[len(tiles) :]:
        axis.set_axis_off()
    for axis, tile in zip(axes, tiles, strict=False):
        _draw_tile(axis, tile)
    heading = {"fontsize": 12, "fontweight": "bold", "color": INK, "parse_math": False}
    figure.suptitle(title, y=1 - 0.12 / height, va="top", **heading)
    _add_legend(figure, tiles[0].scene, any(tile.scene.truth is not None for tile in tiles))
    return save_figure(figure, path, dpi=DPI, facecolor="white")


def _draw_tile(axes: Axes, tile: Tile) -> None:
    scene = tile.scene
    if len(scene.points):
        draw_estimate(axes, scene)
    else:
        axes.set(xticks=[], yticks=[], facecolor=PAPER, aspect="equal", xlim=(0, 1), ylim=(0, 1))
        axes.text(0.5, 0.5, "object not seen", ha="center", va="center", color=LOST, fontsize=10)
    marks = [word for word, holds in (("keyframe", tile.keyframe), ("lost", tile.lost)) if holds]
    color = LOST if tile.lost else INK
    for spine in axes.spines.values():
        spine.set_color(color if marks else "#bbbbbb")
        spine.set_linewidth(1.6 if marks else 0.8)
    states = [
        format_state(float(state), joint.type)
        for state, joint in zip(scene.pose.joint_state, scene.category.joints, strict=True)
    ]
    shown = ", ".join(states[:_STATES_SHOWN]) + (", …" if len(states) > _STATES_SHOWN else "")
    headline = f"frame {tile.number}" + (f": {', '.join(marks)}" if marks else "")
    axes.set_title(f"{headline}\n{shown}", fontsize=9, color=color, pad=4)


def _add_legend(figure: Figure, scene: Scene, with_truth: bool) -> None:
    handles: list[Patch | Line2D] = [
        Patch(color=part_color(part), label=name) for part, name in enumerate(scene.category.parts)
    ]
    handles.append(Line2D([], [], color="black", marker=">", markevery=[1], label="joint axis"))
    if with_truth:
        handles.append(Line2D([], [], color=TRUTH, linestyle=_DASHES, label="truth"))
    columns = min(len(handles), 2 + round(figure.get_figwidth() / 2))
    figure.legend(handles=handles, loc="lower center", ncols=columns, fontsize=9, frameon=False)


def write_states(
    path: str | Path, track: Track, category: Category, threshold: float | None
) -> Path:
    """Draws the joint states and the energy over the frames of a video.

    The truth, where known, is dashed in the color of its joint; keyframes are vertical lines,
    frames in which the object was lost are shaded.

    Args:
      path: PNG to write.
      track: of one video.
      category: its category.
      threshold: of the energy, where the policy heeds one.

    Returns:
      The path written.

    Raises:
      CaperError: a file that cannot be written.
    """
    kinds = [kind for kind in ("revolute", "prismatic") if kind in category.joint_types]
    ratios = [2.4] * len(kinds) + [1.3]
    figure = Figure(figsize=(9.0, 1.6 * sum(ratios) / 1.3 + 0.6), dpi=DPI)
    axes = figure.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
    for axis, kind in zip(axes, kinds, strict=False):
        _draw_states(axis, track, category, kind)
    _draw_energy(axes[-1], track, threshold)
    for axis in axes:
        _mark_frames(axis, track)
    axes[-1].set_xlabel("frame")
    axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    axes[0].set_title(track.name, fontsize=12, fontweight="bold", color=INK, parse_math=False)
    figure.subplots_adjust(left=0.09, right=0.78, top=0.93, bottom=0.6 / figure.get_figheight())
    return save_figure(figure, path, dpi=DPI, facecolor="white")


def _draw_states(axes: Axes, track: Track, category: Category, kind: str) -> None:
    """States of all joints of one type, in degrees or centimeters."""
    factor = 180 / np.pi if kind == "revolute" else 100.0
    for joint, joint_type in enumerate(category.joint_types):
        if joint_type != kind:
            continue
        color, label = part_color(joint + 1), joint_name(category, joint)
        states = factor * np.asarray(track.pose.joint_state)[:, joint]
        # Dots, so that a video of one frame shows something too.
        axes.plot(states, color=color, linewidth=1.6, marker=".", markersize=4, label=label)
        if track.truth is not None:
            truth = factor * np.asarray(track.truth.joint_state)[:, joint]
            axes.plot(truth, color=color, linewidth=1.2, linestyle=_DASHES)
    axes.set_ylabel("state [deg]" if kind == "revolute" else "state [cm]")
    _finish(axes)


def _draw_energy(axes: Axes, track: Track, threshold: float | None) -> None:
    axes.plot(track.energy, color=INK, linewidth=1.2, marker=".", markersize=4, label="energy")
    if threshold is not None:
        label = f"threshold {threshold:g}"
        axes.axhline(threshold, color=LOST, linewidth=1.0, linestyle=(0, (2, 2)), label=label)
        # A first frame, compared with nothing yet, would hide all that follows.
        axes.set_ylim(top=min(axes.get_ylim()[1], _ENERGY_SHOWN * threshold))
    axes.set_ylabel("energy / diagonal")
    axes.set_ylim(bottom=0)
    # What the marks in all panels mean.
    axes.plot([], [], color=KEY, linewidth=0.9, label="keyframe")
    if track.lost.any():
        axes.fill_between([], [], [], color=LOST, alpha=0.18, linewidth=0, label="lost")
    if track.truth is not None:
        axes.plot([], [], color=INK, linewidth=1.2, linestyle=_DASHES, label="truth")
    _finish(axes)


def _finish(axes: Axes) -> None:
    axes.grid(color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=9, frameon=False)


def _mark_frames(axes: Axes, track: Track) -> None:
    for frame in np.flatnonzero(track.keyframe).tolist():
        axes.axvline(frame, color=KEY, linewidth=0.9, alpha=0.7, zorder=1)
    for frame in np.flatnonzero(track.lost).tolist():
        axes.axvspan(frame - 0.5, frame + 0.5, color=LOST, alpha=0.18, linewidth=0, zorder=0)
    axes.set_xlim(-0.5, len(track.frames) - 0.5)
