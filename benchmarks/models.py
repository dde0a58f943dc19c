"""Estimators and clouds to measure with: shipped weights, or random ones where none are needed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.config import HSEncoderConfig, NetworkConfig
from caper_jax.estimator import Estimator


def random_estimator(category: Category, network: NetworkConfig) -> Estimator:
    """With the weights that training begins from, and sides that say nothing."""
    import jax

    from caper_jax.config import LossConfig
    from caper_jax.models.refiner import BoxRefiner, num_features
    from caper_jax.training.objective import Objective

    task = Objective(category, network, LossConfig())
    variables = task.init(jax.random.key(0))
    if network.refiner.width:
        module = BoxRefiner(network.refiner.width, category.num_parts)
        features = np.zeros((1, num_features(category.num_parts)), np.float32)
        sides = module.init(jax.random.key(1), features)["params"]
        variables = {**variables, "params": {**variables["params"], "refiner": sides}}
    return Estimator(category, network, variables)


def encoders(
    config: HSEncoderConfig, points: Any
) -> tuple[Any, Callable[[Any], Any], Callable[[Any], Any]]:
    """(weights, ours, the naive formulation): functions of weights that give [B, N, C] features."""
    import jax
    import jax.numpy as jnp

    from benchmarks import naive
    from caper_jax.models.encoders.hs import HSEncoder

    module = HSEncoder(config)
    variables = jax.jit(lambda x: module.init(jax.random.key(0), x, train=False))(points[:1])

    def ours(weights: Any) -> Any:
        levels = module.apply(weights, points, train=False).levels
        return jnp.concatenate([level.at_points(level.features) for level in levels], -1)

    return variables, ours, lambda weights: naive.hs_encoder(weights, points, config)


def clouds(category: Category, batch: int, num_points: int = 1024) -> np.ndarray:
    """Generated clouds [batch, num_points, 3] with Kinect noise, meters."""
    import jax

    from caper_jax.config import GeneratorConfig
    from caper_jax.synthetic.frames import Generator

    config = GeneratorConfig(instances=min(batch, 200), noise=("kinect",), num_points=num_points)
    generator = Generator(category, config, split="test")
    return np.asarray(generator.batch(jax.random.key(0), batch).points)


def chain(parts: int) -> Category:
    """A category of so many equal boxes in a row, each hinged to the one before."""
    import dataclasses

    from caper_jax import categories
    from caper_jax.articulation.category import Joint

    joints: Any = tuple(Joint("revolute", k, (0.0, 1.5)) for k in range(parts - 1))
    return dataclasses.replace(
        categories.get("box"),
        name=f"chain{parts}",
        parts=tuple(f"link{k}" for k in range(parts)),
        joints=joints,
        mean_size=((0.1, 0.1, 0.1),) * parts,
        mean_center=tuple((0.0, 0.0, 0.1 * k) for k in range(parts)),
        symmetries=(),
    )
