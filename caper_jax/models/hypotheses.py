"""Several readings of one cloud, with the probability of each (not in the paper).

A closed box seen from the front looks like one seen from behind; a network that must say one thing
says the wrong one as firmly as the right one. So stage II also looks at the cloud from the
likeliest quarter and half turns of the answer (``models.rotation_classes``). How the points lie in
the boxes of each reading, and what stage II says of it, gives a score; the scores of all readings,
and one for "none of these", give their probabilities. ``training.fit_hypotheses`` fits them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import Array as AnyArray
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import NetworkConfig
from caper_jax.geometry.frames import CUBE_ROTATIONS
from caper_jax.lie import se3, so3
from caper_jax.models import plausibility, uncertainty
from caper_jax.models.encoders import shared_neighborhoods
from caper_jax.models.gravity import class_log_weights, upright_log_weight
from caper_jax.models.layers import Dense, Weights
from caper_jax.models.observation import ObservedCloud
from caper_jax.models.parts import increment_transform
from caper_jax.models.pipeline import (
    StageOutputs,
    articulated_pose,
    refinements,
    see_parts,
)
from caper_jax.models.plausibility import BoxFit, box_fit
from caper_jax.models.refiner import StageEstimate
from caper_jax.models.rotation_classes import NUM_CUBE_ROTATIONS, rotate_pose

MOST = 4  # readings of a cloud
RIGHT_DEG = 30.0  # a reading is right where every part's rotation is nearer to the truth
WIDTHS = (64, 32)  # of the hidden layers
# An answer that is this certain by itself is not compared with others: most clouds cost no more.
SETTLED = 0.995
POSSIBLE = 0.1  # another reading of more than this probability is worth a word
_SAME = np.radians(20.0)  # two readings nearer than that are one
_NEVER = -40.0  # nats
_LARGEST = 1e4


@flax.struct.dataclass
class Hypotheses:
    """Readings of a cloud, the answer first, then by probability.

    Attributes:
      pose: complete readings; camera frame, meters.
      probability: that each is right, all its rotations within 30 deg; what they lack to one is the
        chance that none of them is.
      rotation_class: how each came about: the answer turned by that one of ``CUBE_ROTATIONS``, then
        corrected by stage II; int32, 0 for the answer itself.
    """

    pose: ArticulatedPose
    probability: Float[AnyArray, "*batch H"]
    rotation_class: Int[AnyArray, "*batch H"]


@flax.struct.dataclass
class Readings:
    """What is known of R readings of B clouds before they are scored; viewing frame.

    Attributes:
      estimate: leaves [R, B, ...], network units.
      features: what ``ReadingScorer`` is given.
      rotation_class: see ``Hypotheses``.
    """

    estimate: StageEstimate
    features: Float[Array, "R B F"]
    rotation_class: Int[Array, "R B"]


class ReadingScorer(Weights, nn.Module):
    """Features of a reading -> (score [..., S] beside others, log odds [..., S] by itself)."""

    @nn.compact
    def __call__(
        self, features: Float[Array, "*readings F"], rotation_class: Int[Array, "*readings"]
    ) -> tuple[Float[Array, "*readings"], Float[Array, "*readings"]]:
        shape = features.shape[-1:]
        mean = self.param("mean", nn.initializers.zeros, shape)
        scale = self.param("scale", nn.initializers.ones, shape)
        bias = self.param("class_bias", nn.initializers.zeros, (NUM_CUBE_ROTATIONS,))
        # The score of "none of these", and the temperatures of both results: fitted last.
        self.param("none", nn.initializers.zeros, ())
        sharpness = self.param("sharpness", nn.initializers.ones, (2,))
        shift = self.param("shift", nn.initializers.zeros, ())
        hidden = jnp.arcsinh((jnp.clip(features, -_LARGEST, _LARGEST) - mean) * scale)
        for width in WIDTHS:
            hidden = nn.relu(Dense(width)(hidden))
        score, alone = jnp.moveaxis(Dense(2, kernel_init=nn.initializers.zeros)(hidden), -1, 0)
        score = sharpness[0] * (score + jnp.asarray(bias)[rotation_class])
        return score, sharpness[1] * alone + shift


def num_features(num_parts: int) -> int:
    """F of ``Readings.features``, for K parts."""
    return plausibility.num_features(num_parts) + 3


def first_reading(outputs: StageOutputs, refined: StageEstimate, fit: BoxFit) -> Readings:
    """The answer as a reading: R = 1.

    Args:
      outputs: of both stages.
      refined: the final estimate.
      fit: of it.
    """
    classes = jnp.zeros((1, len(fit.features)), jnp.int32)
    expected = jnp.zeros((len(fit.features), 1), fit.features.dtype)
    features = _features(outputs, fit, expected, 1.0)
    return Readings(jax.tree.map(lambda leaf: leaf[None], refined), features[None], classes)


def other_classes(
    outputs: StageOutputs,
    params: dict[str, Any],
    number: int,
    gravity: Float[Array, "B 3"] | None,
    category: Category,
) -> Int[Array, "R B"]:
    """The classes that are likeliest after the answer, as stage II and gravity see them.

    Args:
      outputs: of both stages, for the answer.
      params: of the scorer.
      number: R of them.
      gravity, category: see ``run_stages``.
    """
    odds = _class_logits(outputs) + params["class_bias"]
    if gravity is not None:
        rotation = outputs.estimate.root[:, :3, :3]
        odds += class_log_weights(rotation, gravity, category)
    odds = odds.at[:, 0].set(-jnp.inf)
    return jax.lax.top_k(odds, number)[1].T.astype(jnp.int32)


def other_readings(
    variables: dict[str, Any],
    observed: ObservedCloud,
    outputs: StageOutputs,
    classes: Int[Array, "R B"],
    category: Category,
    network: NetworkConfig,
) -> Readings:
    """What stage II makes of a cloud from other rotations of the answer.

    Args:
      variables: see ``estimator.estimate``.
      observed: the clouds.
      outputs: of both stages, for the answer.
      classes: the rotations.
      category, network: static.
    """
    cloud = observed.cloud
    space = shared_neighborhoods(network, cloud)
    logits = jax.nn.log_softmax(_class_logits(outputs))

    def read(classes: Int[Array, "B"]) -> tuple[StageEstimate, Float[Array, "B F"]]:
        turn = jnp.asarray(CUBE_ROTATIONS, cloud.dtype)[classes]
        start = rotate_pose(outputs.estimate.root, turn)
        estimate, seen = see_parts(variables, cloud, start, category, network, space)
        increment = increment_transform(seen.increment, network.increment)
        # As in tracking, one look gives both where the root is and all the rest.
        estimate = replace(estimate, root=se3.compose(start, increment))
        own = StageOutputs(
            estimate=estimate,
            segmentation=seen.segmentation,
            rotation_class=seen.rotation_class,
            confidence=outputs.confidence,
            degenerate=outputs.degenerate,
            evidence=uncertainty.evidence(
                outputs.confidence, se3.log(increment), seen.segmentation
            ),
        )
        refined = refinements(variables, own, cloud, category, network)[-1]
        fit = box_fit(refined, own.segmentation, own.evidence, observed, category)
        expected = jnp.take_along_axis(logits, classes[:, None], axis=1)
        return refined, _features(own, fit, expected, 0.0)

    # One after the other: side by side they leave a processor's caches, and take twice as long.
    estimate, features = jax.lax.map(read, classes)
    return Readings(estimate, features, classes)


def state_hypotheses(
    variables: dict[str, Any],
    observed: ObservedCloud,
    outputs: StageOutputs,
    refined: StageEstimate,
    fit: BoxFit,
    category: Category,
    network: NetworkConfig,
    number: int,
) -> Hypotheses:
    """The readings of a batch of clouds, with probabilities.

    Args:
      variables: with the scorer among the "params", as "hypotheses".
      observed, outputs, refined, fit: the clouds and the answer, as the estimator has them.
      category, network: static.
      number: H, static, at most ``MOST``; with 1 only the probability of the answer is computed.

    Returns:
      Leaves [B, H, ...].
    """
    params = variables["params"]["hypotheses"]
    answer = first_reading(outputs, refined, fit)
    _, alone = _score(params, answer)
    certain = jax.nn.sigmoid(alone[0] + _log_weight(answer, observed, category)[0])
    if number == 1:
        return _in_camera(answer.estimate, certain[None], answer.rotation_class, observed, category)
    classes = other_classes(outputs, params, number - 1, observed.gravity, category)
    settled = certain > SETTLED
    turns = jnp.asarray(CUBE_ROTATIONS, refined.root.dtype)[classes]
    turned = jax.tree.map(lambda leaf: jnp.stack([leaf] * (number - 1)), refined)
    turned = replace(turned, root=rotate_pose(turned.root, turns))
    left = jnp.broadcast_to((1.0 - certain) / number, classes.shape)
    alike = jnp.concatenate([certain[None], left])

    def compare():
        others = other_readings(variables, observed, outputs, classes, category, network)
        readings = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), answer, others)
        probability = probabilities(params, readings, observed, category)
        # The same for a cloud alone and in a batch: a settled one stays as it is.
        return jax.tree.map(
            lambda no, yes: jnp.where(settled.reshape(1, -1, *[1] * (no.ndim - 2)), no, yes),
            (turned, alike),
            (others.estimate, probability),
        )

    others, probability = jax.lax.cond(settled.all(), lambda: (turned, alike), compare)
    order = jnp.argsort(-probability[1:], axis=0)
    others, rest, classes = jax.tree.map(
        lambda leaf: jnp.take_along_axis(
            leaf, order.reshape(*order.shape, *[1] * (leaf.ndim - 2)), axis=0
        ),
        (others, probability[1:], classes),
    )
    estimates = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), refined, others)
    probability = jnp.concatenate([probability[:1], rest])
    classes = jnp.concatenate([answer.rotation_class, classes])
    return _in_camera(estimates, probability, classes, observed, category)


def probabilities(
    params: dict[str, Any], readings: Readings, observed: ObservedCloud, category: Category
) -> Float[Array, "R B"]:
    """The probability of each reading, beside the others and none of them.

    Args:
      params: of the scorer.
      readings: all of them, the answer first.
      observed, category: for gravity.
    """
    score = _score(params, readings)[0] + _log_weight(readings, observed, category)
    return jnp.exp(log_probabilities(params, score, repeated(readings.estimate)))[:-1]


def log_probabilities(
    params: dict[str, Any], score: Float[Array, "R B"], repeated: Bool[Array, "R B"]
) -> Float[Array, "R+1 B"]:
    """Logarithms of the probabilities of readings with these scores; the last is that of none."""
    score = jnp.where(repeated, _NEVER, score)
    none = jnp.broadcast_to(params["sharpness"][0] * params["none"], (1, score.shape[1]))
    return jax.nn.log_softmax(jnp.concatenate([score, none.astype(score.dtype)]), axis=0)


def repeated(estimate: StageEstimate) -> Bool[Array, "R B"]:
    """Which readings are the same as an earlier one: stage II may turn a root back."""
    rotation = estimate.root[..., :3, :3]
    angle = so3.geodesic_distance(rotation[:, None], rotation[None])
    earlier = np.tri(len(rotation), k=-1, dtype=bool)[..., None]
    return ((angle < _SAME) & earlier).any(axis=1)


def _score(params: dict[str, Any], readings: Readings):
    """(score, log odds by itself) [R, B]."""
    result: Any = ReadingScorer().apply(
        {"params": params}, readings.features, readings.rotation_class
    )
    return result


def _log_weight(readings: Readings, observed: ObservedCloud, category: Category):
    """[R, B] what gravity adds to scores."""
    if observed.gravity is None:
        return jnp.zeros(readings.rotation_class.shape, readings.features.dtype)
    rotation = readings.estimate.root[..., :3, :3]
    return upright_log_weight(rotation, observed.gravity[None], category)


def _class_logits(outputs: StageOutputs) -> Float[Array, "B 24"]:
    """Zeros for a network without the head of rotation classes."""
    if outputs.rotation_class is None:
        return jnp.zeros((len(outputs.confidence), NUM_CUBE_ROTATIONS), outputs.confidence.dtype)
    return outputs.rotation_class


def _features(outputs: StageOutputs, fit: BoxFit, expected, is_answer: float):
    """[B, F]: how the points lie, whether stage II would turn the reading, and whether it was
    expected before."""
    stays = jax.nn.log_softmax(_class_logits(outputs))[:, :1]
    flag = jnp.full_like(stays, is_answer)
    return jnp.concatenate([fit.features, stays, expected, flag], axis=-1)


def _in_camera(
    estimates: StageEstimate, probability, classes, observed: ObservedCloud, category: Category
) -> Hypotheses:
    """Readings [R, B, ...] as hypotheses [B, R, ...]."""
    pose = jax.vmap(lambda one: articulated_pose(one, observed.view, category))(estimates)
    return jax.tree.map(
        lambda leaf: jnp.moveaxis(leaf, 0, 1), Hypotheses(pose, probability, classes)
    )


class Stated(Protocol):
    """What ``in_words`` reads of a prediction."""

    hypotheses: Any


def possible_others(result: Stated) -> list[int]:
    """Which readings of a prediction, besides its answer, have more than 10 %."""
    if result.hypotheses is None:
        return []
    probability = np.asarray(result.hypotheses.probability)
    return [index for index in range(1, len(probability)) if probability[index] > POSSIBLE]


def in_words(result: Stated, category: Category) -> list[str]:
    """How probable an answer is, and what else the cloud may be; nothing where it is not doubted.

    Args:
      result: a ``Prediction`` without batch axes.
      category: names the parts.
    """
    if result.hypotheses is None:
        return []
    first = float(np.asarray(result.hypotheses.probability)[0])
    others = possible_others(result)
    if not others and first > 1.0 - POSSIBLE:
        return []
    lines = [f"probability that this is right: {100 * first:.0f} %"]
    rotation = np.asarray(result.hypotheses.pose.rotation, np.float64)[:, 0]
    for index in others:
        vector = Rotation.from_matrix(rotation[0].T @ rotation[index]).as_rotvec(degrees=True)
        angle = np.linalg.norm(vector)
        axis = "xyz"[int(np.abs(vector).argmax())]
        chance = 100 * float(result.hypotheses.probability[index])
        turned = f"the {category.parts[0]} turned by {angle:.0f} deg about its {axis} axis"
        lines.append(f"another reading, with {chance:.0f} %: {turned}")
    return lines
