"""Checks the shapes and dtypes of arrays against the annotations of the package, in tests alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import or_
from types import UnionType
from typing import Any, Union, get_args, get_origin

from beartype import beartype
from jaxtyping import AbstractArray


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose annotated arrays are checked; all other annotations are mypy's business.

    Arrays may be numpy's where JAX's are annotated, as everywhere in JAX. Not checked are the
    fields of dataclasses: pytrees also hold tracers, shapes, None and whatever ``jax.tree.map``
    makes of their leaves. There, annotations are documentation.
    """
    hints = function.__annotations__
    kept = {name: _of_any_kind(hint) for name, hint in hints.items() if _says_a_shape(hint)}
    if function.__name__ == "__init__" or not kept:
        return function
    function.__annotations__ = kept
    return beartype(function)


def _is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray)


def _says_a_shape(hint: Any) -> bool:
    return _is_array(hint) or any(map(_says_a_shape, get_args(hint)))


def _of_any_kind(hint: Any) -> Any:
    """The hint without the class of its arrays."""
    if _is_array(hint):
        return hint.dtype[Any, hint.dim_str]
    arguments, origin = get_args(hint), get_origin(hint)
    if not arguments or not _says_a_shape(hint):
        return hint
    arguments = tuple(map(_of_any_kind, arguments))
    if origin in (Union, UnionType):
        return reduce(or_, arguments)
    return origin[arguments]
