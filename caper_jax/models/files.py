"""Model directories: float16 weights and a card, written by training and read by the estimator."""

from __future__ import annotations

import io
import itertools
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

try:
    from lzma import LZMAError

    _METHOD = zipfile.ZIP_LZMA
except ImportError:  # a Python built without liblzma writes what it can read itself
    LZMAError = zlib.error  # type: ignore[assignment,misc]
    _METHOD = zipfile.ZIP_DEFLATED

PyTree = Any
WEIGHTS_FILE = "weights.npz"
CARD_FILE = "model.json"

_HALF_TOLERANCE = 1e-3  # relative; float16 itself keeps 5e-4 where it is not subnormal


def write_model(directory: str | Path, variables: PyTree, card: dict[str, Any]) -> None:
    """Write ``weights.npz`` and ``model.json``; each file appears complete or not at all.

    Leaves are stored as float16, or as float32 where the round trip through float16 loses more
    than 1e-3 relative (overflow, or values near zero such as the variances of batch norm): of any
    value of a vector, of the norm of a kernel.

    Args:
      directory: created if absent; a model in it is replaced.
      variables: nested dicts of float arrays, e.g. ``TrainState.variables``.
      card: what JSON can hold, without NaN.

    Raises:
      CaperError: a weight is not finite or not a float, or the card is not JSON.
    """
    directory = Path(directory)
    arrays = {name: _compact(name, leaf) for name, leaf in flatten(variables).items()}
    text = _card_text(card)
    buffer = io.BytesIO()
    # As np.savez_compressed, and 3 % smaller; np.load reads either.
    with zipfile.ZipFile(buffer, "w", _METHOD) as file:
        for name, array in arrays.items():
            with file.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    directory.mkdir(parents=True, exist_ok=True)
    write_atomically(directory / WEIGHTS_FILE, buffer.getvalue())
    write_atomically(directory / CARD_FILE, text)


def write_card(directory: str | Path, card: dict[str, Any]) -> None:
    """Replaces the card of a model; its weights stay.

    Raises:
      CaperError: the card is not JSON.
    """
    write_atomically(Path(directory) / CARD_FILE, _card_text(card))


def _card_text(card: dict[str, Any]) -> bytes:
    try:
        return json.dumps(card, indent=2, allow_nan=False).encode() + b"\n"
    except (TypeError, ValueError) as error:
        raise CaperError(f"the model card cannot be written as JSON: {error}") from error


def read_model(directory: str | Path) -> tuple[dict[str, Any], PyTree]:
    """Read a model directory.

    Args:
      directory: holds ``weights.npz`` and ``model.json``.

    Returns:
      (card, variables): the card as written, and nested dicts of float32 numpy arrays.

    Raises:
      CaperError: a file is missing, damaged, or holds a weight that is not a finite float; a
        Python without lzma.
    """
    card = read_card(directory)
    path = Path(directory) / WEIGHTS_FILE
    try:
        # From memory: np.load leaves the file open where it is damaged.
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except (
        ValueError,
        TypeError,
        OSError,
        EOFError,
        KeyError,
        NotImplementedError,  # no such compression
        zipfile.BadZipFile,
        zlib.error,
        LZMAError,
    ) as error:
        raise CaperError(f"{path} is damaged or not a weights file: {error}") from error
    except RuntimeError as error:  # zipfile's, for a compression that Python lacks
        raise CaperError(
            f"{path}: {error}; this Python was built without liblzma: install that (liblzma-dev, "
            "xz) and build Python again, or use another Python"
        ) from error
    for name, array in arrays.items():
        if array.dtype not in (np.float16, np.float32):
            raise CaperError(f"{path}: {name!r} is {array.dtype}, expected float16 or float32")
        if not np.isfinite(array).all():
            raise CaperError(f"{path}: {name!r} has values that are not finite")
    return card, unflatten({name: a.astype(np.float32) for name, a in arrays.items()}, str(path))


def read_card(directory: str | Path) -> dict[str, Any]:
    """The card of a model directory.

    Raises:
      CaperError: no model directory, or a card that is damaged.
    """
    directory = Path(directory)
    for name in (CARD_FILE, WEIGHTS_FILE):
        if not (directory / name).is_file():
            raise CaperError(f"{directory} is not a model directory: it has no {name}")
    path = directory / CARD_FILE
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise CaperError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(card, dict):
        raise CaperError(f"{path} must hold a JSON object, got {type(card).__name__}")
    return card


def flatten(variables: PyTree) -> dict[str, Any]:
    """Leaves of nested dicts by "a/b/c" path, sorted."""
    return dict(sorted(flatten_dict(variables, sep="/").items()))


def unflatten(flat: dict[str, Any], where: str = "variables") -> PyTree:
    """Nested dicts from leaves by path.

    Args:
      flat: leaves by "a/b/c" path.
      where: for the error message.

    Raises:
      CaperError: a name is both a leaf and the parent of one.
    """
    for name in flat:
        for parent in itertools.accumulate(name.split("/")[:-1], "{}/{}".format):
            if parent in flat:
                raise CaperError(
                    f"{where}: {parent!r} is both an array and a group: "
                    f"{name!r} lies below another array"
                )
    return unflatten_dict(flat, sep="/")


def _compact(name: str, leaf: Any) -> np.ndarray:
    """A leaf as float16 if that loses little, else as float32."""
    array = np.asarray(jax.device_get(leaf))
    if not np.issubdtype(array.dtype, np.floating) and array.dtype != jax.numpy.bfloat16:
        raise CaperError(f"weight {name!r} is {array.dtype}; only floats can be exported")
    array = array.astype(np.float32)
    if not np.isfinite(array).all():
        raise CaperError(f"weight {name!r} has values that are not finite")
    with np.errstate(over="ignore"):
        half = array.astype(np.float16)
    error, scale = np.abs(half.astype(np.float32) - array), np.abs(array)
    if array.ndim > 1:  # a kernel may lose its tiniest entries, a variance or a bias may not
        error, scale = np.linalg.norm(error), np.linalg.norm(scale)
    return half if np.all(error <= _HALF_TOLERANCE * scale) else array
