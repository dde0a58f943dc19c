"""``caper estimate``: the pose of one object in your own depth image or point cloud."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli import common
from caper_jax.cli.common import Positive
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category
    from caper_jax.data.clouds import Cloud
    from caper_jax.data.types import Frame
    from caper_jax.estimator import Prediction

NUM_POINTS = 1024
EXAMPLES = (
    ("--category box --depth d.png --mask m.png --intrinsics cam.json", "prints the pose"),
    ("--category box --depth d.png --box 10,20,90,80 --intrinsics cam.json", "likewise"),
    ("--category box --points cloud.ply --json pose.json --picture pose.png", "keeps it"),
)


@dataclass(frozen=True)
class Estimate:
    """Estimates the pose, size and joints of one object.

    The object is given by a depth image with a mask or a 2D box (what stands on the table inside
    it), or as a point cloud.

    Attributes:
      category: e.g. box, or FILE.py:NAME for one of your own
      depth: 16-bit PNG in millimeters, or float .npy [H, W] in meters
      points: cloud of the object alone instead of an image: .npy [N, 3] or .ply, meters
      mask: image of the same size, not black on the object
      box: x1,y1,x2,y2 in pixels around the object, instead of a mask
      intrinsics: camera as JSON: fx, fy, cx, cy, or K, or Open3D pinhole
      depth_scale: meters per unit of the depth image
      json: file to write the pose to
      picture: PNG to draw the pose in
      page: HTML page to turn the object and its joints
      weights: model directory (default: the shipped one of the category)
      object_scale: the objects are so many times as large as those the model was trained on
      camera_roll: degrees by which the image shows things turned clockwise, 180 for upside down
        (models know level cameras, within 15)
      gravity: x,y,z of the way things fall, in the camera's frame (x right, y down, z forward), of
        any length; instead of --camera-roll, and better: what stands is then not read as lying
    """

    category: str
    depth: Path | None = None
    points: Path | None = None
    mask: Path | None = None
    box: str | None = None
    intrinsics: Path | None = None
    depth_scale: Positive | None = None
    json: Path | None = None
    picture: Path | None = None
    page: Path | None = None
    weights: Path | None = None
    object_scale: Positive = 1.0
    camera_roll: float = 0.0
    gravity: str | None = None


def parse(argv: Sequence[str]) -> Estimate:
    options = common.parse(Estimate, argv, EXAMPLES)
    _check_inputs(options)
    _check_outputs(options)
    if options.gravity is not None:
        common.direction(options.gravity, "--gravity")
    return options


def run(options: Estimate) -> int:
    """Runs the command; returns its exit code."""
    import jax
    import numpy as np

    from caper_jax import categories
    from caper_jax.estimator import load
    from caper_jax.evaluation.records import estimate_record
    from caper_jax.files import write_atomically
    from caper_jax.models import hypotheses, plausibility
    from caper_jax.visualization.scene import Scene, format_scene

    category = categories.get(options.category)
    cloud, frame = _observe(options)
    estimator = load(
        category.name, options.weights, options.object_scale, options.camera_roll, hypotheses=None
    )
    gravity = None
    if options.gravity is not None:
        gravity = common.direction(options.gravity, "--gravity")
    prediction = estimator(cloud.points[None], gravity)
    prediction = jax.tree.map(lambda array: np.asarray(array)[0], prediction)
    record = estimate_record(frame.name, prediction, category, cloud)
    doubt = plausibility.implausible_because(prediction, category)
    scene = Scene.of_prediction(frame, category, prediction)

    if doubt:
        print(f"warning: {doubt}", file=sys.stderr)
    print(format_scene(scene))
    print(f"{cloud.available} points, {cloud.dropped} dropped")
    strays = int((prediction.labels < 0).sum())
    if strays:
        print(f"{strays} of {len(prediction.labels)} points looked at lie alone, and were left out")
    for line in hypotheses.in_words(prediction, category):
        print(line)
    print(_certainty(prediction, category), end="")
    if prediction.degenerate:
        print("the rotation is arbitrary: the two directions that give it are parallel")
    if options.json is not None:
        text = json.dumps(record, indent=2, allow_nan=False)
        write_atomically(options.json, text.encode() + b"\n")
    if options.picture is not None:
        from caper_jax.visualization.picture import write_picture

        write_picture(options.picture, [scene])
    if options.page is not None:
        from caper_jax.visualization.page import write_page

        write_page(options.page, [scene])
    return 0


def _check_inputs(options: Estimate) -> None:
    """Which inputs go together.

    Raises:
      CaperError: no object, two of them, or an option of the other one.
    """
    if (options.depth is None) == (options.points is None):
        raise CaperError("give either --depth, an image, or --points, a cloud")
    if options.points is not None:
        for option in ("mask", "box", "intrinsics", "depth_scale"):
            if getattr(options, option) is not None:
                raise CaperError(f"--{option.replace('_', '-')} goes with --depth, not --points")
    elif (options.mask is None) == (options.box is None):
        raise CaperError("--depth needs either --mask or --box to say where the object is")
    elif options.intrinsics is None:
        raise CaperError("--depth needs --intrinsics, the camera as JSON (fx, fy, cx, cy)")
    elif options.box is not None:
        common.pixel_box(options.box)


def _check_outputs(options: Estimate) -> None:
    """Before any work: outputs that would overwrite an input or cannot be written."""
    inputs = [options.depth, options.points, options.mask, options.intrinsics]
    taken = {path.resolve(): path for path in inputs if path is not None}
    for option in ("json", "picture", "page"):
        path = getattr(options, option)
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


def _observe(options: Estimate) -> tuple[Cloud, Frame]:
    """The cloud to estimate from, and what there is to draw."""
    from caper_jax.data.clouds import cloud_from_depth, mask_from_box, read_points, sample_points
    from caper_jax.data.images import read_depth, read_intrinsics, read_mask
    from caper_jax.data.types import Frame

    if options.points is not None:
        points = read_points(options.points)
        cloud = sample_points(points, NUM_POINTS, where=str(options.points))
        return cloud, Frame(options.points.name, cloud.points)
    assert options.depth is not None and options.intrinsics is not None
    depth = read_depth(options.depth, options.depth_scale)
    intrinsics = read_intrinsics(options.intrinsics, (depth.shape[0], depth.shape[1]))
    if options.mask is not None:
        mask = read_mask(options.mask)
    else:
        assert options.box is not None
        mask = mask_from_box(depth, intrinsics, common.pixel_box(options.box))
    cloud = cloud_from_depth(depth, mask, intrinsics, NUM_POINTS)
    name, points = options.depth.name, cloud.points
    return cloud, Frame(name, points, depth=depth, mask=mask, intrinsics=intrinsics)


def _certainty(prediction: Prediction, category: Category) -> str:
    """Lines on how certain the model is, and on parts that are known through their joints alone."""
    import numpy as np

    from caper_jax.models.uncertainty import HIDDEN_POINTS
    from caper_jax.visualization.scene import format_state, joint_name

    axes = zip(category.directions, prediction.confidence, strict=True)
    confidence = ", ".join(f"{axis} {value:.2f}" for axis, value in axes)
    lines = [f"confidence in the root's axes (0 to 1): {confidence}"]
    if prediction.rotation_std is not None:
        for k, name in enumerate(category.parts):
            rotation = np.degrees(prediction.rotation_std[k])
            translation = 1000 * prediction.translation_std[k]
            line = f"{name}: standard deviation {rotation:.1f} deg, {translation:.0f} mm"
            if prediction.size_std is not None:
                size = " x ".join(f"{1000 * extent:.0f}" for extent in prediction.size_std[k])
                line += f", of its size {size} mm"
            lines.append(line)
        for j, kind in enumerate(category.joint_types):
            state = format_state(float(prediction.state_std[j]), kind)
            lines.append(f"{joint_name(category, j)}: standard deviation {state}")
    for name, count in zip(category.parts, prediction.points_per_part, strict=True):
        if count < HIDDEN_POINTS:
            lines.append(f"{name}: hidden ({count} points), known through its joint alone")
    return "".join(f"{line}\n" for line in lines)
