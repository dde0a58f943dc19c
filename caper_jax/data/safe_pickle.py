"""Pickles of numpy arrays and plain containers, read without running what they name.

A pickle is a program: it may import and call anything, and even numpy's own ``__setstate__`` takes
memory layouts on trust. So nothing that a file names is imported here. Arrays, scalars and dtypes
are rebuilt from their bytes by this module; beside them only dictionaries, lists, tuples, sets,
text, bytes and numbers are read. An .npz whose array holds objects is a pickle in a zip file, and
is read in the same way.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from caper_jax.errors import CaperError

_NUMBERS = "biufc"
_TEXTS = "SU"
_MOST_VALUES = 10_000_000


def load(path: str | Path) -> Any:
    """Reads a pickle (of any protocol, also from Python 2).

    Args:
      path: the file.

    Returns:
      Its content: numpy arrays and scalars in plain containers.

    Raises:
      CaperError: missing or broken file, or one that holds anything else (named).
    """
    path = Path(path)
    if not path.is_file():
        raise CaperError(f"{path}: no such file")
    with path.open("rb") as file:
        return _read(file, _Unpickler, str(path))


def load_npz(path: str | Path, key: str) -> Any:
    """Reads one array of an .npz; an array of objects through the restricted unpickler.

    Args:
      path: the file.
      key: name of the array.

    Returns:
      The array; for an array of objects without axes (a dictionary that was saved), the object.

    Raises:
      CaperError: missing or broken file, no such array, or objects that are no numpy arrays or
        plain containers (named).
    """
    path = Path(path)
    if not path.is_file():
        raise CaperError(f"{path}: no such file")
    where = f"{path}, {key!r}"
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            if key not in names:
                raise CaperError(f"{path}: lacks {key!r}, it holds {', '.join(names) or 'nothing'}")
            content = io.BytesIO(archive.read(f"{key}.npy"))
        version = np.lib.format.read_magic(content)
        if version == (1, 0):
            header = np.lib.format.read_array_header_1_0(content)
        else:
            header = np.lib.format.read_array_header_2_0(content)
        if not header[2].hasobject:
            content.seek(0)
            return np.lib.format.read_array(content, allow_pickle=False)
    except CaperError:
        raise
    except Exception as error:  # zip, zlib and numpy each have their own
        raise CaperError(f"{where}: broken or no .npz file ({error})") from error
    array = _read(content, _ObjectsUnpickler, where)
    if not isinstance(array, np.ndarray) or array.shape != header[0]:
        raise CaperError(f"{where}: the pickle holds no array of shape {header[0]}")
    return array[()]


def _read(file: IO[bytes], unpickler: type[_Unpickler], where: str) -> Any:
    try:
        return _plain(unpickler(file, encoding="latin1").load(), {})[0]
    except _ForbiddenError as error:
        raise CaperError(
            f"{where}: the pickle asks for {error}, but only numpy arrays and plain containers "
            "are read; do not open this file with other programs unless you trust it"
        ) from error
    except Exception as error:  # a broken pickle fails in any way that Python can
        raise CaperError(f"{where}: broken pickle ({type(error).__name__}: {error})") from error


class _ForbiddenError(Exception):
    """What a pickle may not ask for."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        place = module.replace("numpy.core.", "numpy._core.")
        if (place, name) not in _KNOWN:
            raise _ForbiddenError(f"{module}.{name}")
        return self._replacement(place, name)

    def _replacement(self, module: str, name: str) -> Any:
        return _KNOWN[module, name]

    def persistent_load(self, pid: Any) -> Any:
        raise _ForbiddenError(f"an object outside the file ({pid!r})")


class _ObjectsUnpickler(_Unpickler):
    """Also reads arrays of objects, which themselves must be what is read."""

    def _replacement(self, module: str, name: str) -> Any:
        return _ObjectArray if name == "ndarray" else super()._replacement(module, name)


class _Dtype:
    """Stands for numpy.dtype while the pickle runs: a kind, a width and a byte order."""

    def __init__(self, code: str, align: bool = False, copy: bool = True):
        self.code, self.order = code, "|"

    def __setstate__(self, state: tuple) -> None:
        _, self.order, base, names = state[:4]
        if base is not None or names is not None:
            raise _ForbiddenError("a numpy dtype with fields or sub-arrays")

    def real(self) -> np.dtype:
        dtype = np.dtype(self.order.replace("=", "").replace("|", "") + self.code)
        if dtype.kind not in _NUMBERS + _TEXTS:
            raise _ForbiddenError(f"numpy values of dtype {dtype}")
        return dtype


class _Array:
    """Stands for an array while the pickle runs; the shape and data come as its state."""

    def __init__(self) -> None:
        self.value = np.zeros(0)

    def __setstate__(self, state: tuple) -> None:
        _, shape, dtype, by_column, data = state
        self.value = _from_bytes(data, dtype, shape, "F" if by_column else "C")


