"""Pickles of numpy arrays and plain containers, read without running what they name.

A pickle is a program: it may import and call anything, and even numpy's own ``__setstate__`` takes
memory layouts on trust. So a file gets nothing but what ``_Unpickler.find_class`` lists, and arrays
whose dtype, shape and bytes were checked here. An .npz whose array holds objects is a pickle in a
zip file, and is read in the same way.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from caper_jax.errors import CaperError

_KINDS = "biufcSUO"
_MOST_BYTES = 1 << 30
_MOST_VALUES = 10_000_000


def load(path: str | Path) -> Any:
    """Reads a pickle (of any protocol, also from Python 2).

    Args:
      path: the file.

    Returns:
      Its content: numpy arrays and scalars in plain containers.

    Raises:
      CaperError: missing, broken or huge file, or one that holds anything else (named).
    """
    path = Path(path)
    if not path.is_file():
        raise CaperError(f"{path}: no such file")
    if path.stat().st_size > _MOST_BYTES:
        raise CaperError(f"{path}: larger than a pickle of arrays may be, {_MOST_BYTES:,} bytes")
    return _read(path.read_bytes(), str(path))


def load_npz(path: str | Path, key: str) -> Any:
    """Reads one array of an .npz; an array of objects as ``load`` reads pickles.

    Args:
      path: the file.
      key: name of the array.

    Returns:
      The array; for an array of objects without axes (a dictionary that was saved), the object.

    Raises:
      CaperError: missing, broken or huge file, no such array, or objects that are no numpy arrays
        or plain containers (named).
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
            if archive.getinfo(f"{key}.npy").file_size > _MOST_BYTES:
                raise CaperError(f"{where}: larger than {_MOST_BYTES:,} bytes")
            content = io.BytesIO(archive.read(f"{key}.npy"))
        version = np.lib.format.read_magic(content)
        read_header = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read_header(content)
        if not dtype.hasobject:
            content.seek(0)
            return np.lib.format.read_array(content, allow_pickle=False)
    except CaperError:
        raise
    except Exception as error:  # zip, zlib and numpy each have their own
        raise CaperError(f"{where}: broken or no .npz file ({error})") from error
    array = _read(content.read(), where)
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise CaperError(f"{where}: the pickle holds no array of shape {shape}")
    return array[()]


def _read(content: bytes, where: str) -> Any:
    try:
        value = _Unpickler(io.BytesIO(content), encoding="latin1").load()
        _count(value, {})
    except _ForbiddenError as error:
        raise CaperError(
            f"{where}: the pickle asks for {error}, but only numpy arrays and plain containers "
            "are read; do not open this file with other programs unless you trust it"
        ) from error
    except Exception as error:  # a broken pickle fails in any way that Python can
        raise CaperError(f"{where}: broken pickle ({type(error).__name__}: {error})") from error
    return value


class _ForbiddenError(Exception):
    """What a pickle may not ask for."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        place = module.replace("numpy.core.", "numpy._core.").replace("__builtin__", "builtins")
        known = _ALLOWED.get((place, name))
        if known is None:
            raise _ForbiddenError(f"{module}.{name}")
        # A pickle may set attributes of a function, its defaults among them: it gets its own.
        return known if isinstance(known, (type, str)) else _fresh(known)

    def persistent_load(self, pid: Any) -> Any:
        raise _ForbiddenError(f"an object outside the file ({pid!r})")


def _fresh(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *arguments: function(*arguments)


class _Dtype:
    """Stands for numpy.dtype while the pickle runs, of whose state only the byte order is taken."""

    __slots__ = ("_code", "_order")

    def __init__(self, code: str, *_: Any):
        self._code, self._order = str(code), ""

    def __setstate__(self, state: tuple) -> None:
        if state[2] is not None or state[3] is not None:
            raise _ForbiddenError("a numpy dtype with fields or sub-arrays")
        self._order = {"<": "<", ">": ">"}.get(state[1], "")

    def real(self) -> np.dtype:
        dtype = np.dtype(self._order + self._code)
        if dtype.kind not in _KINDS:
            raise _ForbiddenError(f"numpy values of dtype {dtype}")
        return dtype


class _Array(np.ndarray):
    """An array that gets its content as state, once it was checked."""

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, by_column, data = state
        real, data = _checked(dtype, data, shape)
        super().__setstate__((1, tuple(shape), real, bool(by_column), data))  # type: ignore[arg-type]


def _checked(dtype: Any, data: Any, shape: Any) -> tuple[np.dtype, Any]:
    """The dtype and the bytes (of objects, the list) of an array, which fit its shape."""
    if not isinstance(dtype, _Dtype) or not all(type(n) is int and n >= 0 for n in shape):
        raise _ForbiddenError(f"an array of dtype {dtype!r} and shape {shape!r}")
    real, count = dtype.real(), math.prod(shape)
    if isinstance(data, str):  # bytes of Python 2
        data = data.encode("latin1")
    of_objects = real.kind == "O"
    size = count if of_objects else count * real.itemsize
    fits = isinstance(data, list if of_objects else (bytes, bytearray)) and len(data) == size
    if not fits or (count and not real.itemsize):
        raise _ForbiddenError(f"an array of dtype {real} whose data do not fit its shape {shape}")
    return real, data if of_objects else bytes(data)


def _from_bytes(data: Any, dtype: Any, shape: Any, order: str, axis_order: Any = None) -> Any:
    """An array as protocol 5 writes it; "K" is C order of axes that then change places."""
    real, data = _checked(dtype, data, shape)
    array = np.frombuffer(data, real).reshape(shape, order="F" if order == "F" else "C").copy("K")
    return array if axis_order is None else array.transpose(axis_order)


def _scalar(dtype: Any, data: Any = b"") -> Any:
    return np.frombuffer(_checked(dtype, data, (1,))[1], dtype.real())[0]


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """How old protocols write bytes."""
    if encoding not in ("latin1", "latin-1"):
        raise _ForbiddenError(f"text encoded as {encoding!r}")
    return text.encode("latin1")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): "numpy.ndarray",  # named in what calls _reconstruct
    ("numpy._core.multiarray", "_reconstruct"): lambda *_: _Array(0),
    ("numpy._core.multiarray", "scalar"): _scalar,
    ("numpy._core.numeric", "_frombuffer"): _from_bytes,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): dict,  # of which no method can be replaced
    ("builtins", "set"): set,
    ("builtins", "frozenset"): frozenset,
    ("builtins", "complex"): complex,
    ("builtins", "bytes"): lambda: b"",
}


def _count(value: Any, counts: dict[int, float]) -> float:
    """How many values a container holds; whoever goes through too many comes to no end.

    A pickle may name one value often: 20 lists that each hold the last one twice are 134 bytes and
    a million values. ``counts`` has the values that were counted, by identity.
    """
    if isinstance(value, (_Dtype, type)) or callable(value):
        raise _ForbiddenError(f"a bare {getattr(value, '__name__', type(value).__name__)}")
    if isinstance(value, dict):
        inside = [*value.keys(), *value.values()]
    elif isinstance(value, (list, tuple, set, frozenset)):
        inside = list(value)
    elif isinstance(value, np.ndarray) and value.dtype == object:
        inside = value.ravel().tolist()
    else:
        return 1
    if id(value) not in counts:
        counts[id(value)] = math.inf  # of one that holds itself
        counts[id(value)] = 1 + sum(_count(item, counts) for item in inside)
    if counts[id(value)] > _MOST_VALUES:
        raise _ForbiddenError(f"more than {_MOST_VALUES:,} values")
    return counts[id(value)]
