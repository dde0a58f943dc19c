"""Point clouds of a fixed number of points, from depth images and from files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caper_jax.data.images import read_array
from caper_jax.errors import CaperError
from caper_jax.geometry.raster_order import raster_order

MIN_POINTS = 16
# Lines per side over the object's box: the generator casts its rays on such a grid.
GRID = 96
# Beyond this depth (meters) a cloud is taken for one in millimeters.
FARTHEST_M = 50.0
_ABSURD = 1e6  # no coordinate in any unit: some cameras say "nothing" by the largest float


@dataclass(frozen=True)
class Cloud:
    """Points of a depth image or a cloud: an even pick in scan order, or all in their own order.

    Attributes:
      points: [N, 3] float32 meters, camera frame.
      pixels: [N, 2] int32 (v, u) of every point; [0, 2] when the source is no image.
      index: [N] int64 row of every point in the source (of an image: in raster order).
      available: number of usable points in the source; fewer than N means repeated points.
      dropped: number of points or masked pixels left out: no measurement, or too far away.
    """

    points: np.ndarray
    pixels: np.ndarray
    index: np.ndarray
    available: int
    dropped: int


def systematic_indices(available: int, num_points: int, seed: int | None = None) -> np.ndarray:
    """Evenly spread picks ``floor((i + u) n / N)``: no sort, no repeat unless n < N.

    Args:
      available: n, number of points to pick from, in scan order.
      num_points: N, number of picks.
      seed: draws u from [0, 1); None takes u = 1/2.

    Returns:
      [N] int64 in 0..n-1, ascending; every point is picked floor(N/n) or ceil(N/n) times.
    """
    offset = 0.5 if seed is None else np.random.default_rng(seed).random()
    ranks = (np.arange(num_points) + offset) * available / num_points
    return np.minimum(ranks.astype(np.int64), available - 1)


def _even_pick(points: np.ndarray, num_points: int, seed: int | None) -> np.ndarray:
    """``systematic_indices`` along the scan order of points [n, 3]; along their own if n <= N."""
    picked = systematic_indices(len(points), num_points, seed)
    return picked if len(points) <= num_points else raster_order(points)[picked]


def cloud_from_depth(
    depth: np.ndarray,
    mask: np.ndarray,
    intrinsics: np.ndarray,
    num_points: int = 1024,
    seed: int | None = None,
    radius: float | None = None,
) -> Cloud:
    """Back-projects the masked pixels and picks ``num_points`` of them, evenly.

    Large objects are first thinned to a grid of rows and columns: of all the pixels of an image
    sorting takes longer than the estimate.

    Args:
      depth: [H, W] meters; zero, NaN and infinity are dropped and counted.
      mask: [H, W], nonzero on the object.
      intrinsics: [3, 3] pinhole matrix, pixels.
      num_points: points to return; fewer usable pixels are repeated evenly.
      seed: see ``systematic_indices``.
      radius: meters; when given, points farther than this from the median point are dropped and
        counted (background that leaks through the rim of a mask).

    Returns:
      The cloud, with the pixel of every point.

    Raises:
      CaperError: images of different size, an empty mask, no valid depth under it, or fewer than
        16 usable points.
    """
    depth, mask = np.asarray(depth), np.asarray(mask)
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise CaperError(
            f"depth must be a float image [H, W] in meters, got {depth.dtype} {depth.shape}"
        )
    if mask.shape != depth.shape:
        raise CaperError(
            f"depth is {_size(depth)} but mask is {_size(mask)}; both must come from the same "
            "(aligned) image"
        )
    rows, columns = np.nonzero(mask)
    if not len(rows):
        raise CaperError("the mask is empty; no object to estimate")
    z = depth[rows, columns].astype(np.float32)
    valid = np.isfinite(z) & (z > 0)
    if not valid.any():
        raise CaperError(
            f"none of the {len(rows)} masked pixels has valid depth (all zero or NaN); the object "
            "is too close, too far or reflective, or mask and depth do not belong together"
        )
    rows, columns, z = rows[valid], columns[valid], z[valid]
    points = back_project(rows, columns, z, intrinsics)
    kept = np.arange(len(points)) if radius is None else _near(points, radius)
    _check_count(len(kept), f"of {len(valid)} masked pixels")
    lattice = kept[_on_grid(rows[kept], columns[kept], num_points)]
    picked = lattice[_even_pick(points[lattice], num_points, seed)]
    pixels = np.stack([rows[picked], columns[picked]], axis=-1)
    return Cloud(
        points=points[picked],
        pixels=pixels.astype(np.int32),
        index=pixels @ (depth.shape[1], 1),
        available=len(kept),
        dropped=len(valid) - len(kept),
    )


def _on_grid(rows: np.ndarray, columns: np.ndarray, wanted: int) -> np.ndarray:
    """Indices of the pixels on evenly spread rows and columns: at least ``wanted``, or all."""
    lines = GRID
    while True:
        chosen = np.flatnonzero(_on_lines(rows, lines) & _on_lines(columns, lines))
        if len(chosen) >= min(wanted, len(rows)):
            return chosen
        lines *= 2


def _on_lines(positions: np.ndarray, lines: int) -> np.ndarray:
    """[N] bool: the position is one of ``lines`` evenly spread ones (of all, if fewer)."""
    offsets = positions - positions.min()
    extent = int(offsets.max()) + 1
    used = np.zeros(extent, bool)
    used[((np.arange(lines) + 0.5) * extent / lines).astype(np.int64)] = True
    return used[offsets]


def back_project(
    rows: np.ndarray, columns: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """[..., 3] float32 camera points of pixels (row v, column u) at ``depth``, meters."""
    intrinsics = np.asarray(intrinsics, np.float64)
    if intrinsics.shape != (3, 3):
        raise CaperError(f"intrinsics must be [3, 3], got {intrinsics.shape}")
    x = (columns - intrinsics[0, 2]) / intrinsics[0, 0] * depth
    y = (rows - intrinsics[1, 2]) / intrinsics[1, 1] * depth
    return np.stack([x, y, depth], axis=-1).astype(np.float32)


def is_measured(points: np.ndarray) -> np.ndarray:
    """Which points [..., 3] are any: NaN, infinity, zero and huge numbers stand for none."""
    # Comparisons with NaN are false.
    return (np.abs(points) < _ABSURD).all(-1) & (points != 0).any(-1)


def as_cloud(points, where: str = "points") -> np.ndarray:
    """Points as [N, 3] float32; N may be 0.

    Raises:
      CaperError: another shape, or not numbers.
    """
    try:
        points = np.asarray(points)
    except ValueError as error:
        raise CaperError(f"{where} is no array ({error})") from error
    if points.shape == (0,):
        points = points.reshape(0, 3)
    if points.ndim != 2 or points.shape[-1] != 3:
        raise CaperError(f"{where}: a cloud must be [N, 3], got {points.shape}")
    if points.dtype.kind not in "fiu":
        raise CaperError(f"{where}: a cloud must be numbers in meters, got {points.dtype}")
    with np.errstate(over="ignore"):
        return points.astype(np.float32, copy=False)


def sample_points(
    points: np.ndarray,
    num_points: int = 1024,
    seed: int | None = None,
    radius: float | None = None,
    where: str = "points",
) -> Cloud:
    """Picks ``num_points`` of a raw cloud in any order, evenly over the image.

    Args:
      points: [N, 3] meters, camera frame; rows with NaN or infinity, rows of zeros (no
        measurement in an organized cloud) and points beyond 50 m are dropped and counted.
      num_points: points to return; smaller clouds are repeated evenly.
      seed: see ``systematic_indices``.
      radius: see ``cloud_from_depth``.
      where: the file or argument to name in errors.

    Returns:
      The cloud; ``index`` counts rows of ``points``.

    Raises:
      CaperError: wrong shape or dtype, millimeters, points behind the camera, or fewer than 16
        usable points.
    """
    cast = as_cloud(points, where)
    kept = np.flatnonzero(is_measured(cast))
    _check_count(len(kept), f"of {len(points)} points in {where}")
    median_depth = float(np.median(cast[kept, 2]))
    if abs(median_depth) > FARTHEST_M:
        raise CaperError(
            f"{where}: median depth {median_depth:.4g} m; these seem to be millimeters: "
            "multiply by 0.001"
        )
    if median_depth <= 0:
        raise CaperError(
            f"{where}: median depth {median_depth:.4g} m lies behind the camera; the camera looks "
            "along +z (OpenCV): from an OpenGL frame negate y and z"
        )
    kept = kept[(np.abs(cast[kept]) <= FARTHEST_M).all(-1)]
    _check_count(len(kept), f"of {len(points)} points in {where}")
    if radius is not None:
        kept = kept[_near(cast[kept], radius)]
        _check_count(len(kept), f"of {len(points)} points in {where}")
    index = kept[_even_pick(cast[kept], num_points, seed)]
    return Cloud(
        points=cast[index],
        pixels=np.zeros((0, 2), np.int32),
        index=index,
        available=len(kept),
        dropped=len(points) - len(kept),
    )


def are_sampled(clouds: np.ndarray, num_points: int) -> bool:
    """Whether ``sample_points`` would return each of these clouds [B, N, 3] as it is.

    Asked of all at once, which for many clouds is several times as fast as sampling each.
    """
    if clouds.shape[1] != num_points or clouds.dtype.kind not in "fiu":
        return False
    with np.errstate(over="ignore"):
        cast = clouds.astype(np.float32)
    if not is_measured(cast).all():
        return False
    depth = np.median(cast[..., 2], axis=1)
    return bool((depth > 0).all() and (np.abs(cast) <= FARTHEST_M).all())


def _near(points: np.ndarray, radius: float) -> np.ndarray:
    """Rows within ``radius`` of the median point, which a minority of outliers cannot move."""
    if not radius > 0:
        raise CaperError(f"radius must be positive meters, got {radius}")
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=-1)
    return np.flatnonzero(distance <= radius)


def _check_count(count: int, source: str) -> None:
    if count < MIN_POINTS:
        raise CaperError(
            f"only {count} {source} are usable; at least {MIN_POINTS} points of the object are "
            "needed"
        )


def _size(image: np.ndarray) -> str:
    if image.ndim != 2:
        return f"an array of shape {image.shape}"
    return f"{image.shape[1]} x {image.shape[0]}"


def read_points(path: str | Path) -> np.ndarray:
    """Reads a raw cloud [N, 3] from ``.npy`` or ``.ply`` (ascii or binary), as stored.

    Raises:
      CaperError: missing, broken or truncated file, another format, or no x, y, z.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return read_array(path)
    if suffix != ".ply":
        raise CaperError(f"{path}: a cloud must be .npy or .ply")
    if not path.is_file():
        raise CaperError(f"{path}: no such file")
    return _parse_ply(path, path.read_bytes())


