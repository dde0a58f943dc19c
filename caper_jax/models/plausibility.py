"""Whether an estimate can be believed: an object of the category, whole, alone and in meters.

A network answers whatever it is shown. How large the cloud is, how the points lie on the boxes that
were found, how sure the segmentation is and how far sizes and states are from what training showed
tells a small classifier (``training.fit_plausibility``) right objects from wrong ones. Not in the
paper.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from caper_jax.articulation.category import Category
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.lie import linalg
from caper_jax.models.layers import Dense, Weights
from caper_jax.models.observation import ObservedCloud
from caper_jax.models.refiner import StageEstimate, points_from_centers

# What ``Prediction.reason`` counts; the classifier's classes are those from PLAUSIBLE to PART.
PLAUSIBLE, SIZE, OTHER, SEVERAL, PART, FEW_POINTS, TOO_LARGE, TOO_SMALL = range(8)
REASONS = (
    "",
    "no object of this category has this size",
    "this is another object, or a surface",
    "this is more than one object",
    "this is a part of the object only",
    "the points are too few",
    "the object is too large",
    "the object is too small",
)
NUM_CLASSES = PART + 1
DOUBTFUL_POINTS = 100  # fewer different points are no basis for an answer
WIDTHS = (64, 32)  # of the classifier's hidden layers
_STRIDE = 2  # every n-th point is looked at
_NEAR = (0.02, 0.05)  # distances, in diagonals
_FLOOR = 1e-3
# Logarithms of the cloud's size over the category's that a model which was not fitted takes.
_LOW, _USUAL, _HIGH = np.log([0.35, 1.0, 2.5]).tolist()
_FAR_OFF = 2.5  # times the usual size
_LARGEST = 1e4
_GROWTH = 5.0  # largest logarithm by which implausibility widens standard deviations


@flax.struct.dataclass
class BoxFit:
    """How a cloud lies in the boxes of its estimate.

    Attributes:
      features: what the classifier is given, see ``num_features``.
      evidence: what standard deviations follow from, besides ``uncertainty.evidence``: for each
        part logarithms of its points' mean distance from its box's surface and of that outside the
        box, over the diagonal; of all points' outside; of the share of strays; of the number of
        different points over that of all, and its square.
      log_size: logarithm of the cloud's size over the category's.
      distinct: number of different points.
    """

    features: Float[Array, "B F"]
    evidence: Float[Array, "B K 6"]
    log_size: Float[Array, "B"]
    distinct: Int[Array, "B"]


@flax.struct.dataclass
class Verdict:
    """Whether an estimate can be believed.

    Attributes:
      plausible: whether it can.
      reason: index into ``REASONS`` of why not, 0 where it can.
      score: log odds of being right, over those at which one right estimate in a hundred is
        called wrong; None without a classifier.
      size_ratio: size of the cloud over that usual in the category.
    """

    plausible: Bool[Array, "B"]
    reason: Int[Array, "B"]
    score: Float[Array, "B"] | None
    size_ratio: Float[Array, "B"]


class PlausibilityClassifier(Weights, nn.Module):
    """Features of a ``BoxFit`` -> logits of the classes."""

    @nn.compact
    def __call__(self, features: Float[Array, "B F"]) -> Float[Array, "B C"]:
        shape = features.shape[-1:]
        mean = self.param("mean", nn.initializers.zeros, shape)
        scale = self.param("scale", nn.initializers.ones, shape)
        # Read by ``judge``: the score that counts as zero, and (low, usual, high) of ``log_size``.
        self.param("threshold", nn.initializers.zeros, ())
        self.param("log_size", nn.initializers.zeros, (3,))
        features = jnp.clip(features, -_LARGEST, _LARGEST)  # of what is absurd some overflow
        hidden = jnp.arcsinh((features - mean) * scale)  # logarithmic where nothing was seen
        for width in WIDTHS:
            hidden = nn.relu(Dense(width)(hidden))
        return Dense(NUM_CLASSES, kernel_init=nn.initializers.zeros)(hidden)


def num_features(num_parts: int) -> int:
    """F of ``BoxFit.features``, for K parts."""
    return 8 + 3 * len(_NEAR) + 2 + 3 + 5 + 13 * num_parts + (num_parts - 1) + 2


def box_fit(
    estimate: StageEstimate,
    segmentation: Float[Array, "B N K"],
    evidence: Float[Array, "B K E"],
    observed: ObservedCloud,
    category: Category,
) -> BoxFit:
    """Compares an estimate with its cloud and its category.

    Args:
      estimate: the final one; viewing frame, network units.
      segmentation: logits for the points of ``observed.cloud``.
      evidence: of the networks, see ``uncertainty.evidence``.
      observed: the cloud.
      category: static.
    """
    batch, number = observed.cloud.shape[:2]
    cloud, share = observed.cloud[:, ::_STRIDE], jax.nn.softmax(segmentation[:, ::_STRIDE])
    mean_size = jnp.asarray(category.mean_size, cloud.dtype) * category.unit
    mean_center = jnp.asarray(category.mean_center, cloud.dtype) * category.unit
    diagonal = rest_diagonal(mean_size, mean_center)

    own, outside, surface = _distances(estimate, cloud, category)
    of_own, of_any = (share * outside).sum(-1), outside.min(-1)
    from_own, from_any = (share * surface).sum(-1), surface.min(-1)
    spreads = []
    for distance in (of_own, from_own, of_any, from_any):
        spreads += [distance.mean(-1), jnp.sqrt(jnp.square(distance).mean(-1) + 1e-12)]
    shares = [
        (distance > near * diagonal).mean(-1)
        for near in _NEAR
        for distance in (of_any, from_any, of_own)
    ]

    weight = share / (share.sum(1, keepdims=True) + 1.0)
    inside = own / (estimate.size[:, None] / 2)
    middle = (weight[..., None] * inside).sum(1)
    spread = (weight[..., None] * jnp.square(inside - middle[:, None])).sum(1)

    away, radii = _radii(cloud)
    along = (away[..., :, None] * estimate.root[:, None, :3, :3]).sum(-2)

    inliers = observed.selection.inliers
    strays = 1.0 - inliers.kept.mean(-1)
    distinct = jnp.log(inliers.distinct / number)
    low, high = category.network_state_bounds.T.astype(cloud.dtype)
    features = (
        jnp.log(jnp.stack(spreads, -1) / diagonal + _FLOOR),
        jnp.stack(shares, -1),
        jnp.log(radii / diagonal + _FLOOR),
        jnp.log(jnp.sqrt(jnp.square(along).mean(1) + 1e-12) / diagonal + _FLOOR),
        evidence[:, 0, :5],
        evidence[:, :, 5],
        jnp.log(estimate.size / mean_size),
        (estimate.center - mean_center) / diagonal,
        (estimate.state - low) / (high - low),
        strays[:, None],
        distinct[:, None],
        middle,
        0.5 * jnp.log(spread + 1e-6),
    )
    flat = jnp.concatenate([values.reshape(batch, -1) for values in features], -1)

    count = share.sum(1) + 1.0
    of_parts = [
        jnp.log((share * distance).sum(1) / count / diagonal + _FLOOR)
        for distance in (surface, outside)
    ]
    away_from_all = jnp.log(of_own.mean(-1) / diagonal + _FLOOR)
    of_frame = [
        jnp.broadcast_to(one[:, None], of_parts[0].shape)
        for one in (away_from_all, jnp.log(strays + 0.002), distinct, jnp.square(distinct))
    ]
    return BoxFit(
        features=flat,
        evidence=jnp.stack([*of_parts, *of_frame], -1),
        log_size=_log_size(radii, diagonal),
        distinct=inliers.distinct,
    )


def log_size(cloud: Float[Array, "B N 3"], category: Category) -> Float[Array, "B"]:
    """Logarithm of a cloud's size over its category's; network units, raster order, no strays."""
    boxes = (jnp.asarray(size, cloud.dtype) for size in (category.mean_size, category.mean_center))
    return _log_size(_radii(cloud[:, ::_STRIDE])[1], rest_diagonal(*boxes) * category.unit)


def _log_size(radii, diagonal):
    return jnp.log(2.0 * radii[:, 1] / diagonal + 1e-6)


def _radii(cloud: Float[Array, "B N 3"]) -> tuple[Float[Array, "B N 3"], Float[Array, "B 2"]]:
    """Points from the median point, and the distances that half and 95 % of them are within."""
    away = cloud - jnp.median(cloud[:, ::4], axis=1, keepdims=True)
    radius = jnp.sort(linalg.norm(away[:, ::4]), axis=1)
    last = radius.shape[1] - 1
    return away, jnp.stack([radius[:, last // 2], radius[:, round(0.95 * last)]], -1)


def _distances(estimate: StageEstimate, cloud: Float[Array, "B N 3"], category: Category):
    """Points in each part's frame from its box's center [B, N, K, 3], and their distances [B, N, K]
    outside the box and from its surface."""
    own = points_from_centers(estimate, cloud, category)
    over = jnp.abs(own) - estimate.size[:, None] / 2
    outside = linalg.norm(jnp.maximum(over, 0.0))
    return own, outside, outside - jnp.minimum(over.max(-1), 0.0)


def judge(fit: BoxFit, number: int, params: dict[str, Any] | None) -> Verdict:
    """Whether an estimate can be believed, and why not.

    Args:
      fit: of the estimate.
      number: of points in the cloud, equal ones too.
      params: of the classifier; None for a model without one, whose verdict rests on the size of
        the cloud and the number of points alone.
    """
    reason = jnp.full(fit.distinct.shape, PLAUSIBLE, jnp.int32)
    score = None
    if params is not None:
        logits: Any = PlausibilityClassifier().apply({"params": params}, fit.features)
        score = logits[:, 0] - jax.nn.logsumexp(logits[:, 1:], axis=-1) - params["threshold"]
        likeliest = 1 + logits[:, 1:].argmax(-1).astype(jnp.int32)
        reason = jnp.where(score >= 0, reason, likeliest)  # what is not a number is not right
    reason = rules(reason, fit.log_size, fit.distinct, number, params)
    low, usual, high = size_bounds(params)
    if score is not None:
        # What a rule finds is no less implausible than what the classifier finds.
        beyond = jnp.maximum(fit.log_size - high, low - fit.log_size)
        score = jnp.where(beyond > 0, jnp.minimum(score, -4.0 * beyond), score)
    return Verdict(reason == PLAUSIBLE, reason, score, jnp.exp(fit.log_size - usual))


def size_bounds(params: dict[str, Any] | None) -> Any:
    """Smallest, usual and largest ``log_size`` of the category's objects."""
    return (_LOW, _USUAL, _HIGH) if params is None else params["log_size"]


