"""The object inside a detection box: what stands on the plane that carries it."""

from __future__ import annotations

import numpy as np

from caper_jax.data.clouds import MIN_POINTS, back_project
from caper_jax.errors import CaperError

# Error of a stereo camera, which grows with z^2: 2 mm at 0.7 m, as measured on a table.
_NOISE_M, _NOISE_PER_M = 0.001, 0.002
_HEIGHT = 3  # times the noise, over which something stands on the plane
_MARGIN = 0.35  # of the box's size: the rim in which the plane shows
_HYPOTHESES = 256
_SAMPLES = 3000
_REFINEMENTS = 3


def mask_from_box(
    depth: np.ndarray,
    intrinsics: np.ndarray,
    box: tuple[float, float, float, float],
    seed: int = 0,
) -> np.ndarray:
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
    margin_x, margin_y = round(_MARGIN * (x2 - x1)), round(_MARGIN * (y2 - y1))
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
    pieces = connected_components(standing | (inside & ~valid))
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


def connected_components(mask: np.ndarray) -> np.ndarray:
    """Labels pixels that touch along an edge: [H, W] int, the same number within a piece.

    Every pixel points at its smallest neighbor and then, repeatedly, at where that one points;
    pointers halve their way, so even winding pieces need few rounds.
    """
    height, width = mask.shape
    outside = height * width
    labels = np.where(mask, np.arange(outside).reshape(mask.shape), outside)
    parents = np.arange(outside + 1)
    while True:
        least = labels.copy()
        np.minimum(least[1:], labels[:-1], out=least[1:])
        np.minimum(least[:-1], labels[1:], out=least[:-1])
        np.minimum(least[:, 1:], labels[:, :-1], out=least[:, 1:])
        np.minimum(least[:, :-1], labels[:, 1:], out=least[:, :-1])
        changed = mask & (least < labels)
        if not changed.any():
            return labels
        np.minimum.at(parents, labels[changed], least[changed])
        while not np.array_equal(parents, shorter := parents[parents]):
            parents = shorter
        labels = np.where(mask, parents[labels], outside)
