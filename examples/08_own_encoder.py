"""An encoder of one's own: PointNet in the place of the encoders of the package.

    python examples/08_own_encoder.py --steps 300

An encoder is a Flax module from points [B, N, 3] to ``caper.encoders.Features``: features per
point, and one of the whole cloud. Registered under a name, it is a value of ``network.encoder``
like the two of the package. Trains with it and plots the loss in outputs/examples/pointnet.png.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import flax.linen as nn
import jax
import matplotlib.pyplot as plt
from small import small

import caper_jax as caper


class PointNet(nn.Module):
    """The same layers on every point, then the maximum over points (Qi et al. 2017).

    Attributes:
      widths: channels of the layers.
    """

    widths: tuple[int, ...] = (64, 128, 256)

    @nn.compact
    def __call__(self, points, train: bool) -> caper.encoders.Features:
        """points [B, N, 3], network units; ``train`` chooses the mode of batch norm."""
        features = points
        for width in self.widths:
            features = nn.Dense(width)(features)
            features = nn.relu(nn.BatchNorm(use_running_average=not train)(features))
        # One level, whose rows are the points themselves, and a feature of the whole cloud.
        level = caper.encoders.Level(features)
        return caper.encoders.Features(points, (level,), features.max(axis=1))


def main(category: str, steps: int, quick: bool, out: Path) -> None:
    caper.encoders.register("pointnet", PointNet)  # of other sizes: partial(PointNet, widths=...)
    config = caper.preset("fast", category)
    if quick:
        config = small(config, steps)
    network = replace(config.network, encoder="pointnet")

    generator = caper.Generator(caper.categories.get(category), config.data)
    objective = caper.Objective(generator.category, network, config.loss)
    optimizer = caper.Optimizer("adamw", learning_rate=1e-3)
    state = caper.TrainState.create(objective.init(jax.random.key(0)), optimizer, seed=0)
    count = sum(leaf.size for leaf in jax.tree.leaves(state.params))
    print(f"both stages with PointNet: {count} weights")

    step = jax.jit(partial(caper.train_step, loss_fn=objective, optimizer=optimizer))
    losses = []
    for key in jax.random.split(jax.random.key(1), steps):
        state, metrics = step(state, generator.batch(key, config.training.batch_size))
        losses.append(float(metrics["loss"]))
    print(f"loss {losses[0]:.2f} -> {losses[-1]:.2f} in {steps} steps")

    # caper.Estimator(generator.category, network, state.variables) is the model that was trained.
    out.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
    axes.semilogy(losses)
    axes.set(xlabel="step", ylabel="loss", title=f"{category} with PointNet")
    figure.savefig(out / "pointnet.png", dpi=120)
    print("picture:", out / "pointnet.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="box")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--quick", action="store_true", help="small heads")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
