"""The registry of categories; one module per category holds its definition."""

from __future__ import annotations

from caper_jax.articulation.category import Category
from caper_jax.categories.box import BOX
from caper_jax.categories.laptop import LAPTOP
from caper_jax.errors import CaperError, unknown_name

__all__ = ["get", "names", "register"]

_REGISTRY: dict[str, Category] = {}


def register(category: Category) -> Category:
    """Makes a category known under its name, for Python and (once imported) the commands.

    Raises:
      CaperError: another definition already has that name.
    """
    if _REGISTRY.get(category.name, category) is not category:
        raise CaperError(f"category {category.name!r} is already registered; choose another name")
    _REGISTRY[category.name] = category
    return category


def names() -> tuple[str, ...]:
    """The known category names, sorted."""
    return tuple(sorted(_REGISTRY))


def get(name: str) -> Category:
    """The category of that name.

    Raises:
      CaperError: unknown name; the message lists the known ones and the nearest.
    """
    if name not in _REGISTRY:
        raise unknown_name("category", name, _REGISTRY)
    return _REGISTRY[name]


for _category in (BOX, LAPTOP):
    register(_category)
