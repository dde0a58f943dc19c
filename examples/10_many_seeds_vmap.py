"""Many trainings at once: seeds and loss weights side by side under vmap.

    python examples/10_many_seeds_vmap.py --steps 500

An ablation needs several seeds per variant. ``caper.train_step`` is a plain function and
``caper.LossWeights`` a pytree, so one compiled program trains all of them: vmap over variants of
the weights, vmap over seeds, scan over steps. Prints mean and spread over seeds of what each
variant learned. The networks are small, so that all of them fit side by side.
"""

import argparse
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from small import small

import caper_jax as caper

STATE_WEIGHTS = (0.0, 6.0, 24.0)  # of the joint state's loss; the paper's is 6


def main(category: str, seeds: int, steps: int, batch_size: int) -> None:
    config = small(caper.preset("fast", category), steps)
    generator = caper.Generator(caper.categories.get(category), config.data)
    optimizer = caper.Optimizer("adamw", learning_rate=3e-3)

    def objective(weight):
        """The loss with one weight replaced, which may be traced."""
        weights = replace(config.loss.weights, state=weight)
        loss = replace(config.loss, weights=weights)
        return caper.Objective(generator.category, config.network, loss)

    init = jax.jit(objective(6.0).init)
    initial = [init(jax.random.key(seed)) for seed in range(seeds)]
    initial = jax.tree.map(lambda *rows: jnp.stack(rows), *initial)  # [seeds, ...]

    def run(weight, variables, seed):
        """One training: weight [], variables of one seed; the metrics of every step."""
        state = caper.TrainState.create(variables, optimizer, seed)

        def step(state, key):
            batch = generator.draw(key, batch_size)
            return caper.train_step(state, batch, loss_fn=objective(weight), optimizer=optimizer)

        keys = jax.random.split(jax.random.key(seed), steps)
        return jax.lax.scan(step, state, keys)[1]

    over_seeds = jax.vmap(run, in_axes=(None, 0, 0))
    over_weights = jax.jit(jax.vmap(over_seeds, in_axes=(0, None, None)))
    metrics = over_weights(jnp.array(STATE_WEIGHTS), initial, jnp.arange(seeds))

    last = slice(-max(steps // 10, 1), None)  # the last tenth of the steps
    names = ("root_deg", "state1_deg")
    print(f"{len(STATE_WEIGHTS)} x {seeds} trainings of {steps} steps, mean +- spread over seeds")
    print("state weight | " + " | ".join(f"{name:>16}" for name in names))
    for row, weight in enumerate(STATE_WEIGHTS):
        cells = []
        for name in names:
            values = np.asarray(metrics[name][row, :, last]).mean(-1)  # [seeds]
            cells.append(f"{values.mean():7.2f} +- {values.std(ddof=1):5.2f}")
        print(f"{weight:12g} | " + " | ".join(f"{cell:>16}" for cell in cells))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="box")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--batch-size", type=int, default=16)
    main(**vars(parser.parse_args()))
