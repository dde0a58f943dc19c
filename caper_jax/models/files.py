"""Model directories: float16 weights and a card, written by training and read by the estimator."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from caper_jax.config import from_dict
from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

PyTree = Any
WEIGHTS_FILE = "weights.npz"
CARD_FILE = "model.json"
# Files of their own: fitted anew more often than the networks are trained, a hundredth as large.
FITTED_FILES = {"plausibility": "plausibility.npz", "hypotheses": "hypotheses.npz"}


@dataclass(frozen=True)
class CardFields:
    """What a model card says, where it does; a card may say more.

    Attributes:
      category: the category's own name.
      version: of the package that trained the model.
      run: sections of the ``config.RunConfig``, the network among them.
      steps, samples, training_seconds: length of the training.
      mean_pose: the trivial predictor, see ``training.train.mean_pose``.
      calibration: see ``models.uncertainty``.
      refiner: what the refiner was fitted on.
      plausibility: what the classifier of plausibility was fitted on.
      hypotheses: what the probabilities of readings were fitted on.
      complete: which run it is of, once all that belongs to the model is written.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "ignore"}

    category: str | None = None
    version: str | None = None
    run: dict[str, Any] | None = None
    steps: int | None = None
    samples: int | None = None
    training_seconds: float | None = None
    mean_pose: dict[str, Any] | None = None
    calibration: dict[str, Any] | None = None
    refiner: dict[str, Any] | None = None
    plausibility: dict[str, Any] | None = None
    hypotheses: dict[str, Any] | None = None
    complete: str | None = None


_HALF_TOLERANCE = 1e-3  # relative; float16 itself keeps 5e-4 where it is not subnormal


def write_model(directory: str | Path, variables: PyTree, card: dict[str, Any]) -> None:
    """Write ``weights.npz`` and ``model.json``; each file appears complete or not at all.

    What was fitted to the trained model goes to files of its own, see ``FITTED_FILES``.

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
    directory.mkdir(parents=True, exist_ok=True)
    for file in FITTED_FILES.values():
        (directory / file).unlink(missing_ok=True)  # never beside other weights
    fitted = {
        file: {path: arrays.pop(path) for path in list(arrays) if path.startswith(_prefix(name))}
        for name, file in FITTED_FILES.items()
    }
    write_atomically(directory / WEIGHTS_FILE, _packed(arrays))
    for file, own in fitted.items():
        if own:
            write_atomically(directory / file, _packed(own))
    write_atomically(directory / CARD_FILE, text)


def write_fitted(directory: str | Path, name: str, params: PyTree) -> None:
    """Writes what was fitted to a trained model, in place of an older one.

    Args:
      directory: of the model.
      name: a key of ``FITTED_FILES``.
      params: of its module.

    Raises:
      CaperError: a weight is not finite or not a float.
    """
    variables = {"params": {name: params}}
    arrays = {path: _compact(path, leaf) for path, leaf in flatten(variables).items()}
    write_atomically(Path(directory) / FITTED_FILES[name], _packed(arrays))


def _prefix(name: str) -> str:
    return f"params/{name}/"


def _packed(arrays: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


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
    arrays = _unpacked(Path(directory) / WEIGHTS_FILE)
    for file in FITTED_FILES.values():
        if (Path(directory) / file).is_file():
            arrays |= _unpacked(Path(directory) / file)
    return card, unflatten(arrays, str(directory))


def _unpacked(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file, as float32."""
    try:
        # From memory: np.load leaves the file open where it is damaged.
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except Exception as error:  # numpy, zipfile, zlib and lzma each raise their own
        if "lzma" in str(error):  # by which the shipped weights are compressed
            raise CaperError(
                f"{path}: {error}; this Python was built without liblzma: install that "
                "(liblzma-dev, xz) and build Python again, or use another Python"
            ) from error
        raise CaperError(f"{path} is damaged or not a weights file: {error}") from error
    for name, array in arrays.items():
        if array.dtype not in (np.float16, np.float32):
            raise CaperError(f"{path}: {name!r} is {array.dtype}, expected float16 or float32")
        if not np.isfinite(array).all():
            raise CaperError(f"{path}: {name!r} has values that are not finite")
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def read_card(directory: str | Path) -> dict[str, Any]:
    """The card of a model directory, as it was written.

    Raises:
      CaperError: no model directory, a damaged card, or one with a field of the wrong type.
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
    from_dict(CardFields, card, str(path))
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
    paths = [name.split("/") for name in flat]
    groups = {"/".join(path[:depth]) for path in paths for depth in range(1, len(path))}
    if both := sorted(groups & flat.keys()):
        raise CaperError(f"{where}: {both[0]!r} is both an array and a group of arrays")
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
