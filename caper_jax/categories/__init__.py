"""The registry of categories; one module per category holds its definition.

A category of your own needs no change to this package. Write a module that defines a ``Category``;
tests/_helpers/microwave.py in the repository is a whole one. From Python, pass the object itself
to ``load``, ``load_tracker``, ``Generator`` or ``train``, or ``register`` it once and use its name
like any other. On the command line, spell it ``FILE.py:NAME`` or ``package.module:NAME``::

    caper generate --category microwave.py:MICROWAVE --frames 3 --images --out frames
    caper train --category microwave.py:MICROWAVE --minutes 30 --out runs/microwave
    caper estimate --category microwave.py:MICROWAVE --weights runs/microwave --points cloud.ply

Weights and data files store the category's own name (``microwave``), not how it was spelled.

What a definition settles:

* ``parts`` and ``joints``: the root first, every part after its parent; joint j carries part j + 1.
* ``shape``: a function from a numpy generator to an ``ObjectModel``: solids per part in one common
  frame, meters, y up (or ``viewpoint.up``), in the pose that is called rest, where every state is
  0; joint axes, pivots and limits in the same frame. A positive state opens.
* ``directions``: the two axes of the root's frame that its shape shows best.
* ``viewpoint`` and ``symmetries``: where cameras stand, and which other poses describe the same
  object.
* ``unit``, network units per meter: 2 over the mean diagonal of the whole object.
* ``mean_size`` and ``mean_center``: the means of ``size`` and ``box_center`` of
  ``build_bank(draw_instances(category, 1500, "train", 0))``.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
import zlib
from pathlib import Path
from types import ModuleType

from caper_jax.articulation.category import Category
from caper_jax.categories.box import BOX
from caper_jax.categories.cutter import CUTTER
from caper_jax.categories.dishwasher import DISHWASHER
from caper_jax.categories.drawer import DRAWER
from caper_jax.categories.eyeglasses import EYEGLASSES
from caper_jax.categories.laptop import LAPTOP
from caper_jax.categories.robotarm import ROBOTARM
from caper_jax.categories.scissors import SCISSORS
from caper_jax.categories.stapler import STAPLER
from caper_jax.errors import CaperError, unknown_name

__all__ = ["get", "names", "register", "registered"]

_REGISTRY: dict[str, Category] = {}


def register(category: Category) -> Category:
    """Makes a category known under its name, for the rest of the process.

    Raises:
      CaperError: another definition already has that name, or the definition holds lists or
        arrays where tuples belong (a category is a static argument of jitted functions).
    """
    _check_hashable(category)
    if _REGISTRY.get(category.name, category) is not category:
        raise CaperError(f"category {category.name!r} is already registered; choose another name")
    _REGISTRY[category.name] = category
    return category


def names() -> tuple[str, ...]:
    """The known category names, sorted."""
    return tuple(sorted(_REGISTRY))


def registered(name: str) -> Category:
    """The category registered under that name; never imports anything.

    For names read from files, which must not decide what code runs.

    Raises:
      CaperError: unknown name; the message lists the known ones and the nearest.
    """
    if name not in _REGISTRY:
        raise CaperError(
            f"{unknown_name('category', name, _REGISTRY)}; one of your own is FILE.py:NAME, "
            "package.module:NAME, or registered by caper_jax.register"
        )
    return _REGISTRY[name]


def _check_hashable(category: Category) -> None:
    try:
        hash(category)
    except TypeError as error:
        raise CaperError(
            f"category {category.name!r}: use tuples, not lists or arrays, in it ({error})"
        ) from error


def get(name: str | Category) -> Category:
    """The category of that name, or the one that a user's own module defines.

    Args:
      name: a registered name such as ``box``; or ``FILE.py:NAME`` or ``package.module:NAME``, which
        imports the module and registers its category; or a category itself, which need not be
        registered.

    Raises:
      CaperError: unknown name (the message lists the known ones and the nearest); no such file,
        module or attribute; an attribute that is no Category; an exception while importing; or a
        category whose name is already taken, or that is not hashable.
    """
    if isinstance(name, Category):
        _check_hashable(name)
        return name
    if ":" in name:
        return register(_load(name))
    if name.endswith(".py"):
        raise CaperError(f"category {name!r}: add which one it defines, {name}:NAME")
    return registered(name)


def _load(name: str) -> Category:
    """Imports a user's module, once per process, and takes a category from it; see ``get``."""
    source, _, attribute = name.rpartition(":")
    if not source or not attribute:
        raise CaperError(f"category {name!r}: give FILE.py:NAME or package.module:NAME")
    is_file = source.endswith(".py")
    if is_file and not Path(source).is_file():
        raise CaperError(f"no file {source} to take a category from")
    try:
        module = _from_file(Path(source)) if is_file else importlib.import_module(source)
    except (Exception, SystemExit) as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if not is_file and missing and f"{source}.".startswith(f"{missing}."):
            raise CaperError(
                f"no module {missing!r} to take a category from; install it, set PYTHONPATH, "
                "or give the path of a file that ends in .py"
            ) from error
        trace = traceback.extract_tb(error.__traceback__)
        *_, last = (frame for frame in trace if not frame.filename.startswith("<frozen"))
        # The message of a SyntaxError says the line itself; then the last frame is this one.
        where = f" ({last.filename}, line {last.lineno})" if last.filename != __file__ else ""
        raised = f"importing it raised {type(error).__name__}: {error}{where}"
        raise CaperError(f"{source}: {raised}") from error
    found = getattr(module, attribute, None)
    if isinstance(found, Category):
        return found
    wrong = f"defines no {attribute!r}"
    if hasattr(module, attribute):
        wrong = f"defines {attribute} as {type(found).__name__}, not as a Category"
    others = sorted(key for key, value in vars(module).items() if isinstance(value, Category))
    raise CaperError(f"{source} {wrong} (categories in it: {', '.join(others) or 'none'})")


def _from_file(path: Path) -> ModuleType:
    path = path.resolve()
    # Not the file's own name, which might hide an installed module.
    name = f"caper_jax_user_module_{zlib.crc32(str(path).encode()):08x}"
    if name in sys.modules:
        return sys.modules[name]
    specification = importlib.util.spec_from_file_location(name, path)
    assert specification is not None and specification.loader is not None  # it ends in .py
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    try:
        specification.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


for _category in (BOX, CUTTER, DISHWASHER, DRAWER, EYEGLASSES, LAPTOP, ROBOTARM, SCISSORS, STAPLER):
    register(_category)
