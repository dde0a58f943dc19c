"""Uncertainty of an estimate: standard deviations, calibrated on frames that training never saw.

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
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from caper_jax.errors import CaperError
from caper_jax.lie import linalg

COVERAGE = 0.9
# Radii that hold COVERAGE of a normal distribution of unit variance, in three and one dimensions.
RADIUS_3D, RADIUS_1D = 2.500278, 1.644854
HIDDEN_POINTS = 10  # a part that fewer points show is known through its joints alone
EVIDENCE = 6  # of the networks
FIT_EVIDENCE = 6  # of the boxes, see ``plausibility.BoxFit``
ALL_EVIDENCE = EVIDENCE + FIT_EVIDENCE
_FLOOR = 1e-3


@flax.struct.dataclass
class Calibration:
    """Coefficients of a category: log radius = evidence @ [..., :-1] + [..., -1].

    Attributes:
      rotation: radians; one column more than the evidence has, E = ALL_EVIDENCE + 1.
      translation: network units.
      state: radians or network units.
      low, high: range of the evidence it was fitted on, beyond which nothing changes.
      size: network units, along each axis of the part; two more columns, for ``foreshortening``
        and its square. None where it was not fitted.
    """

    rotation: Float[np.ndarray, "K E"]
    translation: Float[np.ndarray, "K E"]
    state: Float[np.ndarray, "J E"]
    low: Float[np.ndarray, "E-1"]
    high: Float[np.ndarray, "E-1"]
    size: Float[np.ndarray, "K 3 E+2"] | None = None


def evidence(
    confidence: Float[Array, "B 2"], increment: Float[Array, "B 6"], logits: Float[Array, "B N K"]
) -> Float[Array, "B K E"]:
    """Numbers of the networks that go along with the errors of an estimate.

    Args:
      confidence: of the root's directions, in (0, 1), Eq 18.
      increment: twist by which stage II corrected the root.
      logits: of the segmentation.

    Returns:
      For each part the logarithms of the doubt about each direction, of both halves of the twist
      and of the part's share of the points, and the mean entropy of the segmentation.
    """
    doubt = jnp.log(1.0 - confidence + _FLOOR)
    halves = increment.reshape(-1, 2, 3)
    moved = jnp.log(linalg.norm(halves) + _FLOOR)
    log_share = jax.nn.log_softmax(logits)
    entropy = -(jnp.exp(log_share) * log_share).sum(-1).mean(-1)
    count = points_per_part(logits.argmax(-1), logits.shape[-1])
    visible = jnp.log((count + 1.0) / logits.shape[1])
    frame = jnp.concatenate([doubt, moved, entropy[:, None]], -1)
    frame = jnp.broadcast_to(frame[:, None], (*visible.shape, frame.shape[-1]))
    return jnp.concatenate([frame, visible[..., None]], -1)


def points_per_part(labels: Int[Array, "B N"], num_parts: int) -> Int[Array, "B K"]:
    """How many of the points show each part."""
    return (labels[..., None] == jnp.arange(num_parts)).sum(-2, dtype=jnp.int32)


def radii(
    calibration: Calibration, evidence: Float[Array, "B K E"]
) -> tuple[Float[Array, "B K"], Float[Array, "B K"], Float[Array, "B J"]]:
    """Radii that hold the truth nine times in ten: rotation, translation and joint state.

    Units are those of ``Calibration``.
    """
    inside = jnp.clip(evidence, calibration.low, calibration.high)

    def linear(coefficients, parts):
        return jnp.exp((parts * coefficients[:, :-1]).sum(-1) + coefficients[:, -1])

    return (
        jnp.minimum(linear(calibration.rotation, inside), np.pi),
        linear(calibration.translation, inside),
        linear(calibration.state, inside[:, 1:]),
    )


def foreshortening(
    rotation: Float[Array, "*batch K 3 3"], translation: Float[Array, "*batch K 3"]
) -> Float[Array, "*batch K 3"]:
    """How little is seen of a part's extent along each of its axes: 1 along the ray to it, else 0.

    What a depth image says of the thickness of a plate that faces the camera is nothing.

    Args:
      rotation: part -> camera.
      translation: of the part, in the unit of the camera's frame.
    """
    ray = linalg.unit(translation)
    return jnp.abs((rotation * ray[..., :, None]).sum(-2))


def size_radii(
    calibration: Calibration,
    evidence: Float[Array, "B K E"],
    foreshortened: Float[Array, "B K 3"],
) -> Float[Array, "B K 3"] | None:
    """Radii that hold the true extents nine times in ten, network units; None if not fitted."""
    if calibration.size is None:
        return None
    inside = jnp.clip(evidence, calibration.low, calibration.high)
    inputs = size_inputs(inside, foreshortened)
    return jnp.exp((inputs * calibration.size[..., :-1]).sum(-1) + calibration.size[..., -1])


def size_inputs(evidence: Array, foreshortened: Array) -> Array:
    """[B, K, 3, E + 2] what the deviation of each extent follows from."""
    shape = (*foreshortened.shape, evidence.shape[-1])
    seen = jnp.stack([foreshortened, jnp.square(foreshortened)], -1)
    return jnp.concatenate([jnp.broadcast_to(evidence[..., None, :], shape), seen], -1)


def pose_covariance(
    rotation_std: Float[ArrayLike, "*batch"], translation_std: Float[ArrayLike, "*batch"]
) -> Float[Array, "*batch 6 6"]:
    """Covariance of the twist xi in T_true = T exp(xi), from standard deviations.

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
        "rotation": (num_parts, ALL_EVIDENCE + 1),
        "translation": (num_parts, ALL_EVIDENCE + 1),
        "state": (num_parts - 1, ALL_EVIDENCE + 1),
        "low": (ALL_EVIDENCE,),
        "high": (ALL_EVIDENCE,),
    }
    if "size" in section:  # older cards have none
        shapes["size"] = (num_parts, 3, ALL_EVIDENCE + 3)
    values = {}
    for name, shape in shapes.items():
        try:
            values[name] = np.asarray(section[name], np.float32)
        except (KeyError, TypeError, ValueError) as error:
            raise CaperError(f"{source}: calibration lacks numbers for {name!r}") from error
        if values[name].shape != shape or not np.isfinite(values[name]).all():
            raise CaperError(
                f"{source}: calibration {name} must be finite numbers {shape}, as this version "
                "writes them; calibrate again (caper calibrate)"
            )
    return Calibration(**values)