def rules(reason, log_size, distinct, number: int, params: dict[str, Any] | None):
    """The reason of a verdict, where size or number of points alone do not decide it.

    Args:
      reason: [B] int32, of the classifier or of an earlier estimate.
      log_size, distinct: [B], see ``BoxFit``.
      number: of points, equal ones too: small networks take fewer.
      params: see ``judge``.
    """
    low, usual, high = size_bounds(params)
    # Of what is not plausible anyway, a size that is far off is the likeliest cause.
    wrong, far = reason != PLAUSIBLE, math.log(_FAR_OFF)
    reason = jnp.where((log_size > high) | (wrong & (log_size > usual + far)), TOO_LARGE, reason)
    reason = jnp.where((log_size < low) | (wrong & (log_size < usual - far)), TOO_SMALL, reason)
    return jnp.where(distinct < min(DOUBTFUL_POINTS, number // 2), FEW_POINTS, reason)


def widening(score: Float[Array, "B"]) -> Float[Array, "B"]:
    """By which factor implausibility widens standard deviations: 1 for what is plausible."""
    return jnp.exp(jnp.clip(-score, 0.0, _GROWTH))


class Judged(Protocol):
    """What ``implausible_because`` reads of a prediction or of a result of the tracker."""

    reason: Any
    size_ratio: Any
    distinct_points: Any


def implausible_because(result: Judged, category: Category) -> str:
    """One line on why a result is not plausible, with the likely cause; "" where it is.

    Args:
      result: a ``Prediction`` or a ``TrackResult``, without batch axes.
      category: what it was taken for.
    """
    reason, ratio = int(result.reason), float(result.size_ratio)
    name = category.name
    if reason == PLAUSIBLE:
        return ""
    if reason == FEW_POINTS:
        return (
            f"only {int(result.distinct_points)} different points show the object; an answer needs "
            f"{DOUBTFUL_POINTS}"
        )
    if reason in (TOO_LARGE, TOO_SMALL) or (reason == SIZE and not 0.6 < ratio < 1.7):
        larger = ratio > 1.0
        times = f"{ratio if larger else 1 / ratio:.1f} times too {'large' if larger else 'small'}"
        return f"the object looks {times} for this category ({name}): {_cause(ratio)}"
    return {
        SIZE: f"no object of this category ({name}) has this size and shape",
        OTHER: f"this does not look like this category ({name}); is it another object?",
        SEVERAL: "the cloud shows more than one object; does the mask take in something else?",
        PART: f"the cloud shows only a part of the object ({name}), or another object",
    }[reason]


def _cause(ratio: float) -> str:
    """Why a cloud may be so many times as large as it should be."""
    if 3.5 < ratio < 7.0:
        return "images of the TUM kind have 5000 units per meter (--depth-scale 0.0002)"
    if 7.0 <= ratio < 14.0 or 0.07 < ratio <= 0.14:
        return "is the depth in tenths of a millimeter (--depth-scale 0.0001), as in some BOP data?"
    if ratio > 100 or ratio < 0.01:
        return "points must be meters"
    return "check the unit of the depth (--depth-scale), or say so (--object-scale)"
