"""Fits small networks to data that stay on the device: AdamW, many steps in one call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import optax
from jaxtyping import Array, PRNGKeyArray

from caper_jax.progress import progress

PyTree = Any


def minimize(
    loss: Callable[[PyTree, PyTree, PRNGKeyArray], Array],
    params: PyTree,
    data: PyTree,
    key: PRNGKeyArray,
    *,
    calls: int,
    per_call: int,
    rate: float,
    decay: float,
    title: str,
) -> PyTree:
    """Parameters after ``calls`` times ``per_call`` steps of AdamW with a cosine schedule.

    Args:
      loss: (params, data, key of the step) -> []; draws its own samples.
      params: to begin with.
      data: arrays, handed to the loss.
      key: of all steps.
      calls: of the compiled function.
      per_call: steps in each.
      rate, decay: learning rate at the beginning, weight decay.
      title: of the progress display.
    """
    optimizer = optax.adamw(optax.cosine_decay_schedule(rate, calls * per_call), weight_decay=decay)

    @jax.jit
    def several(carry, keys, data):
        def one(carry, key):
            params, state = carry
            value, gradient = jax.value_and_grad(loss)(params, data, key)
            update, state = optimizer.update(gradient, state, params)
            return (optax.apply_updates(params, update), state), value

        return jax.lax.scan(one, carry, keys)

    data = jax.device_put(data)
    carry = params, optimizer.init(params)
    with progress(title, total=calls * per_call) as bar:
        for number in range(calls):
            keys = jax.random.split(jax.random.fold_in(key, number), per_call)
            carry, values = several(carry, keys, data)
            bar.update(per_call, loss=float(values.mean()))
    return carry[0]
