"""Encoders: what turns a cloud into features for the heads (paper Sec 5.1.1).

An encoder is a Flax module that is called as ``encoder(points, train) -> Features``, with points
[B, N, 3] in network units. To add one of your own::

    caper_jax.encoders.register("mine", MyEncoder)   # then NetworkConfig(encoder="mine")

It is built as ``MyEncoder(name="encoder")``: its sizes are the defaults of its fields, or those of
``functools.partial(MyEncoder, width=64)``. An encoder whose name is also a section of
``NetworkConfig`` gets that section first, as the two of the package do.

One that searches neighbors may have a method ``neighborhoods(points)``. Both stages then share its
result in evaluation, where it is called once and passed as a third argument.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn

from caper_jax.config import NetworkConfig
from caper_jax.errors import CaperError, unknown_name
from caper_jax.models.encoders.fast import FastEncoder
from caper_jax.models.encoders.features import Features, Level
from caper_jax.models.encoders.hs import HSEncoder

__all__ = ["ENCODERS", "Features", "Level", "encode", "make_encoder", "register"]

ENCODERS: dict[str, Callable[..., nn.Module]] = {"hs": HSEncoder, "fast": FastEncoder}


def register(name: str, module: Callable[..., nn.Module]) -> None:
    """Makes an encoder known under a name, for the rest of the process.

    Args:
      name: what ``NetworkConfig.encoder`` then may be.
      module: a Flax module class, or anything that gives such a module when called with its
        ``name``.

    Raises:
      CaperError: another encoder, or a setting of ``NetworkConfig``, already has that name.
    """
    if ENCODERS.get(name, module) is not module or hasattr(NetworkConfig, name):
        raise CaperError(f"the name {name!r} of an encoder is taken; choose another one")
    ENCODERS[name] = module


def make_encoder(config: NetworkConfig) -> Any:
    """The encoder that a config names, for use within a network.

    Raises:
      CaperError: an unknown name; the message lists the known ones.
    """
    if config.encoder not in ENCODERS:
        raise unknown_name("network.encoder", config.encoder, ENCODERS)
    sizes = getattr(config, config.encoder, None)
    module = ENCODERS[config.encoder]
    return module(name="encoder") if sizes is None else module(sizes, name="encoder")


def shared_neighborhoods(config: NetworkConfig, points) -> Any:
    """What both stages may use in evaluation: neighbors do not change with the pose.

    Args:
      config: sizes.
      points: [B, N, 3] the cloud, in any pose, network units.

    Returns:
      None for an encoder that searches no neighbors.
    """
    search = getattr(make_encoder(config), "neighborhoods", None)
    return None if search is None else search(points - points.mean(axis=1, keepdims=True))


def encode(config: NetworkConfig, points, train: bool, space: Any = None) -> Features:
    """Features of points [B, N, 3]; ``space`` is what ``shared_neighborhoods`` gave."""
    encoder = make_encoder(config)
    features: Features = encoder(points, train, *(() if space is None else (space,)))
    return features
