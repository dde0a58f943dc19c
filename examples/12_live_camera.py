"""Track what stands before a live depth camera.

    python examples/12_live_camera.py --box 200,120,440,360      # a RealSense camera
    python examples/12_live_camera.py --source FOLDER            # depth/*.png, mask/*.png
    python examples/12_live_camera.py --source generated         # no camera at hand

A RealSense camera is read through pyrealsense2 (pip install pyrealsense2); the object stands on a
table inside a box of the image, in pixels. FOLDER holds a recording and intrinsics.json. The step
of the tracker is compiled before the first frame, so that none is missed. Prints a line per frame:
position and rotation vector of the root, joint states, and the time that the frame took.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

import caper_jax as caper

NOTHING = np.zeros((0, 3), np.float32)  # a frame that does not show the object


def camera(box: tuple[float, ...], width: int = 640, height: int = 480):
    """Clouds [N, 3] of what stands on the table inside a box of a RealSense camera's image."""
    import pyrealsense2 as realsense

    pipeline, config = realsense.pipeline(), realsense.config()
    config.enable_stream(realsense.stream.depth, width, height, realsense.format.z16, 30)
    profile = pipeline.start(config)
    try:
        unit = profile.get_device().first_depth_sensor().get_depth_scale()
        stream = profile.get_stream(realsense.stream.depth).as_video_stream_profile()
        lens = stream.get_intrinsics()
        intrinsics = np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1.0]])
        while True:
            image = pipeline.wait_for_frames().get_depth_frame()
            depth = np.asanyarray(image.get_data()).astype(np.float32) * np.float32(unit)
            try:
                mask = caper.mask_from_box(depth, intrinsics, box)  # takes the table away
                yield caper.cloud_from_depth(depth, mask, intrinsics).points
            except caper.CaperError:
                yield NOTHING
    finally:
        pipeline.stop()


def recording(folder: Path):
    """Clouds of a folder of depth images and masks."""
    intrinsics = caper.read_intrinsics(folder / "intrinsics.json")
    for path in sorted((folder / "depth").glob("*.png")):
        mask = caper.read_mask(folder / "mask" / path.name, allow_empty=True)
        shown = mask.any()
        depth = caper.read_depth(path)
        yield caper.cloud_from_depth(depth, mask, intrinsics).points if shown else NOTHING


def generated(category: caper.Category, frames: int):
    """Clouds of a generated video."""
    sensor = caper.GeneratorConfig(instances=8, grid=64, noise=("kinect",))
    videos = caper.VideoGenerator(category, sensor, mode="cam", frames=frames, split="test")
    yield from jax.device_get(videos.batch(jax.random.key(1), 1).points[0])


def main(category: str, source: str, box: str, frames: int) -> None:
    tracker = caper.load_tracker(category)
    tracker(NOTHING)  # compiles
    tracker.reset()
    if source == "camera":
        clouds = camera(tuple(map(float, box.split(","))))
    elif source == "generated":
        clouds = generated(tracker.estimator.category, frames)
    else:
        clouds = recording(Path(source))
    for _, points in zip(range(frames), clouds, strict=False):
        began = time.perf_counter()
        result = jax.device_get(tracker(points))
        spent = 1000 * (time.perf_counter() - began)
        pose = result.pose
        # The rotation of the root as a vector: its axis times its angle, camera frame.
        turn = np.degrees(caper.so3.log(pose.rotation[0])).round(1)
        place, states = pose.translation[0].round(3), pose.joint_state.round(3)
        note = "  lost" if result.lost else ""
        print(f"t {place} m  r {turn} deg  states {states}  {spent:.0f} ms{note}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="laptop")
    parser.add_argument("--source", default="camera", help="camera, generated or a folder")
    parser.add_argument("--box", default="160,120,480,360", help="x1,y1,x2,y2 in pixels")
    parser.add_argument("--frames", type=int, default=12, help="stop after so many")
    main(**vars(parser.parse_args()))