class _ObjectArray(_Array):
    """An array whose data may be a list of objects."""

    def __setstate__(self, state: tuple) -> None:
        _, shape, dtype, by_column, data = state
        if not (isinstance(dtype, _Dtype) and dtype.code in ("O", "O8") and isinstance(data, list)):
            super().__setstate__(state)
            return
        flat = np.empty(len(data), object)
        for index, item in enumerate(data):
            flat[index] = item
        self.value = flat.reshape(shape, order="F" if by_column else "C")


def _from_bytes(
    data: Any, dtype: Any, shape: Any, order: str, axis_order: Any = None
) -> np.ndarray:
    """An array from its bytes.

    Args:
      data: the bytes.
      dtype: a ``_Dtype``.
      shape: of the bytes.
      order: "C", "F", or "K" for bytes in C order whose axes then change places.
      axis_order: which axis of the bytes becomes which of the array; with "K" alone.
    """
    if not isinstance(dtype, _Dtype):
        raise _ForbiddenError(f"an array of dtype {dtype!r}")
    if isinstance(data, str):  # bytes of Python 2
        data = data.encode("latin1")
    if not isinstance(data, (bytes, bytearray)):
        raise _ForbiddenError("an array of Python objects")
    flat = np.frombuffer(data, dtype.real())
    if order == "K" and axis_order is not None:
        return flat.reshape(shape).transpose(axis_order).copy()
    return flat.reshape(shape, order=order).copy()  # type: ignore[call-overload]


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    return _ObjectArray() if kind is _ObjectArray else _Array()


def _scalar(dtype: Any, data: Any = b"") -> Any:
    return _from_bytes(data, dtype, (), "C")[()]


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """How old protocols write bytes."""
    if encoding not in ("latin1", "latin-1"):
        raise _ForbiddenError(f"text encoded as {encoding!r}")
    return text.encode("latin1")


def _empty() -> bytes:
    return b""


class _Function:
    """Calls a function of this module, and lets a pickle set nothing in it.

    Functions have attributes, ``__defaults__`` among them, that a pickle could change for all files
    that are read later.
    """

    __slots__ = ("_function",)
    _function: Callable[..., Any]

    def __init__(self, function: Callable[..., Any]):
        object.__setattr__(self, "_function", function)

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setattr__(self, name: str, value: Any) -> None:
        raise _ForbiddenError(f"a change of {self._function.__name__}")

    def __setstate__(self, state: Any) -> None:
        raise _ForbiddenError(f"a change of {self._function.__name__}")


_KNOWN: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    ("numpy._core.multiarray", "_reconstruct"): _Function(_reconstruct),
    ("numpy._core.multiarray", "scalar"): _Function(_scalar),
    ("numpy._core.numeric", "_frombuffer"): _Function(_from_bytes),
    ("_codecs", "encode"): _Function(_encode),
    ("collections", "OrderedDict"): OrderedDict,
    **{
        (module, name): kind
        for module in ("builtins", "__builtin__")
        for name, kind in (
            ("set", set),
            ("frozenset", frozenset),
            ("complex", complex),
            ("bytes", _Function(_empty)),
        )
    },
}


# What was rebuilt, by the identity of the value: the value itself (kept, or another could get its
# identity), what came of it, and how many values that holds.
_Done = dict[int, tuple[Any, Any, int]]


def _plain(value: Any, done: _Done) -> tuple[Any, int]:
    """The value with its arrays in place of what stood for them, and how many values it holds.

    A value that a pickle names often is rebuilt once: 20 lists that each hold the last one twice
    are 134 bytes and a million values.
    """
    if not isinstance(value, (_Array, dict, list, tuple, set, frozenset)):
        if isinstance(value, (_Dtype, type)) or callable(value):
            raise _ForbiddenError(f"a bare {getattr(value, '__name__', type(value).__name__)}")
        return value, 1
    if id(value) not in done:
        done[id(value)] = value, *_rebuilt(value, done)
    _, plain, count = done[id(value)]
    if count > _MOST_VALUES:  # whoever goes through them would not come to an end
        raise _ForbiddenError(f"more than {_MOST_VALUES:,} values")
    return plain, count


def _rebuilt(value: Any, done: _Done) -> tuple[Any, int]:
    """A container or an array, see ``_plain``."""
    if isinstance(value, _Array):
        count = 1
        if value.value.dtype == object:
            for index in np.ndindex(value.value.shape):
                value.value[index], more = _plain(value.value[index], done)
                count += more
        return value.value, count
    if isinstance(value, dict):
        pairs = [(_plain(key, done), _plain(item, done)) for key, item in value.items()]
        count = 1 + sum(key[1] + item[1] for key, item in pairs)
        return {key[0]: item[0] for key, item in pairs}, count
    items = [_plain(item, done) for item in value]
    return type(value)(item for item, _ in items), 1 + sum(count for _, count in items)
