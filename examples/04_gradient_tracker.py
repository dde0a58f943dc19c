"""Differentiate through the tracker: how much does a pose owe to each earlier frame?

    python examples/04_gradient_tracker.py

``caper.track_step`` is a pure function (variables, state, frame) -> (state, result). A scan of it
tracks a whole video, and the gradient of the last frame's joint state reaches the points of every
frame. Prints and plots the size of that gradient by frame, outputs/examples/memory.png: what the
tracker knows of a frame that is past sits in its state. Compiles for a minute or two.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import caper_jax as caper


def main(category: str, frames: int, quick: bool, out: Path) -> None:
    tracker = caper.load_tracker(category)
    estimator, config = tracker.estimator, tracker.config
    network = estimator.network
    if quick:
        config = replace(config, registration=replace(config.registration, steps=0))
        network = replace(network, refine_steps=0, refiner=replace(network.refiner, width=0))
    step = partial(caper.track_step, category=estimator.category, network=network, config=config)

    sensor = caper.GeneratorConfig(instances=4, noise=("kinect",))
    generator = caper.VideoGenerator(estimator.category, sensor, frames=frames, split="test")
    video = jax.device_get(generator.batch(jax.random.key(3), 1))
    observed = [tracker.observe(points) for points in video.points[0]]
    observations = jax.tree.map(lambda *rows: jnp.stack(rows), *observed)  # [T, ...]

    def last_state(points, variables):
        """The joint state in the last frame, radians, from the points [T, N, 3] of all frames."""
        begin = tracker.initial_state()
        scan = partial(step, variables)
        result = jax.lax.scan(scan, begin, replace(observations, points=points))[1]
        return result.pose.joint_state[-1, 0]

    value_and_grad = jax.jit(jax.value_and_grad(last_state))
    state, gradient = value_and_grad(observations.points, estimator.variables)
    size = np.linalg.norm(gradient, axis=(-1, -2))  # [T] radians per meter
    print(
        f"last joint state: {np.degrees(state):.2f} deg, "
        f"true {np.degrees(video.pose.joint_state[0, -1, 0]):.2f} deg"
    )
    for frame, length in enumerate(size):
        print(f"frame {frame}: |d state / d points| = {length:.3f} rad/m")

    out.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
    axes.bar(np.arange(len(size)), size)
    axes.set(xlabel="frame", ylabel="gradient [rad/m]", title="What the last state depends on")
    figure.savefig(out / "memory.png", dpi=120)
    print("picture:", out / "memory.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="laptop")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--quick", action="store_true", help="no registration nor corrections")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
