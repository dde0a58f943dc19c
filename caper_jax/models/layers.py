"""Layers of the networks: Flax's dense layer and batch norm, products, and a maximum over points.

One product is in mixed precision, one frees its input early in the backward pass; the slope of the
maximum is finite everywhere.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Shaped

from caper_jax.errors import CaperError
from caper_jax.models.linear_map import linear_map


def after(done: Shaped[Array, ""], array: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
    """``array``, but not computed before ``done``, a number, is known; NaN unless that is finite.

    XLA keeps no order between what does not depend on each other, and drops barriers on a CPU.
    Meant for gradients, where one that is not finite makes all the others useless.
    """
    return jnp.where(jnp.isfinite(done), array, jnp.nan)


# Units of rounding of the maximum: more than its entries differ by where they are computed twice.
_TIE = 80


@jax.custom_jvp
def max_over_points(features: Float[Array, "B N C"]) -> Float[Array, "B C"]:
    """The maximum over points; entries that reach it share its gradient, as in JAX.

    JAX divides by the number of entries that equal the maximum. Where the compiler computes them
    a second time with other rounding, that is none, and the gradient is NaN.
    """
    return features.max(axis=1)


@max_over_points.defjvp
def _max_over_points_jvp(primals, tangents):
    (features,), (change,) = primals, tangents
    top = features.max(axis=1, keepdims=True)
    tie = _TIE * jnp.finfo(features.dtype).eps
    reached = ~(features < top - tie * jnp.abs(top))  # true of NaN, which is passed on
    count = jnp.maximum(reached.sum(axis=1), 1)
    return top[:, 0], jnp.where(reached, change, 0.0).sum(axis=1) / count


_WIDE = 64  # input channels, from which a product is worth rounding


def mixed_precision_dot(inputs, kernel, dimensions, precision=None):
    """``lax.dot_general``, rounded under ``jax.default_matmul_precision("bfloat16")``.

    JAX leaves that setting to the backend, and a CPU ignores it. Here it rounds the factors of the
    wide layers on any backend. Sums stay float32, and so do the factors of the first layers: they
    are lengths, and would be off by up to 0.4 %.
    """
    chosen = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
    if precision is None and chosen == "bfloat16" and inputs.dtype == jnp.float32:
        if kernel.shape[0] >= _WIDE:
            factors = inputs.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16)
            return lax.dot_general(*factors, dimensions, preferred_element_type=jnp.float32)
        precision = lax.Precision.HIGHEST
    return lax.dot_general(inputs, kernel, dimensions, precision)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def weights_first(inputs, kernel, dimensions, precision=None):
    """``mixed_precision_dot`` of [..., C] and [C, D] that backpropagates to the kernel first.

    The inputs, often the largest arrays of a step, are then gone before the gradient goes on to
    what they were computed from. For ``Dense(dot_general=...)``.
    """
    return mixed_precision_dot(inputs, kernel, dimensions, precision)


@weights_first.defjvp
def _weights_first_jvp(dimensions, precision, primals, tangents):
    def change(factors, changes):
        (inputs, kernel), (d_inputs, d_kernel) = factors, changes
        by_inputs = lax.dot_general(d_inputs, kernel, dimensions, precision)
        return by_inputs + lax.dot_general(inputs, d_kernel, dimensions, precision)

    def transpose(factors, cotangent):
        inputs, kernel = factors
        rows = tuple(range(inputs.ndim - 1))
        # A CPU transposes the first factor, which takes longer than the product: the narrower one.
        wider = inputs.shape[-1] > cotangent.shape[-1]
        pair = (cotangent, inputs) if wider else (inputs, cotangent)
        to_kernel = lax.dot_general(*pair, ((rows, rows), ((), ())), precision)
        to_kernel = to_kernel.T if wider else to_kernel
        last = ((cotangent.ndim - 1,), (1,))
        to_inputs = lax.dot_general(cotangent, kernel, (last, ((), ())), precision)
        return after(to_kernel[0, 0], to_inputs), to_kernel

    value = mixed_precision_dot(primals[0], primals[1], dimensions, precision)
    return value, linear_map(change, transpose, primals, tangents)


class Weights:
    """Mixin, before ``nn.Module`` in the bases: ``param`` runs no initializer for its shape alone.

    Flax traces every weight's initializer again at each use, to compare shapes: a third of the time
    to a first pose. Here the shape, an argument of the initializer, is compared.
    """

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
    """``nn.Dense`` by ``mixed_precision_dot``."""

    dot_general: Any = mixed_precision_dot


def block_init(inputs: int, total: int) -> Any:
    """Initializer of a block of ``inputs`` rows of the kernel of a layer that takes ``total``.

    Blocks of which each were as large as a layer of its own would let a few channels, such as the
    coordinates, speak as loudly as hundreds.
    """
    return nn.initializers.variance_scaling(inputs / total, "fan_in", "truncated_normal")


class BatchNorm(Weights, nn.BatchNorm):
    """``nn.BatchNorm``."""
