"""The gradient of both stages in two pieces, to hold less memory at once.

Backpropagation through the sum of both losses runs once both are known, and holds what each needs
until then. Here stage I is backpropagated, and its activations are gone, before stage II begins.
The numbers are those of ``jax.value_and_grad``, to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from caper_jax.models.layers import after

PyTree = Any


@runtime_checkable
class TwoStageLoss(Protocol):
    """A sum of two losses, each of its own weights, as ``training.objective.Objective`` is."""

    def stage1(
        self, params: PyTree, model_state: PyTree, batch: PyTree, key: jax.Array
    ) -> tuple[jax.Array, PyTree]:
        """(loss, result with the ``points`` that stage II sees), by ``params["root"]``."""

    def stage2(
        self, params: PyTree, model_state: PyTree, result: PyTree, key: jax.Array
    ) -> tuple[jax.Array, PyTree]:
        """(loss, auxiliary results), by ``params["parts"]``."""


def value_and_grad(loss_fn: Callable[..., Any], has_aux: bool = True) -> Callable[..., Any]:
    """Like ``jax.value_and_grad``, one stage after the other where the loss has two.

    Args:
      loss_fn: a ``TwoStageLoss``; for any other loss this is ``jax.value_and_grad``.
      has_aux: as there; a ``TwoStageLoss`` has.
    """
    if not isinstance(loss_fn, TwoStageLoss):
        return jax.value_and_grad(loss_fn, has_aux=has_aux)
    stage1, stage2 = (jax.value_and_grad(f, has_aux=True) for f in (loss_fn.stage1, loss_fn.stage2))

    def gradient(params: PyTree, model_state: PyTree, batch: PyTree, key: jax.Array, progress: Any):
        del progress
        (first, result), root = stage1(params["root"], model_state, batch, key)
        # Known once the gradient is; NaN or inf if that is not finite.
        done = jnp.asarray(sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(root)))
        result = stop_gradient(result)
        result = result.replace(points=after(done, result.points))
        (second, rest), parts = stage2(params["parts"], model_state, result, key)
        return (first + second, rest), {"root": root, "parts": parts}

    return gradient
