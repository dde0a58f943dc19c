"""Differentiate a pose loss through the estimator, to its weights and to its points.

    python examples/03_gradient_estimator.py

``caper.estimate`` is a pure function of weights and points. Here the error of the lid's angle of a
generated laptop is differentiated with respect to both: a step of gradient descent on the weights
lowers the loss, and outputs/examples/gradient.png shows which points the estimated angle depends
on. The gradient is checked against finite differences. About a minute, most of which is spent
compiling.
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


def main(category: str, quick: bool, out: Path) -> None:
    estimator = caper.load(category)
    network = estimator.network
    if quick:  # stage I and stage II alone, without the corrections after them
        network = replace(network, refine_steps=0, refiner=replace(network.refiner, width=0))
    sensor = caper.GeneratorConfig(instances=4, noise=("kinect",))
    generator = caper.Generator(estimator.category, sensor, split="test")
    batch = generator.batch(jax.random.key(2), 1)  # points [1, 1024, 3] meters

    estimate = partial(caper.estimate, category=estimator.category, network=network)

    def loss(variables, points):
        """Squared error of the joint states, radians."""
        pose = estimate(variables, points).pose
        return jnp.square(pose.joint_state - batch.pose.joint_state).sum()

    value_and_grad = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    value, (of_weights, of_points) = value_and_grad(estimator.variables, batch.points)

    # Along the gradient of the weights, the loss changes as the gradient says.
    length = float(optax.tree.norm(of_weights))
    rate = 0.05 * float(value) / length**2

    def moved(rate):
        variables = jax.tree.map(lambda v, g: v + rate * g, estimator.variables, of_weights)
        return float(value_and_grad(variables, batch.points)[0])

    print(f"loss {value:.3e} rad^2")
    print(f"slope along the weights' gradient {rate * length**2:.3e},")
    print(f"by finite differences             {(moved(rate) - moved(-rate)) / 2:.3e}")

    descent = optax.sgd(10 * rate)
    updates, _ = descent.update(of_weights, descent.init(estimator.variables))
    better = optax.apply_updates(estimator.variables, updates)
    print(f"after one step on the weights: {value_and_grad(better, batch.points)[0]:.3e} rad^2")

    out.mkdir(parents=True, exist_ok=True)
    x, y, z = np.asarray(batch.points[0]).T
    size = np.linalg.norm(of_points[0], axis=-1)
    figure, axes = plt.subplots(figsize=(5, 4), layout="constrained")
    dots = axes.scatter(x / z, -y / z, c=size, s=8, cmap="viridis", vmax=np.percentile(size, 98))
    figure.colorbar(dots, label="|d loss / d point| [rad$^2$/m]")
    axes.set(aspect="equal", title=f"{category}: the points that the joint state depends on")
    figure.savefig(out / "gradient.png", dpi=120)
    print("picture:", out / "gradient.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="laptop")
    parser.add_argument("--quick", action="store_true", help="a smaller network")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
