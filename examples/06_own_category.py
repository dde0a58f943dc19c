"""A category of one's own: faucets, whose lever is lifted.

    python examples/06_own_category.py --minutes 30

A category is a function that draws shapes, and a few facts about them. Prints the sizes that the
definition must state, draws generated faucets in outputs/examples/faucets.png, and trains a model
of them. On the command line this category is ``examples/06_own_category.py:FAUCET``, for example
``caper train --category examples/06_own_category.py:FAUCET --out runs/faucet``.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import caper_jax as caper

UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # a cylinder's z -> y


def shape(rng: np.random.Generator) -> caper.ObjectModel:
    """Draws one faucet at rest, the lever down; meters, y up, the spout towards +z."""
    solids = caper.geometry.solids  # by their center and half extents
    radius, height, reach = rng.uniform((0.018, 0.12, 0.12), (0.026, 0.20, 0.18))
    spout, drop, length = rng.uniform((0.009, 0.02, 0.09), (0.014, 0.05, 0.15))
    body = [
        solids.cylinder((0, 0.005, 0), (1.5 * radius, 1.5 * radius, 0.005), UPRIGHT),
        solids.cylinder((0, height / 2, 0), (radius, radius, height / 2), UPRIGHT),
        solids.box((0, 0.75 * height, reach / 2), (spout, 0.8 * spout, reach / 2)),
        solids.cylinder((0, 0.75 * height - drop / 2, reach), (spout, spout, drop / 2), UPRIGHT),
    ]
    top = height + 0.012
    lever = [
        solids.cylinder((0, top, 0), (0.95 * radius, 0.95 * radius, 0.012), UPRIGHT),
        solids.box((0, top + 0.008, length / 2), (0.4 * radius, 0.004, length / 2)),
    ]
    axis = np.array([[-1.0, 0.0, 0.0]])  # about it the end of the lever, at +z, goes up
    pivot = np.array([[0.0, top, 0.0]])
    limits = np.array([[0.0, np.radians(rng.uniform(30, 50))]])
    return caper.ObjectModel([body, lever], axis, pivot, limits)


FAUCET = caper.Category(
    name="faucet",
    parts=("body", "lever"),
    joints=(caper.Joint("revolute", parent=0, limits=(0.0, np.radians(50.0))),),
    directions=("y", "z"),
    directions_reason="the post shows up, the spout shows the front",
    unit=7.23,  # 2 over the mean diagonal of the object, meters
    mean_size=((0.066, 0.161, 0.194), (0.042, 0.024, 0.141)),
    mean_center=((0.0, -0.012, 0.0), (0.0, 0.080, -0.014)),
    shape=shape,
)


def main(minutes: float, quick: bool, out: Path) -> None:
    sensor = caper.GeneratorConfig(instances=200, noise=("none",))
    batch = jax.device_get(caper.Generator(FAUCET, sensor).batch(jax.random.key(0), 100))
    size, center = batch.pose.size, batch.pose.box_center
    low, high = (center - size / 2).min(1), (center + size / 2).max(1)
    print(f"unit {2 / np.linalg.norm(high - low, axis=-1).mean():.2f}")
    print(f"mean_size\n{size.mean(0).round(3)}")
    print(f"mean_center\n{center.mean(0).round(3)}")

    frames = [jax.tree.map(lambda rows, i=i: rows[i], batch) for i in range(4)]
    scenes = [caper.Scene("faucet", FAUCET, f.points, f.labels, f.pose) for f in frames]
    print("picture:", caper.write_picture(out / "faucets.png", scenes))

    caper.register(FAUCET)  # so that a run and a model may name it
    config = caper.preset("fast", "faucet")
    config = replace(config, training=replace(config.training, minutes=minutes))
    if quick:
        return
    result = caper.train(config, out / "faucet")
    print(f"{int(result.state.step)} steps: caper.load('faucet', '{out / 'faucet'}')")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=30.0, help="of training")
    parser.add_argument("--quick", action="store_true", help="draw only, do not train")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
