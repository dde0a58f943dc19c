"""Categories defined outside the package, named ``FILE.py:NAME`` or ``package.module:NAME``."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
import zlib
from pathlib import Path
from types import ModuleType

from caper_jax.articulation.category import Category
from caper_jax.errors import CaperError


def load(name: str) -> Category:
    """Imports a user's module, once per process, and takes a category from it.

    Args:
      name: ``FILE.py:NAME``, or ``package.module:NAME`` of a module that Python finds (installed,
        or on PYTHONPATH).

    Raises:
      CaperError: no such file, module or attribute; an attribute that is no Category; an exception
        while importing.
    """
    source, _, attribute = name.rpartition(":")
    if not source or not attribute:
        raise CaperError(f"category {name!r}: give FILE.py:NAME or package.module:NAME")
    module = _from_file(Path(source)) if source.endswith(".py") else _from_name(source)
    found = getattr(module, attribute, None)
    if isinstance(found, Category):
        return found
    wrong = f"defines no {attribute!r}"
    if hasattr(module, attribute):
        wrong = f"defines {attribute} as {type(found).__name__}, not as a Category"
    others = sorted(key for key, value in vars(module).items() if isinstance(value, Category))
    raise CaperError(f"{source} {wrong} (categories in it: {', '.join(others) or 'none'})")


def _from_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise CaperError(f"no file {path} to take a category from")
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
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise _import_error(str(path), error) from error
    return module


def _from_name(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{name}.".startswith(f"{error.name}."):
            raise CaperError(
                f"no module {error.name!r} to take a category from; install it, set PYTHONPATH, "
                "or give the path of a file that ends in .py"
            ) from error
        raise _import_error(name, error) from error
    except (Exception, SystemExit) as error:
        raise _import_error(name, error) from error


def _import_error(source: str, error: BaseException) -> CaperError:
    """What a user's module raised, and where."""
    trace = traceback.extract_tb(error.__traceback__)
    frames = [frame for frame in trace if not frame.filename.startswith("<frozen")]
    where = ""
    # The message of a SyntaxError says the line itself; a file read by us comes after this one.
    if frames[-1].filename != __file__:
        where = f" ({frames[-1].filename}, line {frames[-1].lineno})"
    return CaperError(f"{source}: importing it raised {type(error).__name__}: {error}{where}")
