"""A loss of one's own, added to those of both stages.

    python examples/07_own_loss.py

``caper.Objective`` is the loss of the paper; whatever is called like it can take its place in
``caper.train_step``. Here a term is added that needs no label: the points of a part lie on the
surface of the part's box, as the estimator that is being trained sees it. Trains with and without
the term and prints how far the points are from their boxes. Inside the package, a term is a
function in training/losses.py and a line in ``stage1_loss`` or ``stage2_loss``.
"""

import argparse
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from small import small

import caper_jax as caper


def distance_to_boxes(pose: caper.ArticulatedPose, points, labels):
    """Mean distance [] of points [B, N, 3] from the surface of the box of their part, meters."""
    part = jnp.maximum(labels, 0)  # [B, N]; -1 belongs to no part and is left out below
    pick = jax.vmap(lambda rows, index: rows[index])
    rotation, translation = pick(pose.rotation, part), pick(pose.translation, part)
    # In the frame of the box, p = R^T (p_camera - t) - center.
    local = jnp.einsum("bnij,bni->bnj", rotation, points - translation)
    outside = jnp.abs(local - pick(pose.box_center, part)) - pick(pose.size, part) / 2
    beyond = jnp.sqrt(jnp.square(jnp.maximum(outside, 0.0)).sum(-1) + 1e-12)
    within = -jnp.minimum(outside.max(-1), 0.0)
    known = labels >= 0
    return ((beyond + within) * known).sum() / jnp.maximum(known.sum(), 1)


def main(category: str, steps: int, quick: bool) -> None:
    config = caper.preset("fast", category)
    if quick:
        config = small(config, steps)
    definition = caper.categories.get(category)
    objective = caper.Objective(definition, config.network, config.loss)
    stages = replace(config.network.refiner, width=0)
    stages = replace(config.network, refine_steps=0, refiner=stages)  # without corrections

    def with_boxes(weight, params, model_state, batch, key, progress):
        """As ``Objective``: (loss, (new model_state, metrics))."""
        loss, (new_state, metrics) = objective(params, model_state, batch, key, progress)
        variables = {"params": params, **model_state}
        pose = caper.estimate(variables, batch.points, definition, stages).pose
        distance = distance_to_boxes(pose, batch.points, batch.labels)
        return loss + weight * distance, (new_state, {**metrics, "boxes": distance})

    generator = caper.Generator(definition, config.data)
    optimizer = caper.Optimizer("adamw", learning_rate=1e-3)
    variables = objective.init(jax.random.key(0))
    batch_size = config.training.batch_size

    @jax.jit
    def train(weight, state, batches):
        loss_fn = partial(with_boxes, weight)

        def step(state, batch):
            return caper.train_step(state, batch, loss_fn=loss_fn, optimizer=optimizer)

        return jax.lax.scan(step, state, batches)

    draw = [generator.batch(key, batch_size) for key in jax.random.split(jax.random.key(1), steps)]
    batches = jax.tree.map(lambda *rows: jnp.stack(rows), *draw)
    for weight in (0.0, 20.0):
        state = caper.TrainState.create(variables, optimizer, seed=0)
        _, metrics = train(weight, state, batches)
        first, last = 1000 * metrics["boxes"][0], 1000 * metrics["boxes"][-1]
        print(f"weight {weight:g}: points {first:.1f} -> {last:.1f} mm from their boxes")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="box")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--quick", action="store_true", help="small networks")
    main(**vars(parser.parse_args()))
