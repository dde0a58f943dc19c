"""``caper benchmark tracker``: one step of the tracker against one single-frame estimate."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from caper_jax.cli import common

_VIDEOS = 2  # that the frames come from


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", action="append", help="may be repeated (default: laptop)")
    parser.add_argument("--weights", type=Path, help="model directory (default: the package's)")
    parser.add_argument(
        "--repeats",
        type=common.positive_int,
        default=10,
        help="passes over the frames (default: %(default)s)",
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Both on the same frames in turn, batch 1, from points [1024, 3] to poses on the host."""
    for name in arguments.category or ["laptop"]:
        yield _measure(name, arguments.weights, arguments.repeats)


def _measure(name: str, weights: Path | None, repeats: int) -> dict[str, Any]:
    import jax
    import numpy as np

    from caper_jax.data.synthetic.config import GeneratorConfig
    from caper_jax.data.synthetic.videos import FRAMES, VideoGenerator
    from caper_jax.estimator import load
    from caper_jax.tracker import Tracker, config_for

    estimator = load(name, weights)
    tracker = Tracker(estimator, config_for(estimator))
    config = GeneratorConfig(instances=_VIDEOS, noise=("kinect",))
    videos = VideoGenerator(estimator.category, config, split="test")
    batch = jax.tree.map(np.asarray, videos.batch(jax.random.key(0), _VIDEOS))

    def timed(function: Callable[[Any], Any], points: Any) -> tuple[float, Any]:
        began = time.perf_counter()
        result = jax.block_until_ready(function(points))
        return time.perf_counter() - began, result

    def begin(video: int) -> None:
        pose = batch.pose
        tracker.reset(batch.points[video, 0], pose.rotation[video, 0], pose.translation[video, 0])

    began = time.perf_counter()
    begin(0)
    timed(tracker, batch.points[0, 1])
    compiling = time.perf_counter() - began
    timed(estimator, batch.points[0, 1])
    steps: list[float] = []
    keyframes: list[float] = []
    estimates: list[float] = []
    for _ in range(repeats):
        for video in range(_VIDEOS):
            begin(video)
            for frame in range(1, FRAMES):
                points = batch.points[video, frame]
                seconds, result = timed(tracker, points)
                (keyframes if result.estimated else steps).append(seconds)
                estimates.append(timed(estimator, points)[0])
    step, estimate = statistics.median(steps + keyframes), statistics.median(estimates)
    return {
        "category": estimator.category.name,
        "frames_per_s": round(1 / step, 1),
        "step_ms": round(1000 * step, 2),
        "keyframe_ms": round(1000 * statistics.median(keyframes), 2) if keyframes else "-",
        "keyframes": f"{100 * len(keyframes) / len(steps + keyframes):.0f} %",
        "estimate_ms": round(1000 * estimate, 2),
        "step/estimate": round(step / estimate, 2),
        "compile_s": round(compiling, 1),
    }
