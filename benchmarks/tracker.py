"""``caper benchmark tracker``: one step of the tracker against one estimate, or of many at once."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks import costs, timing
from caper_jax import machine
from caper_jax.cli import common

_VIDEOS = 2  # that the frames come from, one video at a time
_DISTINCT = 4  # of many at once; the rest repeats them


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", action="append", help="may be repeated (default: laptop)")
    parser.add_argument("--weights", type=Path, help="model directory (default: the package's)")
    parser.add_argument(
        "--videos",
        type=common.positive_int,
        default=1,
        help="tracked at once, by one program on the device (default: %(default)s)",
    )
    parser.add_argument(
        "--repeats",
        type=common.positive_int,
        default=10,
        help="passes over the frames (default: %(default)s)",
    )


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One video: both on the same frames in turn, from points [1024, 3] to poses on the host.

    Many: the step alone, vmapped, from points on the device to poses there. No video may ask the
    estimator alone then: all are estimated in every frame, and the answer kept where it is due.
    """
    for name in arguments.category or ["laptop"]:
        if arguments.videos == 1:
            yield _measure(name, arguments.weights, arguments.repeats)
        else:
            yield _measure_many(name, arguments.weights, arguments.videos, arguments.repeats)


def _measure(name: str, weights: Path | None, repeats: int) -> dict[str, Any]:
    import jax

    from caper_jax.estimator import load
    from caper_jax.synthetic.videos import FRAMES
    from caper_jax.tracker import Tracker, config_for

    estimator = load(name, weights)
    tracker = Tracker(estimator, config_for(estimator))
    batch = _videos(estimator.category, _VIDEOS)

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
    # The program that just ran, which is not compiled again.
    lowered = tracker.step.lower(
        estimator.variables, tracker.state, tracker.observe(batch.points[0, 1])
    )
    cost = costs.of(lowered, lowered.compile())
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
                (keyframes if result.estimator_queried else steps).append(seconds)
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
        **costs.columns(cost, step),
        "load_average": machine.load_average(),
    }


def _videos(category: Any, count: int) -> Any:
    """Generated videos, on the host."""
    import jax
    import numpy as np

    from caper_jax.config import GeneratorConfig
    from caper_jax.synthetic.videos import VideoGenerator

    config = GeneratorConfig(instances=count, noise=("kinect",))
    videos = VideoGenerator(category, config, split="test")
    return jax.tree.map(np.asarray, videos.batch(jax.random.key(0), count))


def _measure_many(name: str, weights: Path | None, count: int, repeats: int) -> dict[str, Any]:
    import jax
    import numpy as np

    from caper_jax.estimator import load
    from caper_jax.tracker import Tracker, config_for

    estimator = load(name, weights)
    tracker = Tracker(estimator, config_for(estimator))
    distinct = _videos(estimator.category, min(count, _DISTINCT)).points
    clouds = distinct[np.arange(count) % len(distinct)].swapaxes(0, 1)
    frames = [jax.device_put(several(points)) for points in clouds]
    begin = jax.tree.map(
        lambda leaf: np.repeat(np.asarray(leaf)[None], count, 0), tracker.initial_state()
    )

    began = time.perf_counter()
    # Old states make room for new ones.
    step = jax.jit(jax.vmap(tracker.function, in_axes=(None, 0, 0)), donate_argnums=1)
    lowered = step.lower(estimator.variables, begin, frames[0])
    compiled = lowered.compile()
    compiling = time.perf_counter() - began
    seconds: list[float] = []
    for _ in range(repeats):
        state = jax.device_put(begin)
        for frame in frames:
            jax.block_until_ready(state)
            began = time.perf_counter()
            state, result = jax.block_until_ready(compiled(estimator.variables, state, frame))
            seconds.append(time.perf_counter() - began)
    median = statistics.median(seconds)
    return {
        "category": estimator.category.name,
        "videos": count,
        "frames_per_s": round(count / median, 1),
        "step_ms": round(1000 * median, 2),
        "lost_%": round(100 * float(np.mean(result.lost)), 1),
        "compile_s": round(compiling, 1),
        "memory_MB": round(timing.megabytes(compiled)),
        **costs.columns(costs.of(lowered, compiled), median),
        "load_average": machine.load_average(),
    }


def several(points: Any) -> Any:
    """The frames [V, N, 3] that many videos show at one moment, as observations."""
    import numpy as np

    from caper_jax.tracking.state import Observation

    return Observation(points, np.ones(len(points), bool), np.full(points.shape[:2], -1, np.int32))
