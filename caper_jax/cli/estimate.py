"""``caper estimate``: the pose of one object in your own depth image or point cloud."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from caper_jax.cli import common
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category
    from caper_jax.articulation.pose import ArticulatedPose
    from caper_jax.data.clouds import Cloud
    from caper_jax.estimator import Prediction
    from caper_jax.visualization.scene import Scene

FRAME = "camera, OpenCV: x right, y down, z forward; p_camera = rotation p + translation"
NUM_POINTS = 1024


@dataclass(frozen=True)
class _Observation:
    """The cloud to estimate from and, where it came from an image, the image."""

    cloud: Cloud
    depth: np.ndarray | None = None
    mask: np.ndarray | None = None
    intrinsics: np.ndarray | None = None


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "estimate",
        "Estimates the pose, size and joints of one object. The object is given by a depth image\n"
        "with a mask or a 2D box (what stands on the table inside it), or as a point cloud.",
        [
            ("--category box --depth d.png --mask m.png --intrinsics cam.json", "prints the pose"),
            ("--category box --depth d.png --box 10,20,90,80 --intrinsics cam.json", "likewise"),
            ("--category box --points cloud.ply --json pose.json --picture pose.png", "keeps it"),
        ],
    )
    parser.add_argument(
        "--category", required=True, help="e.g. box, or FILE.py:NAME for one of your own"
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--depth", type=Path, help="16-bit PNG in millimeters, or float .npy [H, W] in meters"
    )
    source.add_argument(
        "--points", type=Path, help="cloud of the object alone: .npy [N, 3] or .ply, meters"
    )
    region = parser.add_mutually_exclusive_group()
    region.add_argument("--mask", type=Path, help="image of the same size, not black on the object")
    region.add_argument(
        "--box", type=common.pixel_box, help="x1,y1,x2,y2 in pixels around the object"
    )
    parser.add_argument(
        "--intrinsics", type=Path, help="camera as JSON: fx, fy, cx, cy, or K, or Open3D pinhole"
    )
    parser.add_argument(
        "--depth-scale", type=common.positive_float, help="meters per unit of the depth image"
    )
    parser.add_argument("--json", type=Path, help="file to write the pose to")
    parser.add_argument("--picture", type=Path, help="PNG to draw the pose in")
    parser.add_argument("--page", type=Path, help="HTML page to turn the object and its joints")
    parser.add_argument(
        "--weights", type=Path, help="model directory (default: the shipped one of the category)"
    )
    common.add_model_options(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    import jax

    from caper_jax import categories

    category = categories.get(arguments.category)
    _check_outputs(arguments)
    observation = _observe(arguments)

    from caper_jax.estimator import load
    from caper_jax.visualization.table import format_scene

    estimator = load(category.name, *common.model_options(arguments))
    prediction = estimator(observation.cloud.points[None])
    prediction = jax.tree.map(lambda array: np.asarray(array)[0], prediction)
    pose = prediction.pose
    if not all(np.isfinite(value).all() for value in vars(pose).values()):
        raise CaperError("the model gave no finite pose for this object; check mask and units")

    cloud = observation.cloud
    scene = _scene(arguments, category, observation, prediction)
    print(format_scene(scene))
    print(f"{cloud.available} points, {cloud.dropped} dropped")
    print(_certainty(prediction, category), end="")
    if prediction.degenerate:
        print("the rotation is arbitrary: the two directions that give it are parallel")
    if arguments.json is not None:
        from caper_jax.files import write_atomically

        content = _as_json(prediction, category, cloud)
        text = json.dumps(content, indent=2, allow_nan=False)
        write_atomically(arguments.json, text.encode() + b"\n")
    if arguments.picture is not None:
        from caper_jax.visualization.picture import write_picture

        write_picture(arguments.picture, [scene])
    if arguments.page is not None:
        from caper_jax.visualization.page import write_page

        write_page(arguments.page, [scene])
    return 0


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Before any work: outputs that would overwrite an input or cannot be written."""
    inputs = [arguments.depth, arguments.points, arguments.mask, arguments.intrinsics]
    taken = {path.resolve(): path for path in inputs if path is not None}
    for option in ("json", "picture", "page"):
        path = getattr(arguments, option)
        if path is None:
            continue
        if path.resolve() in taken:
            raise CaperError(f"--{option} {path} would overwrite {taken[path.resolve()]}")
        if path.is_dir():
            raise CaperError(f"--{option} {path}: is a folder, give the name of a file")
        if not path.parent.is_dir():
            raise CaperError(f"--{option} {path}: the folder {path.parent} does not exist")
        if not os.access(path.parent, os.W_OK):
            raise CaperError(f"--{option} {path}: no permission to write in {path.parent}")
        taken[path.resolve()] = path


