"""The refiner: the last correction of an estimate, from the sides of its boxes (not in the paper).

What the encoders pool says how large a part is to some percent, while its points lie on the very
sides of its box. Here every part's cloud is put into the box that was estimated for it. How it is
spread along each axis, and how the points near a side are shifted and tilted against it, tells a
small network how far box, pose and joints are off.
"""

from __future__ import annotations

import flax.linen as nn
import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import Array
from caper_jax.lie import se3
from caper_jax.models.layers import Dense, Weights
from caper_jax.models.uncertainty import EVIDENCE

# Where the spread is read, in half sizes of the box from its center: densely about its sides.
_OUTWARDS = (0.5, 0.6, 0.7, 0.78, 0.84, 0.89, 0.93, 0.96, 0.98, 1.0)
_BEYOND = (1.02, 1.04, 1.07, 1.11, 1.16, 1.24, 1.35, 1.5)
_PLACES = np.array([*_OUTWARDS, *_BEYOND], np.float32)
_PLACES = np.concatenate([-_PLACES[::-1], np.array([-0.25, 0.0, 0.25], np.float32), _PLACES])
_RAMP = 0.08  # width of the step by which a point counts as passed
_BAND = 0.12  # points so near to a side, in half sizes, tell how it is tilted
_LARGEST = 5.0  # standard deviations to which features are clipped
_MOST = 0.7  # of the logarithm of a size


@flax.struct.dataclass
class StageEstimate:
    """The estimate of both stages, in the viewing frame and network units.

    Attributes:
      root: pose of the root.
      axis, pivot: in the root's canonical frame.
      state: radians, or network units for prismatic joints.
      size, center: of the parts' boxes, each in its part's canonical frame.
    """

    root: Float[Array, "B 4 4"]
    axis: Float[Array, "B J 3"]
    pivot: Float[Array, "B J 3"]
    state: Float[Array, "B J"]
    size: Float[Array, "B K 3"]
    center: Float[Array, "B K 3"]


@flax.struct.dataclass
class RefinerOutput:
    """By how much an estimate is off.

    Attributes:
      size: logarithm of the true size over the estimated one.
      center: in estimated sizes.
      twist: root increment, network units.
      pivot: network units.
      state: as in ``StageEstimate``.
    """

    size: Float[Array, "B K 3"]
    center: Float[Array, "B K 3"]
    twist: Float[Array, "B 6"]
    pivot: Float[Array, "B J 3"]
    state: Float[Array, "B J"]


class BoxRefiner(Weights, nn.Module):
    """Features of an estimate -> RefinerOutput.

    Attributes:
      width: channels of its two hidden layers.
      num_parts: K.
    """

    width: int
    num_parts: int

    @nn.compact
    def __call__(self, features: Float[Array, "B F"]) -> RefinerOutput:
        """Features as ``refiner_features`` gives them; all zeros before it was fitted."""
        parts, joints = self.num_parts, self.num_parts - 1
        shape = features.shape[-1:]
        mean = self.param("mean", nn.initializers.zeros, shape)
        scale = self.param("scale", nn.initializers.ones, shape)
        hidden = jnp.clip((features - mean) * scale, -_LARGEST, _LARGEST)
        hidden = nn.leaky_relu(Dense(self.width)(hidden))
        hidden = nn.leaky_relu(Dense(self.width)(hidden))
        numbers = Dense(6 * parts + 6 + 4 * joints, kernel_init=nn.initializers.zeros)(hidden)
        ends = np.cumsum([3 * parts, 3 * parts, 6, 3 * joints])
        size, center, twist, pivot, state = jnp.split(numbers, ends, axis=-1)
        return RefinerOutput(
            size=size.reshape(-1, parts, 3),
            center=center.reshape(-1, parts, 3),
            twist=twist,
            pivot=pivot.reshape(-1, joints, 3),
            state=state,
        )


