"""Calibrate a robot's camera by the object that it and a fixed camera see, through the estimator.

    python examples/14_camera_calibration.py

An arm knows where its camera is relative to its base. Where the base stands in the frame of a fixed
camera is unknown, and the arm's camera has a focal length 5 % longer than assumed. Gauss-Newton on
SE(3) and the focal length, through a jvp of the estimator, makes the poses agree that it finds in
both cameras. Prints the errors and plots them, outputs/examples/calibration.png. A minute or two.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import caper_jax as caper

BASE = caper.se3.exp([0.5, -1.0, 0.8, 0.3, -0.2, 0.6])  # base -> fixed camera, to be found
START = caper.se3.exp([0.3, 0.2, -0.3, 0.2, 0.1, -0.2]) @ BASE
ERRORS = ("rotation [deg]", "position [mm]", "focal length [%]")
ASSUMED = 0.95  # focal length of the moving camera over the true one


def matrices(pose):
    return caper.se3.from_rt(pose.rotation, pose.translation)


def main(frames: int, quick: bool, out: Path) -> None:
    estimator = caper.load("laptop")
    if quick:  # stage I and stage II alone, without the corrections after them
        network = replace(estimator.network, refine_steps=0)
        network = replace(network, refiner=replace(network.refiner, width=0))
        estimator = caper.Estimator(
            estimator.category, network, estimator.variables, estimator.card
        )
    sensor = caper.GeneratorConfig(instances=8)
    videos = []  # of the same object and joint states, by a camera at rest and one on an arc
    for mode in ("paper", "cam"):
        generator = caper.VideoGenerator(estimator.category, sensor, mode, frames, split="test")
        videos.append(generator.batch(jax.random.key(3), 1))
    fixed, moving = videos
    from_moving = caper.se3.inverse(matrices(moving.pose)[0, :, 0])  # to the root
    arm = caper.se3.inverse(BASE) @ matrices(fixed.pose)[0, :, 0] @ from_moving  # [T, 4, 4] to base
    wrong = moving.points[0] / jnp.array([ASSUMED, ASSUMED, 1.0])  # x = depth * pixels / focal
    reference = estimator(fixed.points[0])
    target = caper.se3.inverse(matrices(reference.pose))  # [T, K, 4, 4]

    def seen(log_focal):
        points = wrong * jnp.exp(-log_focal * jnp.array([1.0, 1.0, 0.0]))
        prediction = estimator.function(estimator.variables, points)
        return matrices(prediction.pose), prediction

    @jax.jit
    def improve(base, log_focal, free):
        """One robust step; free: which of the 7 numbers may change."""
        (poses, prediction), (slope, _) = jax.jvp(seen, (log_focal,), (jnp.ones(()),))
        rotation = jnp.hypot(reference.rotation_std, prediction.rotation_std)
        translation = jnp.hypot(reference.translation_std, prediction.translation_std)
        sigma = jnp.stack([rotation, translation], -1)  # [T, K, 2]

        def residuals(step):  # [T K 6] in standard deviations
            moved = caper.se3.compose(caper.se3.exp(step[:6]), base)
            here = caper.se3.compose((moved @ arm)[:, None], poses + step[6] * slope)
            off = caper.se3.log(caper.se3.compose(target, here)).reshape(*here.shape[:2], 2, 3)
            return (off / sigma[..., None]).ravel()

        r, jacobian = residuals(jnp.zeros(7)), jax.jacfwd(residuals)(jnp.zeros(7)) * free
        weighted = jacobian.T / (1 + (r / 3) ** 2)
        step = -jnp.linalg.solve(weighted @ jacobian + 1e-6 * jnp.eye(7), weighted @ r)
        return caper.se3.compose(caper.se3.exp(step[:6]), base), log_focal + step[6]

    _, axes = plt.subplots(1, 3, figsize=(10, 3), layout="constrained")
    for name, free in (("base alone", 0.0), ("base and focal length", 1.0)):
        base, log_focal, rows = START, jnp.zeros(()), []
        for _ in range(7):
            turn = np.degrees(caper.so3.geodesic_distance(base[:3, :3], BASE[:3, :3]))
            shift = 1000 * np.linalg.norm(base[:3, 3] - BASE[:3, 3])
            rows.append((turn, shift, 100 * abs(ASSUMED * np.exp(log_focal) - 1)))
            base, log_focal = improve(base, log_focal, jnp.array([1.0] * 6 + [free]))
        for when, row in (("start", rows[0]), (name, rows[-1])):
            print(f"{when}: off by {row[0]:.2f} deg, {row[1]:.1f} mm, focal by {row[2]:.2f} %")
        for panel, values, title in zip(axes, np.transpose(rows), ERRORS, strict=True):
            panel.semilogy(values, "o-", label=name)
            panel.set(xlabel="step", title=f"error of the {title}", ylim=(0.01, None))
    axes[0].legend()
    out.mkdir(parents=True, exist_ok=True)
    plt.savefig(out / "calibration.png", dpi=120)
    print("picture:", out / "calibration.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--quick", action="store_true", help="a smaller network")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
