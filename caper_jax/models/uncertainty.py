"""How sure an estimate is: standard deviations, calibrated on frames that training never saw.

Beyond the paper, whose correction factors (Eq 18) say how good the two directions of the root are
and nothing of the other parts. What the networks say about a frame anyway, its evidence, gives for
each part and joint the radius that holds the truth nine times in ten: a linear model of the
logarithm, fitted once per category (``training.fit_uncertainty``). A standard deviation is the
radius over that of a normal distribution of the same coverage.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.errors import CaperError
from caper_jax.lie import linalg

COVERAGE = 0.9
# Radii that hold COVERAGE of a normal distribution of unit variance, in three and one dimensions.
RADIUS_3D, RADIUS_1D = 2.500278, 1.644854
HIDDEN_POINTS = 10  # a part that fewer points show is known through its joints alone
EVIDENCE = 6
_FLOOR = 1e-3


@flax.struct.dataclass
class Calibration:
    """Coefficients of a category: log radius = evidence @ [..., :-1] + [..., -1].

    Attributes:
      rotation: [K, EVIDENCE + 1] radians.
      translation: [K, EVIDENCE + 1] network units.
      state: [J, EVIDENCE + 1] radians or network units.
      low, high: [EVIDENCE] range of the evidence it was fitted on, beyond which nothing changes.
    """

    rotation: Any
    translation: Any
    state: Any
    low: Any
    high: Any


def evidence(confidence, increment, logits):
    """What the networks say about a frame that goes with the errors of its estimate.

    Args:
      confidence: [B, 2] in (0, 1), Eq 18.
      increment: [B, 6] twist by which stage II corrected the root.
      logits: [B, N, K] of the segmentation.

    Returns:
      [B, K, EVIDENCE]: logarithms of the doubt about each direction, of both halves of the twist
      and of the part's share of the points, and the mean entropy of the segmentation.
    """
    doubt = jnp.log(1.0 - confidence + _FLOOR)
    halves = increment.reshape(-1, 2, 3)
    moved = jnp.log(linalg.norm(halves) + _FLOOR)
    log_share = jax.nn.log_softmax(logits)
    entropy = -(jnp.exp(log_share) * log_share).sum(-1).mean(-1)
    count = points_of_parts(logits.argmax(-1), logits.shape[-1])
    seen = jnp.log((count + 1.0) / logits.shape[1])
    frame = jnp.concatenate([doubt, moved, entropy[:, None]], -1)
    frame = jnp.broadcast_to(frame[:, None], (*seen.shape, frame.shape[-1]))
    return jnp.concatenate([frame, seen[..., None]], -1)


def points_of_parts(labels, num_parts: int):
    """[B, K] int32, how many of the points show each part."""
    return (labels[..., None] == jnp.arange(num_parts)).sum(-2, dtype=jnp.int32)


def radii(calibration: Calibration, found):
    """Radii that hold the truth nine times in ten, from evidence [B, K, EVIDENCE].

    Returns:
      (rotation [B, K], translation [B, K], state [B, J]), units as in ``Calibration``.
    """
    inside = jnp.clip(found, calibration.low, calibration.high)

    def linear(coefficients, parts):
        return jnp.exp((parts * coefficients[:, :-1]).sum(-1) + coefficients[:, -1])

    return (
        jnp.minimum(linear(calibration.rotation, inside), np.pi),
        linear(calibration.translation, inside),
        linear(calibration.state, inside[:, 1:]),
    )


def pose_covariance(rotation_std, translation_std):
    """[..., 6, 6] of the twist xi in T_true = T exp(xi), from standard deviations [...].

    Rotation first, as everywhere; isotropic in both halves, without correlation.
    """
    deviations = jnp.stack([rotation_std] * 3 + [translation_std] * 3, -1)
    return deviations[..., None] ** 2 * jnp.eye(6, dtype=deviations.dtype)


def from_card(section: Mapping[str, Any], num_parts: int, source: str) -> Calibration:
    """The calibration in a model card.

    Args:
      section: "calibration" of the card.
      num_parts: K.
      source: for the error message.

    Raises:
      CaperError: a value is missing, of another shape, or no finite number.
    """
    shapes = {
        "rotation": (num_parts, EVIDENCE + 1),
        "translation": (num_parts, EVIDENCE + 1),
        "state": (num_parts - 1, EVIDENCE + 1),
        "low": (EVIDENCE,),
        "high": (EVIDENCE,),
    }
    values = {}
    for name, shape in shapes.items():
        try:
            values[name] = np.asarray(section[name], np.float32)
        except (KeyError, TypeError, ValueError) as error:
            raise CaperError(f"{source}: calibration lacks numbers for {name!r}") from error
        if values[name].shape != shape or not np.isfinite(values[name]).all():
            raise CaperError(f"{source}: calibration {name} must be finite numbers {shape}")
    return Calibration(**values)
