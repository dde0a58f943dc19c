"""A self-contained HTML page to turn scenes and move their joints. Needs no network."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import matplotlib
import numpy as np
from PIL import Image

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import CaperError
from caper_jax.files import write_atomically
from caper_jax.visualization.scene import (
    BOX_EDGES,
    BOX_FACES,
    Scene,
    box_corners,
    crop_box,
    depth_range,
    joint_errors,
    joint_lines,
    joint_name,
    joint_segments,
    part_color,
    part_errors,
    scene_errors,
)


def write_page(path: str | Path, scenes: Sequence[Scene], title: str = "caper_jax") -> Path:
    """Writes a page with a 3D view of every scene and a slider for every joint.

    A slider moves the estimated part, its points and all that it carries about the estimated
    joint. The page holds all its data and loads nothing; it draws with WebGL, or without.

    Args:
      path: HTML file to write; its folder is created.
      scenes: at least one.
      title: heading.

    Returns:
      The path written.

    Raises:
      CaperError: no scene, or a file that cannot be written.
    """
    if not scenes:
        raise CaperError("a page needs at least one scene")
    data = {
        "edges": BOX_EDGES,
        "faces": BOX_FACES,
        "scenes": [_scene_data(scene) for scene in scenes],
    }
    # "<" would let a name end the script element that holds the data.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    viewer = resources.files("caper_jax") / "assets" / "viewer"
    sources = {
        name: (viewer / name).read_text("utf-8")
        for name in ("page.html", "page.css", "model.js", "view.js", "page.js")
    }
    page = Template(sources["page.html"]).substitute(
        title=html.escape(title),
        style=sources["page.css"],
        script=sources["model.js"] + sources["view.js"] + sources["page.js"],
        data=text,
    )
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CaperError(f"cannot write {path}: {error.strerror or error}") from error
    write_atomically(path, page.encode())
    return path


def _scene_data(scene: Scene) -> dict[str, Any]:
    """What the page's script needs of a scene; camera frame, meters, radians."""
    category = scene.category
    kept = np.asarray(scene.labels) >= 0
    labels = np.asarray(scene.labels)[kept]
    order = np.argsort(labels, kind="stable")
    points = np.asarray(scene.points)[kept][order].astype("<f4")
    up = np.asarray(scene.pose.rotation)[0][:, "xyz".index(category.viewpoint.up)]
    errors = scene_errors(scene)
    parts = [
        {
            "name": name,
            "color": part_color(part),
            "errors": {label: part_errors(error, part) for label, error in errors.items()},
        }
        for part, name in enumerate(category.parts)
    ]
    joints = [
        {
            "name": joint_name(category, index),
            "type": joint.type,
            "parent": joint.parent,
            "limits": _slider_limits(scene, index),
            "errors": {
                label: joint_errors(error, index, joint.type) for label, error in errors.items()
            },
        }
        for index, joint in enumerate(category.joints)
    ]
    return {
        "name": scene.name,
        "warning": scene.warning,
        "parts": parts,
        "joints": joints,
        "up": _rounded(up),
        "points": base64.b64encode(points.tobytes()).decode("ascii"),
        "counts": np.bincount(labels, minlength=category.num_parts).tolist(),
        "estimate": _pose_data(scene.pose, category),
        "truth": None if scene.truth is None else _pose_data(scene.truth, category),
        "others": [
            {"probability": round(chance, 3), "corners": _rounded(box_corners(pose))}
            for chance, pose in scene.others
        ],
        "image": None if scene.depth is None else _image_address(scene, scene.depth),
    }


def _pose_data(pose: ArticulatedPose, category: Category) -> dict[str, Any]:
    axis, pivot = joint_lines(pose, category)
    return {
        "corners": _rounded(box_corners(pose)),
        "axis": axis.tolist(),
        "pivot": _rounded(pivot),
        "segments": _rounded(joint_segments(pose, category)),
        "state": _rounded(pose.joint_state),
        "size": _rounded(pose.size),
    }


def _slider_limits(scene: Scene, joint: int) -> list[float]:
    """The category's range, widened to hold the estimate and the truth."""
    states = [float(pose.joint_state[joint]) for _, pose in scene.poses]
    low, high = scene.category.joints[joint].limits
    return _rounded([min(low, *states), max(high, *states)])


def _image_address(scene: Scene, depth: np.ndarray) -> str:
    """The depth image around the object as a PNG in a data address; dimmed beside the mask."""
    low, high = crop_box(scene)
    left, top = np.clip(np.floor(low), 0, None).astype(int)
    right, bottom = np.ceil(high).astype(int)
    window = (slice(top, bottom), slice(left, right))
    depth = np.nan_to_num(depth[window])
    near, far = depth_range(scene)
    shade = np.clip((depth - near) / (far - near), 0, 1)
    colors = matplotlib.colormaps["viridis_r"](shade)[..., :3]
    colors[depth <= 0] = 0.85
    if scene.mask is not None:
        colors[~np.asarray(scene.mask, bool)[window]] *= 0.45
    file = io.BytesIO()
    Image.fromarray(np.uint8(255 * colors)).save(file, "PNG")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")


def _rounded(values: Any) -> list[Any]:
    """Nested lists, to a micrometer or a microradian."""
    return np.round(np.asarray(values, float), 6).tolist()
