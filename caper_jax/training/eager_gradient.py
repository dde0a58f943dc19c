"""Losses whose gradients are computed one after the other, to hold less memory at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

PyTree = Any


def value_with_eager_gradient(
    function: Callable[..., tuple[jax.Array, PyTree]],
) -> Callable[..., Any]:
    """A loss whose gradient, where one is asked for, is computed along with its value.

    Backpropagation through a sum of losses runs once all of them are known, and holds what each
    needs until then. Here its activations are gone once ``done`` is known; see ``layers.after``
    for how to make the next loss wait for it.

    Args:
      function: ``(params, *rest) -> (loss, aux)``; all that depends on anything differentiated
        must come in by an argument.

    Returns:
      ``(params, *rest) -> (loss, aux, done)``. Differentiable once, in reverse mode: the loss with
      respect to ``params``; ``aux`` passes no gradient. ``done`` is a finite number, known when the
      gradient is; NaN or inf if that is not finite, zero where none is asked for.
    """

    @jax.custom_vjp
    def value(params: PyTree, *rest: PyTree):
        loss, aux = function(params, *rest)
        return loss, lax.stop_gradient(aux), jnp.zeros_like(loss)

    def forward(params: PyTree, *rest: PyTree):
        (loss, aux), gradient = jax.value_and_grad(function, has_aux=True)(params, *rest)
        done = sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(gradient))
        return (loss, aux, done), (gradient, [None] * len(rest))

    def backward(residuals: tuple[PyTree, list], cotangents: tuple[jax.Array, PyTree, jax.Array]):
        gradient, no_gradients = residuals
        scaled = jax.tree.map(lambda leaf: cotangents[0] * leaf, gradient)
        return scaled, *no_gradients

    value.defvjp(forward, backward)
    return value
