"""The losses of the paper (Sec 5.4, Eqs 17-23), with its errata mended.

Every function returns one value per sample, [B], so that of an ambiguous object the declared
symmetry that costs least can be chosen per sample; the step takes the mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from caper_jax.config import HeatmapKind, LossWeights

PerSample = Float[Array, " batch"]
Directions = Float[Array, "batch 2 3"]
JointVectors = Float[Array, "batch joints 3"]
JointValues = Float[Array, "batch joints"]
Heatmap = Float[Array, "batch points joints"]
Offsets = Float[Array, "batch points joints 3"]


def _per_sample(values: Float[Array, "batch ..."]) -> PerSample:
    """Mean over all axes but the first."""
    return values.reshape(values.shape[0], -1).mean(axis=1)


def rotation_loss(predicted: Directions, target: Directions) -> PerSample:
    """Eq 17, rotation: L1 of both directions, [B, 2, 3] -> [B] (mean over xyz, sum over the two).

    The mean, not the sum, over components: the weights of Eq 22 assume it.
    """
    return jnp.abs(predicted - target).mean(-1).sum(-1)


def translation_loss(
    predicted: Float[Array, "batch 3"], target: Float[Array, "batch 3"]
) -> PerSample:
    """Eq 17, translation: mean absolute difference, [B, 3] -> [B]."""
    return jnp.abs(predicted - target).mean(-1)


def confidence_loss(
    confidence: Float[Array, "batch 2"],
    predicted: Directions,
    target: Directions,
    sharpness: float = 13.7,
) -> PerSample:
    """Eq 18: the correction factor of each direction learns how good that direction is.

    |psi_i - exp(-13.7 |r_i - r^_i|^2)|: the sign and the constant are missing in the paper. Each
    confidence is paired with its own direction. The gradient also reaches the directions.

    Args:
      confidence: [B, 2].
      predicted, target: [B, 2, 3].
      sharpness: 13.7 puts the target at 0.5 for an error of 12.9 deg.

    Returns:
      [B], sum over the two directions, as in Eq 17.
    """
    goodness = jnp.exp(-sharpness * ((predicted - target) ** 2).sum(-1))
    return jnp.abs(confidence - goodness).sum(-1)


def axis_offsets(
    points: Float[Array, "batch points 3"], axis: JointVectors, pivot: JointVectors
) -> Offsets:
    """Eq 4 as a vector: from each point to its foot on each joint axis.

    Args:
      points: [B, N, 3].
      axis: [B, J, 3] unit.
      pivot: [B, J, 3].

    Returns:
      [B, N, J, 3]; its length is the distance D_i of Eq 4.
    """
    from_pivot = points[:, :, None, :] - pivot[:, None, :, :]
    axis = axis[:, None, :, :]
    along = (from_pivot * axis).sum(-1, keepdims=True)
    return along * axis - from_pivot


def heatmap_target(
    distance: Heatmap, kind: HeatmapKind = "exponential", gate: ArrayLike = 0.2
) -> Heatmap:
    """Eq 5: weight of each point's vote, zero beyond ``gate`` times the farthest point.

    Args:
      distance: [B, N, J], D_i.
      kind: "exponential" is exp(-D) as printed; it is nearly 1 inside the gate, so "scaled",
        exp(-D / (gate D_max)), and "linear", 1 - D / (gate D_max), are offered.
      gate: 0.2 in the paper.
    """
    reach = gate * distance.max(axis=1, keepdims=True)
    relative = distance / jnp.maximum(reach, 1e-9)
    if kind == "exponential":
        value = jnp.exp(-distance)
    elif kind == "scaled":
        value = jnp.exp(-relative)
    else:
        value = 1.0 - relative
    return jnp.where(distance < reach, value, 0.0)


def heatmap_loss(predicted: Heatmap, target: Heatmap) -> PerSample:
    """Mean absolute difference of the heatmaps, [B, N, J] -> [B]."""
    return _per_sample(jnp.abs(predicted - target))


def offset_loss(predicted: Offsets, target: Offsets, heatmap: Heatmap) -> PerSample:
    """L1 of the offsets over the points that vote (target heatmap > 0), [B, N, J, 3] -> [B].

    A joint for which no point lies inside the gate adds nothing.
    """
    votes = (heatmap > 0).astype(predicted.dtype)
    error = jnp.abs(predicted - target).mean(-1) * votes
    return (error.sum(1) / jnp.maximum(votes.sum(1), 1.0)).mean(-1)


def location_loss(
    pivot: JointVectors,
    axis: JointVectors,
    true_pivot: JointVectors,
    revolute: Bool[Array, " joints"] | Sequence[bool],
) -> PerSample:
    """Eq 19: distance of the predicted pivot from the true joint line.

    Args:
      pivot: [B, J, 3] voted.
      axis, true_pivot: [B, J, 3] ground truth; any point on the line will do as true pivot.
      revolute: J booleans; prismatic joints have no pivot and count zero.

    Returns:
      [B], mean over joints.
    """
    moment = jnp.cross(pivot - true_pivot, axis)
    squared = (moment * moment).sum(-1)
    near = squared < 1e-16  # on the line: the distance has no slope there
    distance = jnp.where(near, 0.0, jnp.sqrt(jnp.where(near, 1.0, squared)))
    return (distance * jnp.asarray(revolute, distance.dtype)).mean(-1)


def direction_loss(axis: JointVectors, true_axis: JointVectors) -> PerSample:
    """Mean absolute difference of unit joint directions, [B, J, 3] -> [B]."""
    return _per_sample(jnp.abs(axis - true_axis))


def state_loss(
    state: JointValues, true_state: JointValues, penalty: float | Array = 20.0
) -> PerSample:
    """Eq 20: L1 of the joint states, ``penalty`` times where the sign is wrong, [B, J] -> [B].

    The case is decided per joint, and a product of exactly zero counts as wrong (errata).
    """
    weight = jnp.where(state * true_state > 0, 1.0, penalty)
    return (weight * jnp.abs(state - true_state)).mean(-1)


def scale_loss(
    size: Float[Array, "batch parts 3"], true_size: Float[Array, "batch parts 3"]
) -> PerSample:
    """Mean absolute difference of part sizes (or box centers), [B, K, 3] -> [B]."""
    return _per_sample(jnp.abs(size - true_size))


def segmentation_loss(
    logits: Float[Array, "batch points parts"], labels: Int[Array, "batch points"]
) -> PerSample:
    """Cross entropy of the part labels, [B, N, K] and [B, N] -> [B]; label -1 is left out."""
    valid = labels >= 0
    log_probability = jax.nn.log_softmax(logits)
    chosen = jnp.take_along_axis(log_probability, jnp.maximum(labels, 0)[..., None], -1)[..., 0]
    return -jnp.where(valid, chosen, 0.0).sum(-1) / jnp.maximum(valid.sum(-1), 1)


def twist_loss(
    twist: Float[Array, "batch numbers"], true_twist: Float[Array, "batch numbers"]
) -> PerSample:
    """Eq 21: L1 of the se(3) coordinates (w, rho), [B, 6] -> [B] (mean over each half, summed).

    Also for increments in Euclidean coordinates, [B, 9]: two axes, then the translation.
    """
    error = jnp.abs(twist - true_twist)
    return error[..., :-3].mean(-1) + error[..., -3:].mean(-1)


def rotation_class_loss(
    logits: Float[Array, "batch 24"], rotation_class: Int[Array, " batch"]
) -> PerSample:
    """Cross entropy of the cube rotation that the reference is off by, [B, 24] and [B] -> [B]."""
    chosen = rotation_class[:, None]
    return -jnp.take_along_axis(jax.nn.log_softmax(logits), chosen, axis=-1)[:, 0]


def weighted_total(weights: LossWeights, losses: dict[str, PerSample]) -> PerSample:
    """Eqs 22 and 23: the weighted sum of the losses of one stage, [B].

    Args:
      weights: one weight per name.
      losses: {name of a field of LossWeights: [B]}.
    """
    total = sum(getattr(weights, name) * value for name, value in losses.items())
    return jnp.asarray(total)
