"""The registry of encoders: one of a user's own in both stages, and what it refuses."""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import numpy as np
import pytest
from _helpers.networks import normal, variables_of
from _helpers.tiny import network

import caper_jax
from caper_jax.config import NetworkConfig, from_dict, to_dict
from caper_jax.errors import CaperError
from caper_jax.models.encoders import ENCODERS, Features, Level, register, shared_neighborhoods
from caper_jax.models.parts import PartsNetwork


class PointEncoder(nn.Module):
    """Every point by itself."""

    width: int = 6

    @nn.compact
    def __call__(self, points, train: bool) -> Features:
        return Features(points, (Level(nn.Dense(self.width)(points)),))


@pytest.fixture(autouse=True)
def registry_of_its_own():
    known = dict(ENCODERS)
    yield
    ENCODERS.clear()
    ENCODERS.update(known)


@pytest.mark.parametrize("module", [PointEncoder, partial(PointEncoder, width=5)])
def test_an_encoder_of_ones_own(module):
    caper_jax.encoders.register("mine", module)
    config = network("mine", pool_first=True)
    assert from_dict(NetworkConfig, to_dict(config), "here") == config
    points = normal(2, 64, 3)
    stage = PartsNetwork(config, 2)
    variables = variables_of(stage, points)
    width = variables["params"]["encoder"]["Dense_0"]["kernel"].shape[1]
    assert width == (6 if module is PointEncoder else 5)
    output = stage.apply(variables, points, train=False)
    assert output.segmentation.shape == (2, 64, 2) and np.isfinite(output.size).all()
    assert shared_neighborhoods(config, points) is None


def test_unknown_and_taken_names():
    with pytest.raises(CaperError, match="'hsp'; did you mean 'hs'"):
        shared_neighborhoods(network("hsp"), normal(2, 64, 3))
    register("fast", ENCODERS["fast"])  # the same again does no harm
    for name in ("fast", "rotation"):
        with pytest.raises(CaperError, match=name):
            register(name, PointEncoder)
