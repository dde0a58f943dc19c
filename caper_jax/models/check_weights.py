"""Whether weights are those of the networks that a model card describes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.config import NetworkConfig
from caper_jax.errors import CaperError
from caper_jax.models import hypotheses, plausibility, refiner
from caper_jax.models.files import CARD_FILE, flatten
from caper_jax.models.hypotheses import ReadingScorer
from caper_jax.models.parts import PartsNetwork
from caper_jax.models.plausibility import PlausibilityClassifier
from caper_jax.models.refiner import BoxRefiner
from caper_jax.models.root import RootNetwork


def check_variables(
    directory: Path, variables: dict[str, Any], category: Category, network: NetworkConfig
) -> None:
    """Compares weights with networks, leaf by leaf.

    Args:
      directory: where the weights come from, for the message.
      variables: as ``estimator.estimate`` takes them.
      category: gives the number of parts.
      network: of the model card.

    Raises:
      CaperError: sizes that build no network, or weights of another one.
    """
    points = jax.ShapeDtypeStruct((2, network.num_points, 3), jnp.float32)
    parts = category.num_parts
    modules: dict[str, tuple[nn.Module, Any, dict[str, Any]]] = {
        "root": (RootNetwork(network), points, {"train": False}),
        "parts": (PartsNetwork(network, parts), points, {"train": False}),
    }
    if network.refiner.width:
        features = jax.ShapeDtypeStruct((2, refiner.num_features(parts)), jnp.float32)
        modules["refiner"] = BoxRefiner(network.refiner.width, parts), features, {}
    if "plausibility" in variables.get("params", {}):
        features = jax.ShapeDtypeStruct((2, plausibility.num_features(parts)), jnp.float32)
        modules["plausibility"] = PlausibilityClassifier(), features, {}
    if "hypotheses" in variables.get("params", {}):
        features = jax.ShapeDtypeStruct((2, hypotheses.num_features(parts)), jnp.float32)
        classes = np.zeros(2, np.int32)
        modules["hypotheses"] = ReadingScorer(), features, {"rotation_class": classes}
    collections = ["params", "batch_stats"]
    try:
        # Without a key: drawing random weights takes longer to trace than the networks.
        shapes = {
            name: jax.eval_shape(partial(module.apply, mutable=collections, **options), {}, inputs)[
                1
            ]
            for name, (module, inputs, options) in modules.items()
        }
    except Exception as error:  # sizes that build no network; Flax and JAX raise many kinds
        reason = str(error).strip().splitlines()[0]
        raise CaperError(
            f"{directory / CARD_FILE}: run.network is no network ({reason})"
        ) from error
    wanted = {
        f"{collection}/{name}/{path}": leaf.shape
        for name, variables_of in shapes.items()
        for collection, tree in variables_of.items()
        for path, leaf in flatten(tree).items()
    }
    found = {name: leaf.shape for name, leaf in flatten(variables).items()}
    for name in sorted(wanted.keys() | found.keys()):
        if wanted.get(name) != found.get(name):
            raise CaperError(
                f"{directory}: weights.npz does not fit the network in model.json: {name} is "
                f"{found.get(name, 'absent')} there, {wanted.get(name, 'absent')} in the network"
            )
