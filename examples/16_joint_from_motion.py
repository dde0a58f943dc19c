"""Where a joint is, and of which type, from motion alone, without a network.

    python examples/16_joint_from_motion.py

Parts of a generated video are registered to the last frame (ICP). Motions of a part relative to the
one that carries it are exp(state xi) with one screw xi = (w, v): their logarithms have rank one,
and the first singular vector is the joint: about w through w x v / |w|^2, or without rotation along
v. Prints and plots the errors of that and of the estimator, outputs/examples/motion.png. A minute.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import caper_jax as caper


@jax.jit
def register(clouds, own):
    """Motions [T, 4, 4] of one part from frames to the first one; clouds [T, N, 3], own [T, N]."""
    model = clouds[0]
    near = jnp.exp(-jnp.square(model[:, None] - model).sum(-1) / 0.1**2) * own[0]
    away = model - ((near / near.sum(-1, keepdims=True)) @ model)[:, None]
    normals = jnp.linalg.eigh(jnp.einsum("ij,ija,ijb->iab", near, away, away))[1][..., 0]

    def of_frame(motion, frame):
        def improve(motion, _):
            here = caper.se3.act(motion, frame[0])
            squared = jnp.square(here[:, None] - model).sum(-1) + jnp.where(own[0], 0.0, jnp.inf)
            match = squared.argmin(-1)
            weight = jnp.sqrt(frame[1] / (1 + squared.min(-1) / 0.03**2))

            def residuals(step):  # across the surface, and a little along it
                off = caper.se3.act(caper.se3.exp(step), here) - model[match]
                return (
                    weight * jnp.stack([(off * normals[match]).sum(-1), *(0.2 * off.T)])
                ).ravel()

            r, jacobian = residuals(jnp.zeros(6)), jax.jacfwd(residuals)(jnp.zeros(6))
            step = -jnp.linalg.solve(jacobian.T @ jacobian + 1e-3 * jnp.eye(6), jacobian.T @ r)
            return caper.se3.compose(caper.se3.exp(step), motion), None

        return 2 * (jax.lax.scan(improve, motion, length=15)[0],)

    return jax.lax.scan(of_frame, jnp.eye(4), (clouds, own))[1]


def joint_of(twists, unit):
    """(type, axis [3], pivot [3], states [T]) of twists [T, 6], whose lengths are meters * unit."""
    xi = np.linalg.svd(twists, full_matrices=False)[2][0]
    w, v = -xi.reshape(2, 3) * np.sign(twists[-1] @ xi)  # opens towards the last frame
    kind, along = ("revolute", w) if w @ w > 1 / 4 else ("prismatic", v / unit)
    states = twists @ np.append(w, v) * np.linalg.norm(along)
    return kind, along / np.linalg.norm(along), np.cross(w, v) / (w @ w) / unit, states


def main(frames: int, out: Path) -> None:
    sensor = caper.GeneratorConfig(instances=4)
    _, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for panel, name, joint in zip(axes, ("laptop", "drawer"), (0, 2), strict=True):
        estimator = caper.load(name)
        category, part = estimator.category, joint + 1
        generator = caper.VideoGenerator(category, sensor, "cam", frames, split="test")
        video = jax.tree.map(lambda a: a[0, ::-1], generator.batch(jax.random.key(1), 1))
        estimate, video = jax.device_get((estimator(video.points).pose, video))
        # In half objects, from the middle of the part, so that w and v are comparable.
        middle = video.points[0][video.labels[0] == part].mean(0)
        clouds = (video.points - middle) * category.unit
        carrier = register(clouds, video.labels == category.parents[joint])
        moved = carrier @ caper.se3.inverse(register(clouds, video.labels == part))
        kind, *found = joint_of(np.asarray(caper.se3.log(moved)), category.unit)
        scale, unit = (np.degrees(1), "deg") if kind == "revolute" else (1000, "mm")
        joints = {}
        for source, pose in (("truth", video.pose), ("estimator", estimate)):
            axis, pivot = (a[0, joint] for a in caper.joints_in_camera(pose))  # of the last frame
            joints[source] = (axis, pivot - middle, pose.joint_state[:, joint])
        true_axis, true_pivot, true = joints["truth"]
        for by, (axis, pivot, states) in (joints | {"motion": found}).items():
            angle = np.degrees(np.arccos(np.clip(axis @ true_axis, -1, 1)))
            distance = 1000 * np.linalg.norm(np.cross(pivot - true_pivot, true_axis))
            off = scale * np.abs(states - states[0] - (true - true[0]))
            at = f"pivot {distance:.1f} mm, " if kind == "revolute" else ""
            print(f"{name}, {by}: {kind}, axis {angle:.2f} deg, {at}state {off.mean():.2f} {unit}")
            panel.plot(off[::-1], ".-", label=by)
        panel.set(xlabel="frame", ylabel=f"error of the state [{unit}]", title=f"{name}: {kind}")
        panel.legend()
    out.mkdir(parents=True, exist_ok=True)
    plt.savefig(out / "motion.png", dpi=120)
    print("picture:", out / "motion.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
