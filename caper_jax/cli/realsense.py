"""Sends what stands on the table before a RealSense camera to ``caper track --live``.

Run as ``python -m caper_jax.cli.realsense --box x1,y1,x2,y2 | caper track ... --live -``, or into
``nc -lk 5000`` and track from another machine with ``--live HOST:5000``. The camera is read
through pyrealsense2, which this package does not install.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caper_jax.cli import common
from caper_jax.cli.common import Count
from caper_jax.data.clouds import cloud_from_depth, mask_from_box
from caper_jax.data.live import pack_frame
from caper_jax.errors import CaperError

NUM_POINTS = 1024
PROG = "python -m caper_jax.cli.realsense"


@dataclass(frozen=True)
class RealSense:
    """Writes the clouds of the object inside a fixed box of the depth image to standard output.

    The format is that of caper_jax/data/live.py. The table that the object stands on is taken
    away; a frame in which nothing stands there has no points.

    Attributes:
      box: x1,y1,x2,y2 in pixels of the depth image
      width: of the depth image, pixels
      height: likewise
      rate: frames per second
      frames: stop after so many (default: never)
    """

    box: str
    width: Count = 640
    height: Count = 480
    rate: Count = 30
    frames: Count | None = None


def main(argv: Sequence[str]) -> int:
    """Runs the feeder; returns its exit code."""
    options = common.parse(RealSense, argv, prog=PROG)
    x1, y1, x2, y2 = box = common.pixel_box(options.box)
    width, height = options.width, options.height
    if not (max(x1, 0) < min(x2, width) and max(y1, 0) < min(y2, height)):
        raise CaperError(f"--box {options.box} is empty in {width} x {height} pixels")
    if sys.stdout.isatty():
        raise CaperError("frames are bytes, no text: pipe them into caper track --live -")
    for number, (depth, intrinsics) in enumerate(camera_frames(width, height, options.rate)):
        sys.stdout.buffer.write(pack_frame(object_points(depth, intrinsics, box), number))
        sys.stdout.buffer.flush()
        if number + 1 == options.frames:
            break
    return 0


def object_points(
    depth: np.ndarray, intrinsics: np.ndarray, box: tuple[float, float, float, float]
) -> np.ndarray:
    """[N, 3] meters of what stands on the table inside the box; none where nothing does."""
    try:
        mask = mask_from_box(depth, intrinsics, box)
        return cloud_from_depth(depth, mask, intrinsics, NUM_POINTS).points
    except CaperError:
        return np.zeros((0, 3), np.float32)


def camera_frames(width: int, height: int, rate: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Depth images [H, W] in meters and intrinsics [3, 3] of the first camera found, endlessly.

    Raises:
      CaperError: pyrealsense2 is not installed, or no camera gives such images.
    """
    try:
        realsense: Any = importlib.import_module("pyrealsense2")
    except ImportError as error:
        raise CaperError(
            f"cannot import pyrealsense2 ({error}); install it with pip install pyrealsense2"
        ) from error
    pipeline, config = realsense.pipeline(), realsense.config()
    config.enable_stream(realsense.stream.depth, width, height, realsense.format.z16, rate)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise CaperError(
            f"no RealSense camera gives depth of {width} x {height} at {rate} Hz ({error})"
        ) from error
    try:
        unit = profile.get_device().first_depth_sensor().get_depth_scale()
        stream = profile.get_stream(realsense.stream.depth).as_video_stream_profile()
        camera = stream.get_intrinsics()
        intrinsics = np.array(
            [[camera.fx, 0.0, camera.ppx], [0.0, camera.fy, camera.ppy], [0.0, 0.0, 1.0]]
        )
        while True:
            try:
                image = pipeline.wait_for_frames().get_depth_frame()
            except RuntimeError as error:
                raise CaperError(f"the camera stopped sending ({error})") from error
            yield np.asanyarray(image.get_data()).astype(np.float32) * np.float32(unit), intrinsics
    finally:
        pipeline.stop()


if __name__ == "__main__":
    sys.exit(common.run(main, sys.argv[1:], command="realsense"))
