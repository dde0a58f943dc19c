"""Learn the tracker's filter by gradients through whole videos.

    python examples/15_learn_filter.py

The tracker weighs estimates against increments by standard deviations that its ``TrackerConfig``
states. They may be traced: the error of a track is differentiated with respect to them, and to the
gain and damping of the velocity, through a scan of ``caper.track_step``. Adam on their logarithms
lowers it on some videos. Prints the error there and on videos held out, before and after, and what
was learned, and plots both over the steps in outputs/examples/filter.png. When a frame becomes a
keyframe is a decision, and has no gradient. Compiles for some minutes.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import caper_jax as caper

LEARNED = (
    "damping",
    "velocity_gain",
    *(f"static_{what}" for what in ("rotation", "translation", "joint")),
    *(f"drift_{what}" for what in ("rotation", "translation", "joint")),
)


def main(frames: int, videos: int, points: int, steps: int, out: Path) -> None:
    estimator = caper.load("laptop")
    # The paper's tracker: without registration, and without the corrections after both stages.
    network = replace(estimator.network, num_points=points, refine_steps=0)
    network = replace(network, refiner=replace(network.refiner, width=0))
    config = caper.TrackerConfig()
    config = replace(config, registration=replace(config.registration, steps=0))
    model = caper.Estimator(estimator.category, network, estimator.variables)
    begin = caper.Tracker(model, config).initial_state()
    sensor = caper.GeneratorConfig(instances=16, num_points=points, noise=("kinect",))
    generator = caper.VideoGenerator(model.category, sensor, "cam", frames, split="test")
    batch = generator.batch(jax.random.key(3), 2 * videos)

    def video_error(logarithms, video):
        """Mean error of the parts' rotations in one video, degrees."""
        cloud, truth = video
        numbers = {name: jnp.exp(value) for name, value in logarithms.items()}
        static = {"category": model.category, "network": network}
        step = partial(
            caper.track_step, model.variables, config=replace(config, **numbers), **static
        )
        present, unknown = jnp.ones(frames, bool), jnp.full(cloud.shape[:2], -1)
        observed = caper.Observation(cloud, present, unknown)
        pose = jax.lax.scan(step, begin, observed)[1].pose
        return jnp.degrees(caper.so3.geodesic_distance(pose.rotation, truth.rotation)).mean()

    def loss(logarithms, batch):
        return jax.lax.map(partial(video_error, logarithms), batch).mean()

    value_and_grad = jax.jit(jax.value_and_grad(loss))
    both = jax.tree.map(lambda a: a.reshape(2, videos, *a.shape[1:]), (batch.points, batch.pose))
    learn, held_out = (jax.tree.map(lambda a, half=half: a[half], both) for half in (0, 1))
    logarithms = {name: jnp.log(np.float32(getattr(config, name))) for name in LEARNED}
    adam = optax.adam(0.1)
    state, curve = adam.init(logarithms), []
    for _ in range(steps + 1):
        (value, gradient), (other, _) = (value_and_grad(logarithms, x) for x in (learn, held_out))
        curve.append((value, other))
        print(f"step {len(curve) - 1}: {value:.3f} deg, held out {other:.3f}", flush=True)
        used = logarithms
        updates, state = adam.update(gradient, state)
        logarithms = optax.apply_updates(logarithms, updates)
    first, last = curve[0], curve[-1]
    print(f"videos learned from: {first[0]:.3f} deg before, {last[0]:.3f} after")
    print(f"videos held out: {first[1]:.3f} deg before, {last[1]:.3f} after")
    for name in LEARNED:
        print(f"{name}: {getattr(config, name):g} -> {jnp.exp(used[name]):.3g}")

    figure, axes = plt.subplots(figsize=(5, 3.2), layout="constrained")
    axes.plot(np.array(curve), label=("learned from", "held out"))
    axes.set(xlabel="step", ylabel="error of the rotation [deg]", title="Learning the filter")
    axes.legend()
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "filter.png", dpi=120)
    print("picture:", out / "filter.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=15)
    parser.add_argument("--videos", type=int, default=3)
    parser.add_argument("--points", type=int, default=256)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