def num_features(num_parts: int) -> int:
    """F of ``refiner_features``, for K parts."""
    of_a_part = 3 * len(_PLACES) + 2 * 3 * 4 + 1 + 3 + 3
    return num_parts * of_a_part + 3 + (num_parts - 1) + EVIDENCE


def refiner_features(
    estimate: StageEstimate,
    cloud: Float[Array, "B N 3"],
    share: Float[Array, "B N K"],
    evidence: Float[Array, "B E"],
    category: Category,
) -> Float[Array, "B F"]:
    """How the points lie in the boxes of an estimate.

    Args:
      estimate: of both stages.
      cloud: viewing frame, network units.
      share: how much each point belongs to each part; sums to one over parts.
      evidence: of the frame (``uncertainty.evidence``).
      category: static.
    """
    batch = cloud.shape[0]
    own = points_from_centers(estimate, cloud, category)
    inside = own / (0.5 * estimate.size[:, None])  # [B, N, K, 3]

    count = share.sum(1)  # [B, K]
    weight = share / (share.sum(1, keepdims=True) + 1.0)
    passed = jnp.clip((_PLACES - inside[..., None]) / _RAMP + 0.5, 0.0, 1.0)
    spread = jnp.einsum("bnk,bnkap->bkap", weight, passed)
    tilts = [_tilt(inside, share, side) for side in (-1.0, 1.0)]

    mean_size = jnp.asarray(category.mean_size, cloud.dtype) * category.unit
    sight = (cloud.mean(1)[:, :, None] * estimate.root[:, :3, :3]).sum(1)  # from the root's frame
    of_points = (spread, *tilts, jnp.log(count + 1.0), sight)
    box = (jnp.log(estimate.size / mean_size), estimate.center / mean_size)
    features = (*of_points, *box, estimate.state, evidence)
    return jnp.concatenate([values.reshape(batch, -1) for values in features], axis=-1)


def points_from_centers(
    estimate: StageEstimate, cloud: Float[Array, "B N 3"], category: Category
) -> Float[Array, "B N K 3"]:
    """Every point in the frame of every part, from the center of its box; network units."""
    parts = forward_kinematics(
        estimate.root,
        estimate.axis,
        estimate.pivot,
        estimate.state,
        category.joint_types,
        category.parents,
    )
    away = cloud[:, :, None] - parts[:, None, :, :3, 3]
    own = (away[..., :, None] * parts[:, None, :, :3, :3]).sum(-2)  # R^T (p - t)
    return own - estimate.center[:, None]


def _tilt(inside, share, side: float):
    """[B, K, 3, 4]: how many points are near one side along each axis, how far they are from it on
    average, and how that grows along the two other axes."""
    # Points last: sums over them are then several times as fast on a CPU.
    inside, share = jnp.moveaxis(inside, 1, -1), jnp.moveaxis(share, 1, -1)[:, :, None]
    near = share * jnp.exp(-jnp.square((inside - side) / _BAND))  # [B, K, 3, N]
    total = near.sum(-1) + 1e-3
    shift = (near * (inside - side)).sum(-1) / total
    slopes = []
    for other in (1, 2):
        along = jnp.roll(inside, -other, axis=2)
        along = along - ((near * along).sum(-1) / total)[..., None]
        together = (near * (inside - side - shift[..., None]) * along).sum(-1)
        slopes.append(3.0 * together / ((near * jnp.square(along)).sum(-1) + 0.02 * total))
    return jnp.stack([jnp.log(total), shift, *slopes], axis=-1)


def apply_residual(estimate: StageEstimate, output: RefinerOutput) -> StageEstimate:
    """The estimate corrected by what the refiner says it is off by."""
    growth = jnp.exp(jnp.clip(output.size, -_MOST, _MOST))
    return StageEstimate(
        root=se3.compose(estimate.root, se3.exp(output.twist)),
        axis=estimate.axis,
        pivot=estimate.pivot + output.pivot,
        state=estimate.state + output.state,
        size=estimate.size * growth,
        center=estimate.center + output.center * estimate.size,
    )
