"""Dense layer and batch norm of Flax, traced without evaluating their initialisers again.

Flax compares every weight with its initialiser's output, traced anew, at each use. That is a third
of the time to a first pose; the shape is an argument of the initialiser, and is compared here.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax.numpy as jnp

from caper_jax.errors import CaperError


class Weights:
    """Before ``nn.Module`` in the bases: ``param`` runs no initialiser for its shape alone."""

    def param(self: Any, name: str, init_fn: Any, *init_args: Any, **options: Any) -> Any:
        """As ``nn.Module.param`` for ``init_fn(key, shape, dtype)``.

        Without a key (``apply`` with "params" mutable and no rngs) weights begin as zeros: under
        ``jax.eval_shape``, that is all it takes to know the shapes of a network.
        """
        shape = tuple(init_args[0])
        if self.has_variable("params", name):
            value: Any = self.get_variable("params", name)
            if jnp.shape(value) != shape:
                raise CaperError(
                    f"{'/'.join((*self.path, name))} has shape {jnp.shape(value)}, the network "
                    f"takes {shape}"
                )
            return value
        if self.is_mutable_collection("params") and not self.has_rng("params"):
            zeros = jnp.zeros(shape)
            self.put_variable("params", name, zeros)
            return zeros
        return nn.Module.param(self, name, init_fn, *init_args, **options)


class Dense(Weights, nn.Dense):
    """``nn.Dense``."""


class BatchNorm(Weights, nn.BatchNorm):
    """``nn.BatchNorm``."""
