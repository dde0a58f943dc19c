"""What a sweep changes about generated frames: one condition each, by known amounts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.types import Batch
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.robustness import FRAMES, with_few

HIDDEN = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
NOISE_M = (0.0, 0.001, 0.002, 0.004, 0.008, 0.016)
DISTANCES = (1.0, 16.0)  # object diagonals
DISTANCE_BINS = 6
POINTS = (48, 64, 100, 200, 400, 1024)
TOO_TIGHT = (0.04, 0.03, 0.02, 0.01)
TOO_WIDE = (0.02, 0.04, 0.06, 0.08)
ROLLS_DEG = (0.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 135.0, 180.0)
# What a file of ``caper generate`` has: hidden points are made up for by others that are seen.
_POINTS_PER_FRAME, _GRID = 4096, 128

# (where on the axis, points [F, M, 3], truth [F, K, ...]) of every amount.
Levels = Iterator[tuple[float, np.ndarray, ArticulatedPose]]
# Draws frames with changes of ``unseen_frames``; the same are drawn once.
Draw = Callable[..., Batch]


@dataclass(frozen=True)
class Sweep:
    """One condition that is changed.

    Attributes:
      title: of the picture.
      axis: what the amounts are, with unit.
      levels: draws the frames of every amount, from few draws where it can.
      fact: one line of the report.
      log: logarithmic axis.
    """

    title: str
    axis: str
    levels: Callable[[Draw, Options], Levels]
    fact: str
    log: bool = False


def hide(
    points: Float[np.ndarray, "B N 3"], share: float, rng: np.random.Generator
) -> Float[np.ndarray, "B M 3"]:
    """The points that an edge in front of the object leaves: those on one side of a line.

    Args:
      points: meters, camera frame.
      share: of the points that are hidden, each frame's beyond a line of another direction.
      rng: draws the directions.
    """
    kept = points.shape[1] - round(share * points.shape[1])
    angle = rng.uniform(0.0, 2 * np.pi, (len(points), 1))
    image = points[..., :2] / points[..., 2:]
    along = image[..., 0] * np.cos(angle) + image[..., 1] * np.sin(angle)
    index = np.sort(np.argpartition(along, kept - 1, axis=1)[:, :kept], axis=1)
    return np.take_along_axis(points, index[..., None], axis=1)


def with_noise(
    points: Float[np.ndarray, "B N 3"], deviation: float, rng: np.random.Generator
) -> Float[np.ndarray, "B N 3"]:
    """Clouds with normal noise of the depth, of this deviation in meters, along their rays."""
    depth = points[..., 2:]
    factor = 1.0 + deviation * rng.normal(size=depth.shape) / depth
    return (points * factor).astype(np.float32)


def rolled(
    points: Float[np.ndarray, "B N 3"], truth: ArticulatedPose, degrees: float
) -> tuple[Float[np.ndarray, "B N 3"], ArticulatedPose]:
    """What a camera sees that is rolled, so that things appear turned clockwise by ``degrees``."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix().astype(np.float32)
    moved = replace(truth, rotation=turn @ truth.rotation, translation=truth.translation @ turn.T)
    return points @ turn.T, moved


def _occlusion(draw: Draw, options: Options) -> Levels:
    batch = draw(num_points=_POINTS_PER_FRAME, grid=_GRID)
    for share in HIDDEN:
        rng = np.random.default_rng(options.seed)
        yield 100 * share, hide(batch.points, share, rng), batch.pose


def _noise(draw: Draw, options: Options) -> Levels:
    batch = draw(noise=("none",))
    for deviation in NOISE_M:
        rng = np.random.default_rng(options.seed)
        yield 1000 * deviation, with_noise(batch.points, deviation, rng), batch.pose


def _distance(draw: Draw, options: Options) -> Levels:
    count = (options.frames or FRAMES) * DISTANCE_BINS
    batch = draw(distance=DISTANCES, frames=count)
    diagonal = rest_diagonal(np.asarray(batch.pose.size), np.asarray(batch.pose.box_center))
    distance = np.linalg.norm(batch.pose.translation[:, 0], axis=-1) / diagonal
    for index in np.array_split(np.argsort(distance, kind="stable"), DISTANCE_BINS):
        truth = jax.tree.map(lambda array, index=index: array[index], batch.pose)
        yield float(np.median(distance[index])), batch.points[index], truth


def _points(draw: Draw, options: Options) -> Levels:
    batch = draw()
    for count in POINTS:
        if count <= batch.points.shape[1]:
            rng = np.random.default_rng(options.seed)
            yield float(count), with_few(batch.points, count, rng), batch.pose


def _mask(draw: Draw, options: Options) -> Levels:
    changes: dict[float, dict[str, Any]] = {
        -share: {"erosion": 1.0, "erosion_range": (share, share)} for share in TOO_TIGHT
    }
    changes[0.0] = {}
    changes |= {share: {"rim": 1.0, "rim_range": (share, share)} for share in TOO_WIDE}
    for share, change in changes.items():
        batch = draw(grid=_GRID, **change)
        yield 100 * share, batch.points, batch.pose


def _roll(draw: Draw, options: Options) -> Levels:
    batch = draw()
    for degrees in ROLLS_DEG:
        yield degrees, *rolled(batch.points, batch.pose, degrees)


SWEEPS = {
    "occlusion": Sweep(
        "occlusion",
        "hidden share of what is visible [%]",
        _occlusion,
        "an edge hides this share of what the camera would see, from any side; clouds are picked "
        "from what is left",
    ),
    "noise": Sweep(
        "sensor noise",
        "standard deviation of the depth [mm]",
        _noise,
        "normal, independent from point to point, on clean depth",
    ),
    "distance": Sweep(
        "distance",
        "distance [object diagonals]",
        _distance,
        "median of each group of frames; noise of the sensor grows with its square",
        log=True,
    ),
    "points": Sweep(
        "number of points",
        "different points",
        _points,
        "so many points that differ, repeated evenly",
        log=True,
    ),
    "mask": Sweep(
        "mask error",
        "mask too wide by [% of the object's width]",
        _mask,
        "below 0 the mask is too tight all around, above 0 it takes in table and wall; in percent "
        "of the object's width in the image",
    ),
    "roll": Sweep(
        "camera roll",
        "clockwise turn of the image [deg]",
        _roll,
        "on top of the roll of generated cameras; the model is not told",
    ),
}
