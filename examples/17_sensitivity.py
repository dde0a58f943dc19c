"""Which points an estimate hangs on, and how far noise of the depth carries.

    python examples/17_sensitivity.py

The Jacobian of the root's pose and of the joint states with respect to the depth of every point,
by one vjp per output under vmap, and averaged over 20 clouds with noise: outputs/examples/
sensitivity.png shows it on the cloud. Times the noise of the sensor it gives standard deviations.
They are printed beside those of a Monte Carlo run, and beside the calibrated ones, which stand for
all that is uncertain in an estimate, not for noise alone. About a minute.
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


def main(category: str, noise: float, draws: int, quick: bool, out: Path) -> None:
    estimator = caper.load(category)
    network = estimator.network
    if quick:  # stage I and stage II alone, without the corrections after them
        network = replace(network, refine_steps=0, refiner=replace(network.refiner, width=0))
    sensor = caper.GeneratorConfig(instances=4, noise=("none",))
    generator = caper.Generator(estimator.category, sensor, split="test")
    points = generator.batch(jax.random.key(2), 1).points[0]  # [N, 3] meters
    rays = points / jnp.linalg.norm(points, axis=-1, keepdims=True)
    estimate = partial(
        caper.estimate,
        estimator.variables,
        category=estimator.category,
        network=network,
        calibration=estimator.calibration,
    )
    prediction = jax.jit(estimate)(points[None])
    rotation, origin = prediction.pose.rotation[0, 0], prediction.pose.translation[0, 0]
    revolute = np.array(estimator.category.joint_types) == "revolute"
    per_state = np.where(revolute, np.degrees(1), 1000)

    def outputs(depth):
        """The root's rotation [3], degrees, and translation [3], mm, about and along the axes of
        the camera, and the joint states [J], deg or mm, with points moved by so many meters [N]."""
        pose = estimate((points + depth[:, None] * rays)[None]).pose
        turn = jnp.degrees(caper.so3.log(pose.rotation[0, 0] @ rotation.T))
        shift = 1000 * (pose.translation[0, 0] - origin)
        return jnp.concatenate([turn, shift, per_state * pose.joint_state[0]])

    depths = noise * jax.random.normal(jax.random.key(6), (draws, len(points)))
    drawn = np.asarray(jax.jit(partial(jax.lax.map, outputs))(depths))  # [draws, 6 + J]
    # Where noise crosses the corners of a piecewise linear network, its mean slope counts.
    jacobians = jax.jit(partial(jax.lax.map, jax.jacrev(outputs)))(depths[:20])
    jacobian = np.asarray(jacobians.mean(0))  # [6 + J, N]
    names = ["root rotation", "root translation"]
    rows, units = [slice(0, 3), slice(3, 6)], ["deg", "mm"]
    stated = [np.degrees(prediction.rotation_std[0, 0]), 1000 * prediction.translation_std[0, 0]]
    for j, part in enumerate(estimator.category.parts[1:]):
        names.append(f"joint of {part}")
        rows.append(slice(6 + j, 7 + j))
        units.append("deg" if revolute[j] else "mm")
        stated.append(per_state[j] * prediction.state_std[0, j])

    figure, axes = plt.subplots(1, len(names), figsize=(4.2 * len(names), 3), layout="constrained")
    x, y, z = np.asarray(points).T
    print(f"standard deviations for {1000 * noise:g} mm of noise in every depth")
    for panel, name, row, unit, calibrated in zip(axes, names, rows, units, stated, strict=True):
        first_order = noise * np.sqrt((jacobian[row] ** 2).sum(-1).mean())  # of one axis
        sampled = np.sqrt(drawn[:, row].var(0).mean())
        print(
            f"{name}: {first_order:.3f} {unit} by the Jacobian, {sampled:.3f} by Monte Carlo,"
            f" {calibrated:.3f} calibrated"
        )
        size = np.linalg.norm(jacobian[row], axis=0) / 1000  # of a millimeter
        dots = panel.scatter(
            x / z, -y / z, c=size, s=9, cmap="magma_r", vmin=0, vmax=np.percentile(size, 98)
        )
        figure.colorbar(dots, shrink=0.7, label=f"{unit} per mm of depth")
        panel.set(aspect="equal", title=name, xticks=[], yticks=[])
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "sensitivity.png", dpi=120)
    print("picture:", out / "sensitivity.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="laptop")
    parser.add_argument("--noise", type=float, default=0.003, help="of a depth, meters")
    parser.add_argument("--draws", type=int, default=200, help="of the Monte Carlo run")
    parser.add_argument("--quick", action="store_true", help="a smaller network")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
