"""Refine a pose on SE(3), and see from how far away that works.

    python examples/13_pose_refinement.py

Points of generated laptops, known to show the base or the lid, should lie on that part's box. From
starts rotated by 0 to 180 deg, Gauss-Newton and gradient descent look for the root pose at which
they do: along twists, where a step is a motion exp(xi) of the pose so far, and in Euclidean
coordinates, Euler angles and a translation. All starts run under vmap. Prints how often the truth
is found, and plots it over the error of the start, outputs/examples/basin.png. About a minute.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import caper_jax as caper

STEPS = {"Gauss-Newton": 30, "gradient descent": 200}


def to_euler(pose):
    (a, _, _), (b, _, _), (c, d, e) = pose[:3, :3]
    return jnp.array([jnp.arctan2(d, e), -jnp.arcsin(c), jnp.arctan2(b, a), *pose[:3, 3]])


def from_euler(x):
    about_x, about_y, about_z = (caper.so3.exp(x[i] * jnp.eye(3)[i]) for i in range(3))
    return caper.se3.from_rt(about_z @ about_y @ about_x, x[3:])


COORDINATES = {  # of a pose [4, 4]; the pose of coordinates; coordinates after a step [6]
    "twists": (jnp.array, jnp.array, lambda x, s: caper.se3.compose(caper.se3.exp(s), x)),
    "Euler angles": (to_euler, from_euler, lambda x, s: x + s),
}


def refine(start, truth, points, labels, to_part, center, size, coordinates, method):
    """The error of the rotation, degrees, that is left of a start [4, 4], camera -> root."""
    begin, pose_of, move = COORDINATES[coordinates]

    def residuals(step, x):  # [N] distances of the points from their boxes
        own = caper.se3.compose(to_part, pose_of(move(x, step)))[labels]
        own = caper.se3.act(own, points[:, None])[:, 0]
        return caper.geometry.boxes.signed_distance(own, center[labels], size[labels])

    def improve(x, _):
        r, jacobian = residuals(jnp.zeros(6), x), jax.jacfwd(residuals)(jnp.zeros(6), x)
        gradient, curvature = jacobian.T @ r / len(r), jacobian.T @ jacobian / len(r)
        step = 0.1 * gradient / jnp.sqrt((r**2).mean())  # along the gradient of the RMS distance
        if method == "Gauss-Newton":
            step = jnp.linalg.solve(curvature + 1e-3 * jnp.eye(6), gradient)
        return move(x, -step), None

    x, _ = jax.lax.scan(improve, begin(start), length=STEPS[method])
    return jnp.degrees(caper.so3.geodesic_distance(pose_of(x)[:3, :3], truth[:3, :3]))


def main(starts: int, out: Path) -> None:
    laptop = caper.categories.get("laptop")
    sensor = caper.GeneratorConfig(instances=8, num_points=128)
    batch = caper.Generator(laptop, sensor, split="test").batch(jax.random.key(4), 8)
    # Half an object is 1, and the cloud is about its middle: a radian weighs as much as a unit.
    unit, middle = laptop.unit, batch.points.mean(1, keepdims=True)
    pose = caper.se3.from_rt(batch.pose.rotation, (batch.pose.translation - middle) * unit)
    truth, to_part = caper.se3.inverse(pose[:, 0]), caper.se3.inverse(pose) @ pose[:, :1]
    cloud = ((batch.points - middle) * unit, batch.labels)
    scene = (*cloud, to_part, batch.pose.box_center * unit, batch.pose.size * unit)

    angles = np.linspace(0, 180, 13)
    axis, shift = jax.random.normal(jax.random.key(5), (2, 8, 1, starts, 3))
    axis *= jnp.radians(angles)[:, None, None] / jnp.linalg.norm(axis, axis=-1, keepdims=True)
    away = jnp.concatenate(jnp.broadcast_arrays(axis, 0.1 * shift), -1)
    begin = caper.se3.compose(caper.se3.exp(away), truth[:, None, None])
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharey=True)
    for panel, method in zip(axes, STEPS, strict=True):
        for name in COORDINATES:
            run = partial(refine, coordinates=name, method=method)
            run = jax.vmap(jax.vmap(jax.vmap(run, (0, *[None] * 6)), (0, *[None] * 6)))
            found = 100 * np.asarray(jax.jit(run)(begin, truth, *scene) < 5).mean((0, 2))
            near, far = found[:7].mean(), found[7:].mean()
            print(f"{method}, {name}: {near:.0f} % from within 90 deg, {far:.0f} % from beyond")
            panel.plot(angles, found, "o-", label=name)
        panel.set(xlabel="error of the start [deg]", title=f"{method}, {STEPS[method]} steps")
        panel.legend()
    axes[0].set(ylabel="within 5 deg of the truth [%]", xticks=angles[::2])
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "basin.png", dpi=120)
    print("picture:", out / "basin.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--starts", type=int, default=16, help="of each angle, per laptop")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
