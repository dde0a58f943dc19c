"""Stage II: the root's increment, the joints by voting, joint states, sizes and segmentation.

Sec 5.2 of the paper, and Sec 5.3, where a tracker shows it a cloud in the canonical space of a
keyframe.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from caper_jax.config import HeadConfig, IncrementKind, NetworkConfig
from caper_jax.geometry.two_axis_rotation import rotation_from_directions
from caper_jax.lie import se3
from caper_jax.models.encoders import encode
from caper_jax.models.heads import PointHead, PooledHead, unit_vectors
from caper_jax.models.rotation_classes import NUM_CUBE_ROTATIONS

_INCREMENT_SIZE: dict[IncrementKind, int] = {"lie": 6, "euclidean": 9}


@flax.struct.dataclass
class PartsOutput:
    """Stage II, in the root's canonical frame, network units; K parts, J = K - 1 joints.

    The input is canonicalized by a reference pose (stage I's, or in tracking the keyframe's, which
    makes it the proxy canonical space of Sec 5.3.1). ``increment`` says how far the root is from
    that reference; everything else is said of the true canonical frame.

    Attributes:
      increment: 6 or 9 numbers, see ``increment_transform``; zero where the reference is right.
      rotation_class: logits of ``models.rotation_classes``: which rotation the reference needs
        before the increment; None without that head.
      segmentation: logits.
      heatmap: in (0, 1), weight of each point's vote (Eq 5).
      offset: from the point to its foot on the joint axis (Eq 4, as a vector).
      direction: votes for the joint direction (Eq 7).
      state: radians, or network units for prismatic joints.
      size: residual to the category's mean size.
      center: residual to the category's mean box center.
    """

    increment: Float[Array, "B D"]
    rotation_class: Float[Array, "B 24"] | None
    segmentation: Float[Array, "B N K"]
    heatmap: Float[Array, "B N J"]
    offset: Float[Array, "B N J 3"]
    direction: Float[Array, "B N J 3"]
    state: Float[Array, "B J"]
    size: Float[Array, "B K 3"]
    center: Float[Array, "B K 3"]


class PartsNetwork(nn.Module):
    """Stage II: root increment, joint parameters by voting, joint states, sizes, segmentation.

    Attributes:
      config: sizes.
      num_parts: K.
    """

    config: NetworkConfig
    num_parts: int

    @nn.compact
    def __call__(
        self, points: Float[Array, "B N 3"], train: bool, space: Any = None
    ) -> PartsOutput:
        """Points, canonicalized, network units -> PartsOutput.

        In training N is divided by ``config.point_stride`` in the point-wise outputs. See
        ``shared_neighborhoods`` for the last argument.
        """
        parts, joints = self.num_parts, self.num_parts - 1
        batch = points.shape[0]
        # Not centered: where the origin lies is stage I's result.
        features = encode(self.config, points, train, space)
        chosen = features.every(self.config.point_stride) if train else features
        pointwise = self.config.point_heads
        segmentation = PointHead(parts, pointwise, name="segmentation")(chosen, train)
        pooled = self.config.pooled_heads
        if self.config.joints == "voting":
            votes = PointHead(7 * joints, pointwise, name="joint")(chosen, train)
            votes = votes.reshape(batch, -1, joints, 7)
            heatmap, offset, direction = (
                jax.nn.sigmoid(votes[..., 0]),
                votes[..., 1:4],
                votes[..., 4:],
            )
        else:
            numbers = PooledHead(6 * joints, pooled, name="joint")(features, train)
            heatmap, offset, direction = _unanimous(
                points[:, :: self.config.point_stride] if train else points,
                numbers.reshape(batch, joints, 6),
            )
        state = PooledHead(joints, pooled, name="state")(features, train)
        size = _INCREMENT_SIZE[self.config.increment]
        increment = PooledHead(size, pooled, name="increment")(features, train)
        # Submodules keep their names: weights and their first random numbers go by them.
        rotation_class = None
        if self.config.rotation_classifier.width:
            width = self.config.rotation_classifier.width
            narrow = HeadConfig((width, width, width), pooled.dropout, pool_first=True)
            rotation_class = PooledHead(NUM_CUBE_ROTATIONS, narrow, name="turn")(features, train)
        extent = PooledHead(6 * parts, pooled, name="size")(features, train)
        extent = extent.reshape(batch, parts, 6)
        return PartsOutput(
            increment=increment,
            rotation_class=rotation_class,
            segmentation=segmentation,
            heatmap=heatmap,
            offset=offset,
            direction=direction,
            state=state,
            size=extent[..., :3],
            center=extent[..., 3:],
        )


def _unanimous(points, joints):
    """Votes of [B, N, 3] points that all say the same [B, J, 6] axis and pivot."""
    shape = (points.shape[0], points.shape[1], joints.shape[1])
    axis = jnp.broadcast_to(joints[:, None, :, :3], (*shape, 3))
    return jnp.ones(shape, points.dtype), joints[:, None, :, 3:] - points[:, :, None], axis


def vote(
    points: Float[Array, "B N 3"],
    heatmap: Float[Array, "B N J"],
    offset: Float[Array, "B N J 3"],
    direction: Float[Array, "B N J 3"],
) -> tuple[Float[Array, "B J 3"], Float[Array, "B J 3"]]:
    """Joint direction and pivot as heatmap-weighted means of the points' votes (Eqs 6 and 7).

    The weights are divided by their sum: with the 1/N of the printed equations the pivot shrinks
    towards the origin (errata). The pivot is a point on the axis; where along it is arbitrary.

    Args:
      points: the cloud.
      heatmap: weights, at least 0.
      offset: from each point to its foot on the axis.
      direction: of the axis, as each point sees it.

    Returns:
      axis: unit vectors.
      pivot: points on the axes.
    """
    weight = heatmap + 1e-9  # where no point has any, all have the same
    share = weight / weight.sum(axis=1, keepdims=True)
    pivot = (share[..., None] * (points[:, :, None, :] + offset)).sum(axis=1)
    axis = (share[..., None] * direction).sum(axis=1)
    return unit_vectors(axis), pivot


def increment_transform(
    numbers: Float[Array, "*batch D"], kind: IncrementKind
) -> Float[Array, "*batch 4 4"]:
    """The rigid transform that a network's output stands for (Sec 5.3.2 and Table 9).

    Args:
      numbers: "lie": [..., 6] a twist (w, rho), mapped by the exponential (Eq 14); "euclidean":
        [..., 9] the first two axes, as differences to x and y, and the translation; the first axis
        keeps its direction, the second is made perpendicular. Zeros give the identity in both.
      kind: which of the two.
    """
    if kind == "lie":
        return se3.exp(numbers)
    x = numbers[..., 0:3] + jnp.array([1.0, 0.0, 0.0], numbers.dtype)
    y = numbers[..., 3:6] + jnp.array([0.0, 1.0, 0.0], numbers.dtype)
    rotation, _ = rotation_from_directions(x, y, 1.0, 0.0, ("x", "y"))
    return se3.from_rt(rotation, numbers[..., 6:])


def increment_numbers(
    transform: Float[Array, "*batch 4 4"], kind: IncrementKind
) -> Float[Array, "*batch D"]:
    """The numbers that stand for a transform; inverts ``increment_transform``."""
    if kind == "lie":
        return se3.log(transform)
    axes = transform[..., :3, :2] - jnp.eye(3, dtype=transform.dtype)[:, :2]
    axes = jnp.swapaxes(axes, -1, -2)
    return jnp.concatenate([axes[..., 0, :], axes[..., 1, :], transform[..., :3, 3]], -1)
