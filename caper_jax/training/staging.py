"""Losses whose gradients are computed one after the other, to hold less memory at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

PyTree = Any


def gradient_at_once(function: Callable[..., tuple[jax.Array, PyTree]]) -> Callable[..., Any]:
    """A loss whose gradient, where one is asked for, is computed along with its value.

    Backpropagation through a sum of losses runs once all of them are known, and holds what each
    needs until then. Here its activations are gone once ``done`` is known; see ``layers.after``
    for how to make the next loss wait for it.

    Args:
      function: ``(params, *rest) -> (loss, aux)``; all that depends on anything differentiated
        must come in by an argument. Differentiable with respect to ``params`` alone, once.

    Returns:
      ``(params, *rest) -> (loss, aux, done)``; ``done`` is a finite number that is known when the
      gradient is. NaN or inf if a gradient is not finite; zero where no gradient is asked for.
    """

    @jax.custom_vjp
    def value(params: PyTree, *rest: PyTree):
        loss, aux = function(params, *rest)
        return loss, lax.stop_gradient(aux), jnp.zeros_like(loss)

    def forward(params: PyTree, *rest: PyTree):
        (loss, aux), gradient = jax.value_and_grad(function, has_aux=True)(params, *rest)
        done = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(gradient))
        return (loss, aux, done), (gradient, len(rest))

    def backward(residuals: tuple[PyTree, int], cotangents: tuple[jax.Array, PyTree, jax.Array]):
        gradient, others = residuals
        scaled = jax.tree.map(lambda leaf: cotangents[0] * leaf, gradient)
        return scaled, *[None] * others

    value.defvjp(forward, backward)
    return value
