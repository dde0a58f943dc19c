"""Track the parts of an object through a stream of point clouds.

    python examples/02_track.py

The stream is a generated video of a laptop that opens while the camera moves; any iterable of
clouds [N, 3] in meters does. Prints the mean error of the joint state and plots that of every
frame, tracked and true, in outputs/examples/track.png. Half a minute, most of which is spent
compiling the step of the tracker.
"""

import argparse
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import caper_jax as caper


def main(category: str, frames: int, out: Path) -> None:
    tracker = caper.load_tracker(category)
    sensor = caper.GeneratorConfig(instances=8, grid=64, noise=("kinect",))
    generator = caper.VideoGenerator(
        tracker.estimator.category, sensor, mode="cam", frames=frames, split="test"
    )
    video = jax.device_get(generator.batch(jax.random.key(1), 1))  # leading axes: [1, T]
    truth = jax.tree.map(lambda array: array[0], video.pose)  # [T, K, ...]

    states, lost = [], []
    for points in video.points[0]:  # [N, 3] meters, camera frame; N may vary and be 0
        result = tracker(points)
        states.append(result.pose.joint_state)
        lost.append(bool(result.lost))
    states = np.degrees(np.stack(states))  # [T, J]

    off = np.abs(states - np.degrees(truth.joint_state)).mean(0)
    for part, degrees in zip(tracker.estimator.category.parts[1:], off, strict=True):
        print(f"joint of {part}: off by {degrees:.2f} deg (mean over frames)")
    print(f"lost in {sum(lost)} of {frames} frames")

    out.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
    axes.plot(np.degrees(truth.joint_state), "k--", label="true")
    axes.plot(states, "o-", label="tracked")
    axes.set(xlabel="frame", ylabel="joint state [deg]", title=category)
    axes.legend()
    figure.savefig(out / "track.png", dpi=120)
    print("picture:", out / "track.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="laptop", help="one with revolute joints")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
