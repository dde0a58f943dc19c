"""The two networks of CAPER++: root pose (Sec 5.1) and constrained parts (Sec 5.2, 5.3)."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from caper_jax.config import (
    HeadConfig,
    IncrementKind,
    NetworkConfig,
)
from caper_jax.models.encoders.fast import FastEncoder
from caper_jax.models.encoders.hs import HSEncoder, Neighborhoods, neighborhoods
from caper_jax.models.heads import PointHead, PooledHead, unit_vectors
from caper_jax.models.rotation_classes import NUM_CUBE_ROTATIONS

_INCREMENT_SIZE: dict[IncrementKind, int] = {"lie": 6, "euclidean": 9}


def make_encoder(config: NetworkConfig) -> nn.Module:
    """The encoder that a config names: (points [B, N, 3], train) -> Features."""
    if config.encoder == "hs":
        return HSEncoder(config.hs, name="encoder")
    return FastEncoder(config.fast, name="encoder")


def shared_neighborhoods(config: NetworkConfig, points) -> Neighborhoods | None:
    """What both stages may use in evaluation: neighbors do not change with the pose.

    Args:
      config: sizes.
      points: [B, N, 3] the cloud, in any pose, network units.

    Returns:
      None for an encoder that searches no neighbors.
    """
    if config.encoder != "hs":
        return None
    return neighborhoods(points - points.mean(axis=1, keepdims=True), config.hs)


def _encode(config: NetworkConfig, points, train: bool, space: Neighborhoods | None):
    encoder = make_encoder(config)
    return encoder(points, train) if space is None else encoder(points, train, space)


@flax.struct.dataclass
class RootOutput:
    """Stage I, in the frame and units of its input cloud.

    Attributes:
      directions: [B, 2, 3] unit vectors, two axes of the root's frame.
      confidence: [B, 2] in (0, 1); the correction factors of Eq 3.
      translation: [B, 3].
    """

    directions: Any
    confidence: Any
    translation: Any


class RootNetwork(nn.Module):
    """Stage I: two directions with confidence, and the translation as a residual to the mean."""

    config: NetworkConfig

    @nn.compact
    def __call__(self, points, train: bool, space: Neighborhoods | None = None) -> RootOutput:
        """points [B, N, 3], network units -> RootOutput; see ``shared_neighborhoods``."""
        mean = points.mean(axis=1, keepdims=True)
        features = _encode(self.config, points - mean, train, space)
        heads = self.config.root_heads
        residual = PooledHead(3, heads, with_points=True, name="translation")(features, train)
        if self.config.rotation == "quaternion":
            numbers = PooledHead(4, heads, name="quaternion")(features, train)
            directions = quaternion_axes(numbers)
            confidence = jnp.full(directions.shape[:2], 0.5, directions.dtype)
        else:
            raw = jnp.stack(
                [PooledHead(4, heads, name=f"direction{i}")(features, train) for i in range(2)],
                axis=1,
            )
            directions, confidence = unit_vectors(raw[..., 1:]), jax.nn.sigmoid(raw[..., 0])
            if not self.config.vertical_correction:
                confidence = jnp.broadcast_to(
                    jnp.array([1.0, 0.0], confidence.dtype), confidence.shape
                )
        return RootOutput(directions, confidence, residual + mean[:, 0])


def quaternion_axes(numbers):
    """Two axes at right angles, [B, 2, 3], from [B, 4]: a quaternion less the identity's."""
    w, x, y, z = jnp.moveaxis(unit_vectors(numbers + jnp.array([1.0, 0, 0, 0])), -1, 0)
    first = jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    second = jnp.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1)
    return jnp.stack([first, second], axis=1)


@flax.struct.dataclass
class PartsOutput:
    """Stage II, in the root's canonical frame, network units; K parts, J = K - 1 joints.

    The input is canonicalized by a reference pose (stage I's, or in tracking the keyframe's, which
    makes it the proxy canonical space of Sec 5.3.1). ``increment`` says how far the root is from
    that reference; everything else is said of the true canonical frame.

    Attributes:
      increment: [B, 6] or [B, 9], see ``models.increment``; zero where the reference is right.
      turn: [B, 24] logits of ``models.rotation_classes``: which one the reference needs, before the
        increment; None without that head.
      segmentation: [B, N, K] logits.
      heatmap: [B, N, J] in (0, 1), weight of each point's vote (Eq 5).
      offset: [B, N, J, 3] from the point to its foot on the joint axis (Eq 4, as a vector).
      direction: [B, N, J, 3] votes for the joint direction (Eq 7).
      state: [B, J] radians, or network units for prismatic joints.
      size: [B, K, 3] residual to the category's mean size.
      center: [B, K, 3] residual to the category's mean box center.
    """

    increment: Any
    turn: Any
    segmentation: Any
    heatmap: Any
    offset: Any
    direction: Any
    state: Any
    size: Any
    center: Any


class PartsNetwork(nn.Module):
    """Stage II: root increment, joint parameters by voting, joint states, sizes, segmentation.

    Attributes:
      config: sizes.
      num_parts: K.
    """

    config: NetworkConfig
    num_parts: int

    @nn.compact
    def __call__(self, points, train: bool, space: Neighborhoods | None = None) -> PartsOutput:
        """points [B, N, 3], canonicalized, network units -> PartsOutput.

        In training N is divided by ``config.point_stride`` in the point-wise outputs. See
        ``shared_neighborhoods`` for the last argument.
        """
        parts, joints = self.num_parts, self.num_parts - 1
        batch = points.shape[0]
        # Not centered: where the origin lies is what stage I has found out.
        features = _encode(self.config, points, train, space)
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
        numbers = _INCREMENT_SIZE[self.config.increment]
        increment = PooledHead(numbers, pooled, name="increment")(features, train)
        turn = None
        if self.config.rotation_classifier.width:
            width = self.config.rotation_classifier.width
            narrow = HeadConfig((width, width, width), pooled.dropout, pool_first=True)
            turn = PooledHead(NUM_CUBE_ROTATIONS, narrow, name="turn")(features, train)
        extent = PooledHead(6 * parts, pooled, name="size")(features, train)
        extent = extent.reshape(batch, parts, 6)
        return PartsOutput(
            increment=increment,
            turn=turn,
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
