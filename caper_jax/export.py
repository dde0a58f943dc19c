"""Serving without this package: a model of ``jax.export``, weights inside, for several platforms.

The files are ``model.jax_export`` (what ``jax.export`` serializes: StableHLO in a flatbuffer),
``manifest.json``, which says shape, unit and frame of every input and output, and ``run.py``, which
needs jax, numpy and flatbuffers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from caper_jax._version import __version__
from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import joints_in_camera
from caper_jax.data.clouds import FARTHEST_M, MIN_POINTS
from caper_jax.errors import CaperError, unknown_name
from caper_jax.estimator import Estimator, Prediction
from caper_jax.files import write_atomically
from caper_jax.models.plausibility import REASONS

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
MODEL_FILE, MANIFEST_FILE, RUNNER_FILE = "model.jax_export", "manifest.json", "run.py"
FORMAT = 3  # of the manifest
ANY_BATCH = "batch"  # stands for the size in shapes that leave it open

_SAMPLING = (
    f"leave out points that are NaN, exactly zero or beyond {FARTHEST_M:g} m, ask for "
    f"{MIN_POINTS} or more different ones of the remaining n, sort them into some 32 rows of the "
    "image, within a row by columns, and take those at floor((i + 0.5) n / num_points), "
    "i = 0 .. num_points - 1; the order of the points taken does not matter"
)
# Frames of the manifest; "" where a quantity has none.
_CAMERA, _PART, _ROOT, _NONE = "camera", "part_rest", "root_rest", ""
_FRAMES = {
    _CAMERA: "OpenCV: x right, y down, z forward",
    _PART: "of each part; in the object's rest pose it is the root's",
    _ROOT: "of the root in the object's rest pose; its origin is the center of the object's box",
}
# Output -> (unit, frame, meaning). K parts and J joints as the manifest lists them, the root first.
_OUTPUTS = {
    "rotation": (
        "1",
        _CAMERA,
        "[B, K, 3, 3] from the part's rest frame: p_camera = rotation p + translation",
    ),
    "translation": ("meters", _CAMERA, "[B, K, 3] see rotation"),
    "size": ("meters", _PART, "[B, K, 3] full extents of the part's box"),
    "box_center": ("meters", _PART, "[B, K, 3] center of that box"),
    "joint_axis": ("1", _ROOT, "[B, J, 3] unit vectors; positive states open"),
    "joint_pivot": ("meters", _ROOT, "[B, J, 3] a point on the axis"),
    "joint_axis_camera": ("1", _CAMERA, "[B, J, 3] unit vectors where the joints are now"),
    "joint_pivot_camera": ("meters", _CAMERA, "[B, J, 3] a point on that axis"),
    "joint_state": ("state", _NONE, "[B, J] from the rest pose"),
    "labels": ("1", _NONE, "[B, num_points] part of each point; -1 for strays, left out"),
    "confidence": (
        "1",
        _NONE,
        "[B, 2] of the two directions that give the root's rotation, in (0, 1)",
    ),
    "degenerate": (
        "1",
        _NONE,
        "[B] whether the rotation is arbitrary, as those directions were parallel",
    ),
    "plausible": (
        "1",
        _NONE,
        "[B] whether this can be an object of the category, whole, alone and in meters; where it "
        "is false, nothing else should be believed",
    ),
    "reason": ("1", _NONE, '[B] why it is not plausible: index into "reasons"'),
    "plausibility": ("1", _NONE, "[B] in (0, 1); below 0.5 lies one in a hundred right objects"),
    "size_ratio": ("1", _NONE, "[B] size of the cloud over that usual in the category"),
    "distinct_points": ("1", _NONE, "[B] how many different points the object has"),
    "points_per_part": ("1", _NONE, "[B, K] how many of the points show each part"),
    "rotation_std": ("radians", _CAMERA, "[B, K] standard deviation about each axis"),
    "translation_std": ("meters", _CAMERA, "[B, K] standard deviation along each axis"),
    "size_std": ("meters", _PART, "[B, K, 3] standard deviation of each extent"),
    "probability": ("1", _NONE, "[B] that all rotations are right within 30 degrees"),
    "state_std": ("state", _NONE, "[B, J] standard deviation"),
}
_CARD = (
    *("version", "commit", "hardware", "steps", "samples", "samples_in_all"),
    *("training_seconds", "training_seconds_in_all"),
)


def flat(prediction: Prediction) -> dict[str, Any]:
    """The outputs of an exported model: the arrays of a prediction by name, those that it has.

    Args:
      prediction: with any leading axes.

    Returns:
      The fields of ``ArticulatedPose`` and of ``Prediction``, but for points and evidence, and the
      joints in the camera frame.
    """
    axis, pivot = joints_in_camera(prediction.pose)
    arrays = {**vars(prediction.pose), **vars(prediction)}
    stated = prediction.hypotheses
    arrays["probability"] = None if stated is None else stated.probability[..., 0]
    arrays |= {"joint_axis_camera": axis, "joint_pivot_camera": pivot}
    return {name: arrays[name] for name in _OUTPUTS if arrays[name] is not None}


def export_estimator(
    estimator: Estimator,
    directory: str | Path,
    platforms: Sequence[str] = ("cpu", "cuda"),
    batch: int | None = 1,
) -> dict[str, Any]:
    """Writes an estimator as ``model.jax_export``, ``manifest.json`` and ``run.py``.

    The model takes points [B, num_points, 3], float32 meters in the camera frame, and gives a dict
    of arrays, see ``flat``. With a fixed batch it gives what ``estimator`` gives for a batch of
    that size; with an open one it differs as a float32 computation in another order does.

    Args:
      estimator: the model.
      directory: created if absent; a model in it is replaced.
      platforms: where the model is to run, of "cpu", "cuda", "rocm" and "tpu"; none of them has
        to be at hand.
      batch: B; None leaves it open, to be compiled for each B that comes.

    Returns:
      The manifest.

    Raises:
      CaperError: an unknown platform, none, or a batch below 1.
    """
    platforms = tuple(dict.fromkeys(platforms))
    for platform in platforms:
        if platform not in PLATFORMS:
            raise unknown_name("platform", platform, PLATFORMS)
    if not platforms:
        raise CaperError(f"no platform to export for; known are {', '.join(PLATFORMS)}")
    if batch is not None and batch < 1:
        raise CaperError(f"batch must be 1 or more, or None to leave it open, got {batch}")

    count = estimator.network.num_points
    shape = export.symbolic_shape(f"{ANY_BATCH if batch is None else batch}, {count}, 3")
    given = jax.ShapeDtypeStruct(shape, jnp.float32)
    exported = export.export(jax.jit(_function(estimator)), platforms=platforms)(given)
    content = _manifest(estimator, exported)

    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    # The manifest goes first and comes last: it never stands beside files of another model.
    (directory / MANIFEST_FILE).unlink(missing_ok=True)
    write_atomically(directory / MODEL_FILE, bytes(exported.serialize()))
    runner = Path(__file__).parent / "assets" / "serving" / RUNNER_FILE
    write_atomically(directory / RUNNER_FILE, runner.read_bytes())
    text = json.dumps(content, indent=2, allow_nan=False)
    write_atomically(directory / MANIFEST_FILE, text.encode() + b"\n")
    return content


def _function(estimator: Estimator) -> Callable[[Any], dict[str, Any]]:
    def run(points):
        # Constants that the compiler sees through it folds into the arithmetic, which rounds
        # otherwise than the estimator's: poses by up to 1e-3 where the choice of a point flips.
        variables = jax.lax.optimization_barrier(estimator.variables)
        return flat(estimator.function(variables, points))

    return run


def _manifest(estimator: Estimator, exported: export.Exported) -> dict[str, Any]:
    category, card = estimator.category, estimator.card
    units = {"state": [_state_unit(joint.type) for joint in category.joints]}
    (points,) = exported.in_avals
    outputs = jax.tree.unflatten(exported.out_tree, exported.out_avals)
    return {
        "format": FORMAT,
        "caper_jax": __version__,
        "jax": jax.__version__,
        "category": category.name,
        "reasons": list(REASONS),
        "parts": _parts(category),
        "joints": _joints(category),
        "model": MODEL_FILE,
        "platforms": list(exported.platforms),
        "frames": _FRAMES,
        "inputs": {
            "points": {
                **_array(points),
                "unit": "meters",
                "frame": _CAMERA,
                "camera_roll_deg": category.viewpoint.camera_roll,  # see ``Category.rolled``
                "sampling": _SAMPLING,
            }
        },
        "outputs": {
            name: {
                **_array(outputs[name]),
                "unit": units.get(unit, unit),
                "frame": frame,
                "meaning": meaning,
            }
            for name, (unit, frame, meaning) in _OUTPUTS.items()
            if name in outputs
        },
        "card": {name: card[name] for name in _CARD if name in card},
    }


def _array(aval: Any) -> dict[str, Any]:
    shape = [size if isinstance(size, int) else str(size) for size in aval.shape]
    return {"shape": shape, "dtype": np.dtype(aval.dtype).name}


def _state_unit(joint_type: str) -> str:
    return "radians" if joint_type == "revolute" else "meters"


def _parts(category: Category) -> list[dict[str, Any]]:
    return [
        {"name": name, "mean_size": [float(x) for x in size]}
        for name, size in zip(category.parts, category.mean_size, strict=True)
    ]


def _joints(category: Category) -> list[dict[str, Any]]:
    return [
        {
            "type": joint.type,
            "parent": category.parts[joint.parent],
            "child": child,
            "limits": [float(x) for x in joint.limits],
            "unit": _state_unit(joint.type),
        }
        for child, joint in zip(category.parts[1:], category.joints, strict=True)
    ]
