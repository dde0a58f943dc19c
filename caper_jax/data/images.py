"""Depth images, masks and camera intrinsics, read strictly and in meters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from PIL import Image, UnidentifiedImageError

from caper_jax.errors import CaperError, describe_problem

_MILLIMETER = 1e-3
# No depth camera sees objects nearer than 2 cm, or resolves one beyond 50 m.
_NEAREST_M, _FARTHEST_M = 0.02, 50.0

Schema = TypeVar("Schema")


def read_depth(path: str | Path, scale: float | None = None) -> Float32[np.ndarray, "H W"]:
    """Reads a depth image.

    Integer images (16-bit PNG, integer ``.npy``) hold millimeters, float images (``.npy``, TIFF)
    meters. An 8-bit color PNG holds the millimeters of ArtImage, ``256 * green + red`` (channels
    1 and 2 in BGR order).

    Args:
      path: the image.
      scale: meters per unit of the file, where the above does not hold.

    Returns:
      [H, W] float32 meters; 0, NaN and infinity mark pixels without a measurement.

    Raises:
      CaperError: missing or broken file, a kind of image that holds no depth (a picture, such as a
        photo), or values that cannot be meters after scaling (the message says which unit they
        seem to be in).
    """
    raw = read_array(path)
    if raw.ndim == 3 and raw.shape[-1] == 3 and raw.dtype == np.uint8:
        _refuse_picture(path, raw)
        raw = 256 * raw[..., 1].astype(np.uint16) + raw[..., 0]
    elif raw.ndim != 2 or raw.dtype == np.uint8 or raw.dtype == bool:
        raise CaperError(
            f"{path}: {raw.dtype} image of shape {raw.shape} holds no depth; give a 16-bit "
            "grayscale PNG in millimeters or a float .npy [H, W] in meters"
        )
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise CaperError(f"depth scale must be a positive number of meters per unit, got {scale}")
    integer = np.issubdtype(raw.dtype, np.integer)
    unit = scale if scale is not None else (_MILLIMETER if integer else 1.0)
    depth = raw.astype(np.float32) * np.float32(unit)
    valid = np.isfinite(depth) & (depth > 0)
    if valid.any():
        _check_range(path, float(np.median(depth[valid])), integer, scale)
    return depth


def _refuse_picture(path: str | Path, raw: np.ndarray) -> None:
    """Refuses colors [H, W, 3] that cannot be millimeters in two channels."""
    gray = np.array_equal(raw[..., 0], raw[..., 1]) and np.array_equal(raw[..., 1], raw[..., 2])
    if _is_jpeg(path):
        sign = "JPEG alters values"
    elif gray and raw.any():  # all black is an image without a measurement
        sign = "its three channels are equal"
    else:
        return
    raise CaperError(
        f"{path}: looks like a picture, not depth ({sign}); give a 16-bit grayscale PNG in "
        "millimeters or a float .npy [H, W] in meters"
    )


def _is_jpeg(path: str | Path) -> bool:
    """Whether a file is a JPEG, whatever its name says."""
    with open(path, "rb") as file:
        return file.read(3) == b"\xff\xd8\xff"


def _check_range(path: str | Path, median: float, integer: bool, scale: float | None) -> None:
    if _NEAREST_M <= median <= _FARTHEST_M:
        return
    if scale is not None:
        advice = f"the depth scale {scale:g} does not fit this file"
    elif integer and median < _NEAREST_M:
        advice = (
            "integers are read as millimeters, these seem to be whole meters or centimeters: "
            "save 16-bit millimeters, or give the depth scale (meters per unit)"
        )
    elif integer:
        advice = (
            "integers are read as millimeters, these are finer or no depth at all: give the depth "
            "scale (meters per unit, e.g. 0.0001)"
        )
    elif median > _FARTHEST_M:
        advice = "floats are read as meters, these seem to be millimeters: give the scale 0.001"
    else:
        advice = "floats are read as meters, these are not: give the depth scale (meters per unit)"
    raise CaperError(f"{path}: median depth would be {median:.3g} m; {advice}")


def read_mask(path: str | Path, allow_empty: bool = False) -> Bool[np.ndarray, "H W"]:
    """Reads the mask of one object: everything that is not black.

    Args:
      path: grayscale, palette or color image (transparent pixels are outside), or ``.npy``. In a
        JPEG, whose black is not quite black, values above 127 count. Black is a color: the number
        that a palette gives it means nothing.
      allow_empty: take a mask without a pixel, of a frame that does not show the object.

    Returns:
      [H, W] bool, true on the object.

    Raises:
      CaperError: missing or broken file, wrong shape, or no pixel in the mask.
    """
    raw = read_array(path, colors=True)
    if raw.ndim not in (2, 3) or (raw.ndim == 3 and raw.shape[-1] not in (2, 3, 4)):
        raise CaperError(f"{path}: a mask must be an image, got an array of shape {raw.shape}")
    threshold = 127 if _is_jpeg(path) else 0
    if raw.ndim == 2:
        mask = np.asarray(raw > threshold)
    elif raw.shape[-1] == 3:
        mask = np.any(raw > threshold, axis=-1)
    else:
        mask = np.any(raw[..., :-1] > threshold, axis=-1) & (raw[..., -1] > 0)
    if not mask.any() and not allow_empty:
        raise CaperError(f"{path}: the mask is empty (all black); no object to estimate")
    return mask


def read_labels(path: str | Path) -> Int32[np.ndarray, "H W"]:
    """Reads an image of labels: one integer per pixel, as stored.

    Args:
      path: grayscale, 16-bit or palette image (the index is the label), a color image whose
        first channel in BGR order holds the label (ArtImage), or an integer ``.npy``.

    Returns:
      [H, W] int32.

    Raises:
      CaperError: missing or broken file, or an image that is not made of integers.
    """
    raw = read_array(path)
    if raw.ndim == 3 and raw.shape[-1] == 3:
        raw = raw[..., 2]
    if raw.ndim != 2 or not np.issubdtype(raw.dtype, np.integer):
        raise CaperError(
            f"{path}: a label image must be [H, W] integers, got {raw.dtype} {raw.shape}"
        )
    return raw.astype(np.int32)


def read_array(path: str | Path, colors: bool = False) -> np.ndarray:
    """Pixels of an image or ``.npy`` file as stored: [H, W] or [H, W, C].

    Palette images give their indices, or with ``colors`` RGBA; one-bit images give booleans.

    Raises:
      CaperError: the file is missing, broken, or would need unpickling.
    """
    path = _file(path)
    try:
        if path.suffix.lower() == ".npy":
            return np.load(path, allow_pickle=False)
        with Image.open(path) as image:
            palette = image.mode in ("P", "PA")
            return np.asarray(image.convert("RGBA") if colors and palette else image)
    except UnidentifiedImageError as error:
        raise CaperError(f"{path}: not an image (PNG, JPEG, TIFF or .npy expected)") from error
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        # Pillow reports a broken PNG chunk as SyntaxError.
        raise CaperError(f"{path}: broken or truncated file ({error})") from error


def _file(path: str | Path) -> Path:
    """The path of a file that exists; CaperError without one."""
    path = Path(path)
    try:
        exists = path.is_file()
    except OSError as error:  # a name that is too long, a folder that may not be entered
        raise CaperError(f"{path}: cannot be read ({error.strerror})") from error
    if not exists:
        raise CaperError(f"{path}: no such file")
    return path


def read_json(path: str | Path) -> Any:
    """The content of a JSON file.

    Raises:
      CaperError: missing file, broken JSON, with line and column, or content beyond what Python
        reads (thousands of brackets in each other, or of digits).
    """
    return read_json_as(path, cast(Any, Any))


def read_json_as(path: str | Path, schema: type[Schema]) -> Schema:
    """The content of a JSON file, checked by pydantic.

    Args:
      path: the file.
      schema: a dataclass, a pydantic model, or another type that pydantic understands.

    Raises:
      CaperError: missing or broken file, or content that does not fit; names file and field.
    """
    from pydantic import ValidationError  # 0.1 s that ``import caper_jax`` spares

    try:
        return _adapter_of(cast(Any, schema)).validate_json(_file(path).read_bytes())
    except OSError as error:
        raise CaperError(f"{path}: cannot be read ({error})") from error
    except ValidationError as error:
        raise CaperError(f"{path}: {describe_problem(error)}") from error


def check_values(schema: type[Schema], values: Any, where: str) -> Schema:
    """Values from outside as a schema.

    Args:
      schema: see ``read_json_as``; no dataclass.
      values: what was read.
      where: file and place in it, which begin the message.

    Raises:
      CaperError: names the first field that does not fit, and why.
    """
    from pydantic import ValidationError

    try:
        return _adapter_of(cast(Any, schema)).validate_python(values)
    except ValidationError as error:
        raise CaperError(f"{where}: {describe_problem(error)}") from error


@cache
def _adapter_of(schema: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(schema)


@dataclass(frozen=True)
class _Camera:
    """The ways in which files give a pinhole camera; pixels."""

    __pydantic_config__ = {"strict": True, "allow_inf_nan": False}  # noqa: RUF012

    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    intrinsic_matrix: list[float | list[float]] | None = None
    K: list[float | list[float]] | None = None
    camera_matrix: list[float | list[float]] | None = None
    width: int | None = None
    height: int | None = None


def read_intrinsics(
    path: str | Path, image_shape: tuple[int, int] | None = None
) -> Float64[np.ndarray, "3 3"]:
    """Reads the camera matrix of a pinhole camera.

    Args:
      path: JSON, one of: Open3D's ``{"width", "height", "intrinsic_matrix": 9 numbers, column by
        column}``; ``{"fx", "fy", "cx", "cy"}``; ``{"K": 3x3 or 9 numbers, row by row}``, or the
        same under ``"camera_matrix"``.
      image_shape: (H, W) of the image it belongs to, checked against ``width`` and ``height``
        where the file states them.

    Returns:
      [3, 3] ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``, pixels.

    Raises:
      CaperError: missing or broken file, none of these layouts, a transposed matrix, focal lengths
        that are not positive, or another image size.
    """
    camera = read_json_as(path, _Camera)
    numbers = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    missing = [name for name, value in numbers.items() if value is None]
    given = [key for key in ("intrinsic_matrix", "K", "camera_matrix") if getattr(camera, key)]
    if given:
        key = given[0]
        matrix = _matrix(path, key, getattr(camera, key))
        if key == "intrinsic_matrix":
            matrix = matrix.T
    elif not missing:
        key = "fx, fy, cx, cy"
        matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], float)
    elif len(missing) < len(numbers):
        raise CaperError(f"{path}: lacks {', '.join(missing)} of fx, fy, cx, cy")
    else:
        raise CaperError(
            f"{path}: no camera matrix; expected fx, fy, cx, cy, or intrinsic_matrix, K or "
            "camera_matrix"
        )
    _check_matrix(path, key, matrix)
    stated = camera.width, camera.height
    if image_shape is not None and None not in stated and stated != image_shape[::-1]:
        height, width = image_shape
        raise CaperError(
            f"{path}: made for {stated[0]} x {stated[1]} images, this one is {width} x {height}; "
            "scale fx, fy, cx, cy, or give the right file"
        )
    return matrix


def _matrix(path: str | Path, key: str, value: list[Any]) -> np.ndarray:
    """[3, 3] from 9 numbers or 3 rows."""
    if [np.size(row) for row in value] not in ([1] * 9, [3] * 3):
        raise CaperError(f"{path}: {key} must be 9 numbers or 3 rows of 3, got {value!r:.60}")
    return np.array(value, np.float64).reshape(3, 3)


def _check_matrix(path: str | Path, key: str, matrix: np.ndarray) -> None:
    if not np.array_equal(matrix[2], [0, 0, 1]):
        if np.array_equal(matrix[:, 2], [0, 0, 1]):
            order = "column by column" if key == "intrinsic_matrix" else "row by row"
            raise CaperError(f"{path}: {key} is transposed; it must be given {order}")
        raise CaperError(f"{path}: last row of {key} must be 0 0 1, got {matrix[2].tolist()}")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise CaperError(
            f"{path}: focal lengths must be positive pixels, got {matrix[0, 0]:g} and "
            f"{matrix[1, 1]:g}"
        )
    if matrix[1, 0] != 0 or abs(matrix[0, 1]) > 1e-6 * matrix[0, 0]:
        raise CaperError(f"{path}: {key} has skew; rectify the images first")
