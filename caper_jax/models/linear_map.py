"""Linear maps with a transpose of their own, for derivatives in both directions.

``jax.custom_vjp`` gives a function a backward pass and takes its forward mode away. The tangent of
a ``jax.custom_jvp`` may be a ``linear_map`` instead: forward mode evaluates the map, reverse mode
the given transpose, from residuals that are chosen here and not by JAX.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

PyTree = Any


def linear_map(
    function: Callable[[PyTree, PyTree], Array],
    transpose: Callable[[PyTree, Array], PyTree],
    residuals: PyTree,
    changes: PyTree,
) -> Array:
    """``function(residuals, changes)``, which reverse mode backpropagates by ``transpose``.

    It batches, and may be differentiated further; derivatives of higher order are JAX's own of
    ``function`` and of ``transpose``.

    Args:
      function: one array, linear in ``changes``.
      transpose: ``(residuals, cotangent of that array) -> cotangents`` of the structure, shapes
        and dtypes of ``changes``.
      residuals: arrays that reverse mode keeps.
      changes: what the map is linear in.

    Returns:
      One array.
    """
    first, first_tree = jax.tree.flatten(residuals)
    second, second_tree = jax.tree.flatten(changes)
    count = len(first)

    def flat_function(*values: Array) -> Array:
        parts = (
            jax.tree.unflatten(first_tree, values[:count]),
            jax.tree.unflatten(second_tree, values[count:]),
        )
        return function(*parts)

    def flat_transpose(*values: Array) -> list[Array]:
        return jax.tree.leaves(transpose(jax.tree.unflatten(first_tree, values[:-1]), values[-1]))

    return _linear_map.bind(
        *first, *second, function=flat_function, transpose=flat_transpose, count=count
    )


_linear_map = Primitive("linear_map")


def _evaluate(*values, function, transpose, count):
    return function(*values)


def _shape(*values, function, transpose, count):
    result = jax.eval_shape(function, *values)
    return jax.core.ShapedArray(result.shape, result.dtype)


def _backpropagate(cotangent, *values, function, transpose, count):
    wanted = [ad.is_undefined_primal(value) for value in values]
    if isinstance(cotangent, ad.Zero):
        return [None] * len(values)
    cotangents = [None] * count + transpose(*values[:count], cotangent)
    return [c if w else None for c, w in zip(cotangents, wanted, strict=True)]


def _differentiate(primals, tangents, **how):
    value, count = _linear_map.bind(*primals, **how), how["count"]
    filled = tuple(ad.instantiate_zeros(tangent) for tangent in tangents)
    if all(isinstance(tangent, ad.Zero) for tangent in tangents[:count]):
        return value, _linear_map.bind(*primals[:count], *filled[count:], **how)
    return value, jax.jvp(how["function"], tuple(primals), filled)[1]


def _batch(values, axes, *, function, transpose, count):
    (size,) = {v.shape[a] for v, a in zip(values, axes, strict=True) if a is not None}
    linear = [
        jnp.broadcast_to(value, (size, *value.shape))
        if axis is None
        else jnp.moveaxis(value, axis, 0)
        for value, axis in zip(values[count:], axes[count:], strict=True)
    ]
    kept = tuple(axes[:count])
    result = _linear_map.bind(
        *values[:count],
        *linear,
        function=jax.vmap(function, in_axes=(*kept, *[0] * len(linear))),
        transpose=jax.vmap(transpose, in_axes=(*kept, 0)),
        count=count,
    )
    return result, 0


_linear_map.def_impl(_evaluate)
_linear_map.def_abstract_eval(_shape)
mlir.register_lowering(_linear_map, mlir.lower_fun(_evaluate, multiple_results=False))
ad.primitive_transposes[_linear_map] = _backpropagate
ad.primitive_jvps[_linear_map] = _differentiate
batching.primitive_batchers[_linear_map] = _batch