_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _parse_ply(path: Path, content: bytes) -> np.ndarray:
    """[N, 3] float64 vertices; the vertex element must come first and hold no lists."""
    header, separator, body = content.partition(b"end_header")
    lines = header.decode("ascii", errors="replace").splitlines()
    if not lines or lines[0].strip() != "ply" or not separator:
        raise CaperError(f"{path}: not a PLY file (no 'ply' ... 'end_header')")
    body = body[2:] if body.startswith(b"\r\n") else body[1:]
    words = [line.split() for line in lines[1:] if line.split()]
    orders = [word[1] for word in words if word[0] == "format" and len(word) > 1]
    if len(orders) != 1 or orders[0] not in _PLY_ORDERS:
        raise CaperError(f"{path}: PLY format must be one of {', '.join(_PLY_ORDERS)}")
    elements = [i for i, word in enumerate(words) if word[0] == "element"]
    if not elements or words[elements[0]][1:2] != ["vertex"]:
        raise CaperError(f"{path}: the first PLY element must be 'vertex'")
    last = elements[1] if len(elements) > 1 else len(words)
    try:
        count = int(words[elements[0]][2])
        rows = [word for word in words[elements[0] : last] if word[0] == "property"]
        fields = [(name, _PLY_ORDERS[orders[0]] + _PLY_TYPES[kind]) for _, kind, name in rows]
    except (KeyError, ValueError, IndexError) as error:
        raise CaperError(f"{path}: PLY vertices must be scalar properties ({error})") from error
    names = [name for name, _ in fields]
    if not {"x", "y", "z"} <= set(names):
        raise CaperError(f"{path}: PLY vertices lack x, y, z (they have {', '.join(names)})")
    try:
        if orders[0] == "ascii":
            values = np.array(body.split()[: count * len(fields)], np.float64)
            table = dict(zip(names, values.reshape(count, len(fields)).T, strict=True))
        else:
            vertices = np.frombuffer(body, np.dtype(fields), count)
            table = {name: vertices[name] for name in "xyz"}
    except ValueError as error:
        raise CaperError(f"{path}: broken or truncated PLY body ({error})") from error
    return np.stack([np.asarray(table[name], np.float64) for name in "xyz"], axis=-1)