def _observe(arguments: argparse.Namespace) -> _Observation:
    from caper_jax.data.clouds import cloud_from_depth, read_points, sample_points

    if arguments.points is not None:
        for option in ("mask", "box", "intrinsics", "depth_scale"):
            if getattr(arguments, option) is not None:
                raise CaperError(f"--{option.replace('_', '-')} goes with --depth, not --points")
        points = read_points(arguments.points)
        return _Observation(sample_points(points, NUM_POINTS, where=str(arguments.points)))

    from caper_jax.data.images import read_depth, read_intrinsics, read_mask
    from caper_jax.data.plane import mask_from_box

    if arguments.mask is None and arguments.box is None:
        raise CaperError("--depth needs --mask or --box to say where the object is")
    if arguments.intrinsics is None:
        raise CaperError("--depth needs --intrinsics, the camera as JSON (fx, fy, cx, cy)")
    depth = read_depth(arguments.depth, arguments.depth_scale)
    intrinsics = read_intrinsics(arguments.intrinsics, (depth.shape[0], depth.shape[1]))
    if arguments.mask is not None:
        mask = read_mask(arguments.mask)
    else:
        mask = mask_from_box(depth, intrinsics, arguments.box)
    cloud = cloud_from_depth(depth, mask, intrinsics, NUM_POINTS)
    return _Observation(cloud, depth, mask, intrinsics)


def _state(pose: ArticulatedPose, category: Category, joint: int) -> tuple[float, str]:
    """State of a joint in the unit of files and tables."""
    value = float(pose.joint_state[joint])
    if category.joint_types[joint] == "revolute":
        return float(np.degrees(value)), "degrees"
    return value, "meters"


def _certainty(prediction: Prediction, category: Category) -> str:
    """Lines on how sure the model is, and on parts that are known through their joints alone."""
    from caper_jax.models.uncertainty import HIDDEN_POINTS
    from caper_jax.visualization.scene import format_state, joint_name

    axes = zip(category.directions, prediction.confidence, strict=True)
    found = ", ".join(f"{axis} {value:.2f}" for axis, value in axes)
    lines = [f"confidence in the root's axes (0 to 1): {found}"]
    if prediction.rotation_std is not None:
        for k, name in enumerate(category.parts):
            turn = np.degrees(prediction.rotation_std[k])
            shift = 1000 * prediction.translation_std[k]
            lines.append(f"{name}: standard deviation {turn:.1f} deg, {shift:.0f} mm")
        for j, kind in enumerate(category.joint_types):
            state = format_state(float(prediction.state_std[j]), kind)
            lines.append(f"{joint_name(category, j)}: standard deviation {state}")
    for name, count in zip(category.parts, prediction.points_per_part, strict=True):
        if count < HIDDEN_POINTS:
            lines.append(f"{name}: hidden ({count} points), known through its joint alone")
    return "".join(f"{line}\n" for line in lines)


def _as_json(prediction: Prediction, category: Category, cloud: Cloud) -> dict[str, Any]:
    """The pose under the names of ``ArticulatedPose``; joint states in degrees or meters."""
    from caper_jax.models.uncertainty import HIDDEN_POINTS

    pose = prediction.pose
    states = [_state(pose, category, j) for j in range(category.num_joints)]
    values = {key: np.asarray(value, float).tolist() for key, value in vars(pose).items()}
    values["joint_state"] = [value for value, _ in states]
    content = {
        "category": category.name,
        "parts": list(category.parts),
        "joint_types": list(category.joint_types),
        "frame": FRAME,
        "units": {"length": "meters", "joint_state": [unit for _, unit in states]},
        "pose": values,
        "confidence": prediction.confidence.tolist(),
        "points": {
            "available": cloud.available,
            "dropped": cloud.dropped,
            "of_parts": prediction.points_per_part.tolist(),
        },
        "hidden": [bool(count < HIDDEN_POINTS) for count in prediction.points_per_part],
    }
    if prediction.rotation_std is not None:
        factors = [np.degrees(1.0) if unit == "degrees" else 1.0 for _, unit in states]
        content["standard_deviation"] = {
            "rotation_deg": np.degrees(prediction.rotation_std).tolist(),
            "translation": prediction.translation_std.tolist(),
            "joint_state": (prediction.state_std * factors).tolist(),
        }
    return content


def _scene(
    arguments: argparse.Namespace,
    category: Category,
    observation: _Observation,
    prediction: Prediction,
) -> Scene:
    """The estimate with what it was made from, to print and to draw."""
    from caper_jax.visualization.scene import Scene

    depth = observation.depth
    source: Path = arguments.depth or arguments.points
    return Scene(
        name=source.name,
        category=category,
        points=prediction.points,
        labels=prediction.labels,
        pose=prediction.pose,
        depth=None if depth is None else np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0),
        mask=observation.mask,
        intrinsics=observation.intrinsics,
    )
