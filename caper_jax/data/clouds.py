"""Point clouds of a fixed number of points, from depth images and files; masks from boxes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

from caper_jax.arrays import checked_array
from caper_jax.data.images import read_array
from caper_jax.errors import CaperError
from caper_jax.geometry.raster_order import raster_order

MIN_POINTS = 48  # different ones: with fewer, poses are off by tens of degrees
# Lines per side over the object's box: the generator casts its rays on such a grid.
GRID = 96
# Beyond this depth (meters) a cloud is taken for one in millimeters.
FARTHEST_M = 50.0
_MIXING = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
_ABSURD = 1e6  # no coordinate in any unit: some cameras say "nothing" by the largest float
# A mask from a box: error of a stereo camera, which grows with z^2: 2 mm at 0.7 m, as measured on a
# table; how many times that something must stand over the plane; the rim, relative to the box, in
# which the plane shows; and what RANSAC draws.
_NOISE_M, _NOISE_PER_M = 0.001, 0.002
_HEIGHT = 3
_RIM = 0.35
_HYPOTHESES = 256
_SAMPLES = 3000
_REFINEMENTS = 3


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

    points: Float32[np.ndarray, "N 3"]
    pixels: Int32[np.ndarray, "M 2"]
    index: Int64[np.ndarray, " N"]
    available: int
    dropped: int


def systematic_indices(
    available: int, num_points: int, seed: int | None = None
) -> Int64[np.ndarray, " N"]:
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
        48 usable points.
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
) -> Float32[np.ndarray, "*batch 3"]:
    """[..., 3] float32 camera points of pixels (row v, column u) at ``depth``, meters."""
    intrinsics = checked_array("intrinsics", intrinsics, (3, 3)).astype(np.float64)
    x = (columns - intrinsics[0, 2]) / intrinsics[0, 0] * depth
    y = (rows - intrinsics[1, 2]) / intrinsics[1, 1] * depth
    return np.stack([x, y, depth], axis=-1).astype(np.float32)


def is_measured(points: np.ndarray) -> Bool[np.ndarray, "*batch"]:
    """Which points [..., 3] are any: NaN, infinity, zero and huge numbers stand for none."""
    # Comparisons with NaN are false.
    some = points != 0
    return _all_within(points, _ABSURD, strictly=True) & (
        some[..., 0] | some[..., 1] | some[..., 2]
    )


def _all_within(points: np.ndarray, reach: float, strictly: bool = False) -> np.ndarray:
    """Which points [..., 3] have no coordinate beyond ``reach``, nor NaN."""
    size = np.abs(points)
    inside = size < reach if strictly else size <= reach
    # Reductions over an axis of three take several times as long.
    return inside[..., 0] & inside[..., 1] & inside[..., 2]


def as_cloud(points: Any, where: str = "points") -> Float32[np.ndarray, "N 3"]:
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
      CaperError: wrong shape or dtype, millimeters, points behind the camera, or fewer than 48
        usable points that differ.
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
    kept = kept[_all_within(cast, FARTHEST_M)[kept]]
    _check_count(len(kept), f"of {len(points)} points in {where}")
    if radius is not None:
        kept = kept[_near(cast[kept], radius)]
        _check_count(len(kept), f"of {len(points)} points in {where}")
    index = kept[_even_pick(cast[kept], num_points, seed)]
    distinct = int(count_distinct(cast[index][None])[0])
    if distinct < min(MIN_POINTS, num_points):
        raise CaperError(too_few_points(distinct, len(kept), where))
    return Cloud(
        points=cast[index],
        pixels=np.zeros((0, 2), np.int32),
        index=index,
        available=len(kept),
        dropped=len(points) - len(kept),
    )


def count_distinct(clouds: Float32[np.ndarray, "B N 3"]) -> Int64[np.ndarray, " B"]:
    """How many different points each cloud has."""
    words = np.ascontiguousarray(clouds + np.float32(0)).view(np.uint32).astype(np.uint64)
    # One number per point, equal by chance once in 2^64: sorting rows takes ten times as long.
    keys = np.sort((words * _MIXING).sum(-1, dtype=np.uint64), axis=-1)
    return (keys[:, 1:] != keys[:, :-1]).sum(-1) + 1


def shows_object(points: Float32[np.ndarray, "N 3"], least: int = MIN_POINTS) -> bool:
    """Whether at least so many points are measured and differ."""
    # The first mostly tell: of a large cloud counting all takes milliseconds.
    for some in (points[: 4 * least], points):
        measured = some[is_measured(some)]
        if len(measured) >= least and count_distinct(measured[None])[0] >= least:
            return True
    return False


def too_few_points(distinct: int, count: int, where: str) -> str:
    """What to say of a cloud with so few different ones among so many usable points."""
    if distinct == 1 < count:
        return f"all {count} usable points of {where} are the same point; that is no object"
    return (
        f"only {distinct} of {count} usable points in {where} differ; at least {MIN_POINTS} "
        "different points of the object are needed"
    )


def are_sampled(clouds: np.ndarray, num_points: int) -> bool:
    """Whether ``sample_points`` would return each of these clouds [B, N, 3] as it is.

    For many clouds at once several times as fast as sampling each.
    """
    if clouds.shape[1] != num_points or clouds.dtype.kind not in "fiu":
        return False
    with np.errstate(over="ignore"):
        cast = clouds.astype(np.float32)
    if not is_measured(cast).all():
        return False
    depth = np.median(cast[..., 2], axis=1)
    if not ((depth > 0).all() and (np.abs(cast) <= FARTHEST_M).all()):
        return False
    return bool((count_distinct(cast) >= min(MIN_POINTS, num_points)).all())


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
    from trimesh.exchange.ply import load_ply  # 0.2 s that ``import caper_jax`` spares

    try:
        with path.open("rb") as file:
            content = load_ply(file, fix_texture=False, skip_materials=True)
        return np.asarray(content["vertices"], np.float64)
    except Exception as error:  # of damage, trimesh makes whatever it stumbles over
        raise CaperError(
            f"{path}: cannot be read as a PLY file with x, y, z ({type(error).__name__}: {error})"
        ) from error


def mask_from_box(
    depth: np.ndarray,
    intrinsics: np.ndarray,
    box: tuple[float, float, float, float],
    seed: int = 0,
) -> Bool[np.ndarray, "H W"]:
    """Segments the object in a 2D box by taking away the plane that it stands on.

    The plane is the one with the most points in and around the box and the fewest behind it
    (RANSAC, then least squares): a table has nothing below it, the lid of a box does. What stands
    above it inside the box, in the largest connected piece near the center, is the object.

    Args:
      depth: [H, W] meters; 0, NaN and infinity are unknown.
      intrinsics: [3, 3] pixels.
      box: (x1, y1, x2, y2) pixels, x to the right: x1 <= u < x2 and y1 <= v < y2. What sticks out
        of the image is cut off.
      seed: of the random hypotheses.

    Returns:
      [H, W] bool.

    Raises:
      CaperError: an empty box, too little depth in it, no plane around it, or nothing
        that stands on it.
    """
    from scipy import ndimage  # 0.1 s that ``import caper_jax`` spares

    depth = np.asarray(depth)
    height, width = depth.shape
    if not np.isfinite(box).all():
        raise CaperError(f"box must be four numbers x1,y1,x2,y2, got {box}")
    x1, x2 = (min(max(round(value), 0), width) for value in (box[0], box[2]))
    y1, y2 = (min(max(round(value), 0), height) for value in (box[1], box[3]))
    if x1 >= x2 or y1 >= y2:
        raise CaperError(
            f"box {box[0]:g},{box[1]:g},{box[2]:g},{box[3]:g} (x1,y1,x2,y2) is empty in the "
            f"{width} x {height} image"
        )
    margin_x, margin_y = round(_RIM * (x2 - x1)), round(_RIM * (y2 - y1))
    top, left = max(y1 - margin_y, 0), max(x1 - margin_x, 0)
    crop = depth[top : y2 + margin_y, left : x2 + margin_x]
    rows, columns = np.indices(crop.shape)
    valid = np.isfinite(crop) & (crop > 0)
    inside = (rows + top >= y1) & (rows + top < y2) & (columns + left >= x1) & (columns + left < x2)
    for region, name in ((inside, "inside"), (~inside, "around")):
        if np.count_nonzero(valid & region) < MIN_POINTS:
            raise CaperError(
                f"almost no valid depth {name} the box {x1},{y1},{x2},{y2}; give a mask instead"
            )
    points = back_project(rows + top, columns + left, np.where(valid, crop, 0.0), intrinsics)

    normal, offset = fit_support_plane(points[valid], seed)
    height_above = points @ normal + offset
    standing = valid & inside & (height_above > _HEIGHT * _noise(points[..., 2]))
    # Shiny surfaces have holes in their depth; what they cut apart still belongs together.
    pieces, _ = ndimage.label(standing | (inside & ~valid))
    middle = ((y1 + y2 - 1) / 2 - top, (x1 + x2 - 1) / 2 - left)
    piece = _central_piece(standing, pieces, middle, ((y2 - y1) / 2, (x2 - x1) / 2))
    if np.count_nonzero(piece) < MIN_POINTS:
        raise CaperError(
            f"nothing stands above the supporting plane in the box {x1},{y1},{x2},{y2}; "
            "give a mask instead"
        )
    mask = np.zeros(depth.shape, bool)
    mask[top : top + crop.shape[0], left : left + crop.shape[1]] = piece
    return mask


def fit_support_plane(points: np.ndarray, seed: int = 0) -> tuple[np.ndarray, float]:
    """The plane ``normal . p + offset = 0`` that carries what is seen; the camera is above it.

    Args:
      points: [N, 3] meters, camera frame.
      seed: of the random hypotheses.

    Returns:
      (normal [3] of unit length towards the camera's side, offset > 0 in meters).

    Raises:
      CaperError: the points lie on no plane seen from above.
    """
    rng = np.random.default_rng(seed)
    stride = max(1, len(points) // _SAMPLES)
    sample = points[::stride].astype(np.float64)
    noise = _noise(sample[:, 2])

    triples = sample[rng.integers(len(sample), size=(_HYPOTHESES, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=-1)
    usable = lengths > 1e-9
    normals, corners = normals[usable] / lengths[usable, None], triples[usable, 0]
    offsets = -np.einsum("hi,hi->h", normals, corners)
    # The camera, at the origin, is above the plane.
    normals, offsets = normals * np.sign(offsets)[:, None], np.abs(offsets)
    heights = (normals @ sample.T + offsets[:, None]) / noise
    scores = (np.abs(heights) < 2).sum(1) - 2 * (heights < -4).sum(1)
    if not len(scores) or scores.max() < 0.1 * len(sample):
        raise CaperError("no supporting plane is visible around the object; give a mask instead")

    best = np.argmax(scores)
    normal, offset = normals[best], offsets[best]
    for _ in range(_REFINEMENTS):
        near = np.abs(sample @ normal + offset) < 2 * noise
        weights = 1 / noise[near] ** 2
        mean = np.average(sample[near], axis=0, weights=weights)
        scatter = (sample[near] - mean) * np.sqrt(weights)[:, None]
        normal = np.linalg.svd(scatter, full_matrices=False)[2][-1]
        offset = -normal @ mean
        normal, offset = normal * np.sign(offset), abs(offset)
    return normal, float(offset)


def _noise(depth: np.ndarray) -> np.ndarray:
    """Expected error of a depth camera at ``depth``, meters."""
    return _NOISE_M + _NOISE_PER_M * depth**2


def _central_piece(
    mask: np.ndarray,
    pieces: np.ndarray,
    middle: tuple[float, float],
    reach: tuple[float, float],
) -> np.ndarray:
    """The piece with the most pixels of ``mask``, those far from ``middle`` counting less."""
    rows, columns = np.nonzero(mask)
    far = ((rows - middle[0]) / reach[0]) ** 2 + ((columns - middle[1]) / reach[1]) ** 2
    votes = np.bincount(pieces[mask], weights=np.exp(-far), minlength=1)
    return mask & (pieces == np.argmax(votes))
