"""Random weights of both networks."""

from __future__ import annotations

import jax
import numpy as np

from _helpers.tiny import random_like


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def variables_of(module, *arguments):
    streams = {name: jax.random.key(0) for name in ("params", "sample", "dropout")}
    return random_like(jax.eval_shape(lambda *a: module.init(streams, *a, train=False), *arguments))
