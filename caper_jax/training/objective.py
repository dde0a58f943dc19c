"""What both stages learn: targets, reference poses, and the losses of Eqs 22 and 23.

``stage1_loss`` and ``stage2_loss`` are all that a new loss term touches: a function in
``losses``, a line in one of the two, and a weight of the same name in ``config.LossWeights``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.articulation.symmetry import apply_symmetry, is_ambiguous, permute_labels
from caper_jax.config import LossConfig, NetworkConfig
from caper_jax.geometry.frames import (
    canonicalize,
    multiply,
    part_points,
    rotate,
    transpose,
    view_rotation,
)
from caper_jax.geometry.raster_order import raster_order, to_raster_order
from caper_jax.geometry.two_axis_rotation import rotation_from_directions
from caper_jax.lie import se3, so3
from caper_jax.models.parts import (
    PartsNetwork,
    PartsOutput,
    increment_numbers,
    increment_transform,
    vote,
)
from caper_jax.models.root import RootNetwork, RootOutput
from caper_jax.models.rotation_classes import (
    CUBE_ROTATIONS,
    HALF_TURNS,
    NUM_CUBE_ROTATIONS,
    nearest_cube_rotation,
    rotate_pose,
)
from caper_jax.training import losses

PyTree = Any
Terms = dict[str, Array]
Scalar = Float[Array, ""]
Rotations = Float[Array, "batch 3 3"]
Poses = Float[Array, "batch 4 4"]
Classes = Int[Array, " batch"]

_PREDICTION_LIMIT = np.radians(25.0)  # beyond it, stage I's own root pose is no reference


@flax.struct.dataclass
class RootTargets:
    """What stage I should say, in the frame and units of its cloud.

    Attributes:
      directions: [B, 2, 3] the two axes of the root's frame.
      translation: [B, 3].
      learn_confidence: whether the confidences are learned (static).
    """

    directions: Array
    translation: Array
    learn_confidence: bool = flax.struct.field(pytree_node=False, default=True)


@flax.struct.dataclass
class PartsTargets:
    """What stage II should say of a cloud canonicalized by a reference pose, network units.

    Attributes:
      points: [B, N, 3] the points that vote, canonicalized.
      labels: [B, N] part of each point, -1 unknown.
      joint_axis: [B, J, 3] unit.
      joint_pivot: [B, J, 3].
      joint_state: [B, J] radians, or network units for prismatic joints.
      revolute: [J] which joints have a pivot.
      heatmap: [B, N, J] Eq 5; None where joints are regressed without votes.
      offset: [B, N, J, 3] from each point to its foot on each joint axis; None likewise.
      size: [B, K, 3] residual to the category's mean.
      center: [B, K, 3] residual to the category's mean.
      increment: [B, 6] or [B, 9] from the reference to the true root (Eq 10), see
        ``models.parts``.
      rotation_class: [B] by which cube rotation the reference is off; 0 for none.
    """

    points: Array
    labels: Array
    joint_axis: Array
    joint_pivot: Array
    joint_state: Array
    revolute: Array
    heatmap: Array | None
    offset: Array | None
    size: Array
    center: Array
    increment: Array
    rotation_class: Array


def stage1_loss(outputs: RootOutput, targets: RootTargets, config: LossConfig) -> Terms:
    """Losses of stage I: Eqs 17 and 18, and their weighted sum of Eq 22 without L_se.

    Returns:
      {name of a weight: [B]}, and "total" [B].
    """
    terms = {
        "rotation": losses.rotation_loss(outputs.directions, targets.directions),
        "translation": losses.translation_loss(outputs.translation, targets.translation),
    }
    if targets.learn_confidence:
        terms["confidence"] = losses.confidence_loss(
            outputs.confidence, outputs.directions, targets.directions
        )
    return {**terms, "total": losses.weighted_total(config.weights, terms)}


def stage2_loss(outputs: PartsOutput, targets: PartsTargets, config: LossConfig) -> Terms:
    """Losses of stage II: Eqs 19 to 21, and their weighted sum of Eq 23 with the L_se of Eq 22.

    The paper's tracker is the estimator trained anew, whose stage I then gives increments, learned
    by L_se (Eq 21). Here stage II gives them, and so has the term.

    Of a reference that is off by a cube rotation only that rotation and the increment are learned:
    every other target would have to be rotated with it.

    Returns:
      {name of a weight: [B]}, and "total" [B].
    """
    axis, pivot = vote(targets.points, outputs.heatmap, outputs.offset, outputs.direction)
    heatmap, offset = targets.heatmap, targets.offset
    if heatmap is None:  # not of unit length: from an axis that points back no gradient leads here
        axis = outputs.direction[:, 0]
    terms = {
        "location": losses.location_loss(
            pivot, targets.joint_axis, targets.joint_pivot, targets.revolute
        ),
        "direction": losses.direction_loss(axis, targets.joint_axis),
    }
    if heatmap is not None and offset is not None:
        terms["heatmap"] = losses.heatmap_loss(outputs.heatmap, heatmap)
        terms["offset"] = losses.offset_loss(outputs.offset, offset, heatmap)
    terms |= {
        "state": losses.state_loss(outputs.state, targets.joint_state, config.state_penalty),
        "scale": losses.scale_loss(outputs.size, targets.size)
        + losses.scale_loss(outputs.center, targets.center),
        "segmentation": losses.segmentation_loss(outputs.segmentation, targets.labels),
    }
    if outputs.rotation_class is not None:
        unrotated = (targets.rotation_class == 0).astype(axis.dtype)
        terms = {name: value * unrotated for name, value in terms.items()}
        terms["rotation_class"] = losses.rotation_class_loss(
            outputs.rotation_class, targets.rotation_class
        )
    terms["twist"] = losses.twist_loss(outputs.increment, targets.increment)
    return {**terms, "total": losses.weighted_total(config.weights, terms)}


@flax.struct.dataclass
class RootResult:
    """What stage II takes over from stage I; no gradient passes through it.

    Attributes:
      points: [B, N, 3] the cloud in the viewing frame, network units.
      labels: [B, N] part of each point, under the symmetry nearest to the prediction.
      truth: the pose under that symmetry, same frame and units; sizes and centers as residuals.
      outputs: what stage I predicted.
      model_state: mutable collections of stage I.
      metrics: scalars by name.
    """

    points: Array
    labels: Array
    truth: ArticulatedPose
    outputs: RootOutput
    model_state: PyTree
    metrics: dict[str, Array]


@dataclass(frozen=True)
class Objective:
    """The loss of both stages of one category; calling it gives that of a batch.

    A pytree whose only leaves are the numbers of ``config``: vmap over them trains variants side
    by side. ``stage1`` and ``stage2`` are the two terms of the sum, of which each depends on its
    own weights alone (``training.memory`` computes their gradients one after the other).

    Attributes:
      category: what is estimated.
      network: sizes of both networks.
      config: the loss.
    """

    category: Category
    network: NetworkConfig
    config: LossConfig = LossConfig()

    @property
    def modules(self) -> dict[str, RootNetwork | PartsNetwork]:
        """The networks, {"root", "parts"}."""
        parts = PartsNetwork(self.network, self.category.num_parts)
        return {"root": RootNetwork(self.network), "parts": parts}

    def init(self, key: Array) -> dict[str, PyTree]:
        """Variables of both stages: {"params": {"root", "parts"}, "batch_stats": {...}}."""
        points = jnp.zeros((2, self.network.num_points, 3))
        streams = dict(zip(("params", "sample", "dropout"), jax.random.split(key, 3), strict=True))
        both = {
            name: jax.jit(module.init, static_argnames="train")(streams, points, train=False)
            for name, module in self.modules.items()
        }
        collections = sorted({c for variables in both.values() for c in variables})
        return {c: {n: v[c] for n, v in both.items() if c in v} for c in collections}

    def __call__(
        self, params: PyTree, model_state: PyTree, batch: Any, key: Array, progress: Any = 0.0
    ) -> tuple[Scalar, tuple[PyTree, dict[str, Array]]]:
        """Eqs 22 + 23 on one batch.

        Args:
          params: {"root", "parts"}.
          model_state: mutable collections by name, each {"root", "parts"}.
          batch: ``data.types.Batch``, meters, camera frame; points in any order.
          key: PRNG key.
          progress: fraction of the run done (unused).

        Returns:
          (loss, (new model_state, metrics)).
        """
        del progress
        first, result = self.stage1(params["root"], model_state, batch, key)
        second, rest = self.stage2(params["parts"], model_state, stop_gradient(result), key)
        return first + second, rest

    def stage1(
        self, params: PyTree, model_state: PyTree, batch: Any, key: Array
    ) -> tuple[Scalar, RootResult]:
        """Eq 22 on one batch, and what stage II needs; ``params`` are stage I's own."""
        order = raster_order(batch.points)
        batch = replace(
            batch,
            points=to_raster_order(batch.points, order),
            labels=to_raster_order(batch.labels[..., None], order)[..., 0],
        )
        visible = batch.points
        if self.config.root_input == "root":
            visible = part_points(batch.points, batch.labels == 0)
        view = view_rotation(visible, self.category.viewpoint.camera_roll)
        unit = self.category.unit
        outputs, new_state = self._apply(
            "root", params, model_state, rotate(view, visible) * unit, jax.random.split(key, 4)[0]
        )
        truth, labels, terms = self._nearest_symmetry(outputs, batch, view)
        result = RootResult(
            points=rotate(view, batch.points) * unit,
            labels=labels,
            truth=truth,
            outputs=outputs,
            model_state=new_state,
            metrics={name: value.mean() for name, value in terms.items()},
        )
        total = losses.weighted_total(self.config.weights, terms)
        return total.mean(), stop_gradient(result)

    def stage2(
        self, params: PyTree, model_state: PyTree, result: RootResult, key: Array
    ) -> tuple[Scalar, tuple[PyTree, dict[str, Array]]]:
        """Eq 23 on one batch; ``params`` are stage II's own.

        Returns:
          (loss, (new model_state of both stages, metrics of both)).
        """
        _, noise, sample, away = jax.random.split(key, 4)
        root = self._root_rotation(result.outputs), result.outputs.translation
        reference, rotation_class = self._reference_pose(noise, *root, result.truth)
        if self.network.rotation_classifier.width:
            reference, rotation_class = rotate_references(
                away, reference, rotation_class, self.config.rotated_root
            )
        canonical = canonicalize(result.points, reference[:, :3, :3], reference[:, :3, 3])
        outputs, parts_state = self._apply("parts", params, model_state, canonical, sample)
        stride = self.network.point_stride
        if self.network.rotation_classifier.width:
            reference = rotate_pose(reference, jnp.asarray(CUBE_ROTATIONS)[rotation_class])
        targets = self._parts_targets(
            canonical[:, ::stride], result.labels[:, ::stride], result.truth, reference
        )
        targets = replace(targets, rotation_class=rotation_class)
        terms = stage2_loss(outputs, targets, self.config)
        metrics = result.metrics | self._parts_metrics(outputs, targets, terms)
        error = so3.geodesic_distance(root[0], result.truth.rotation[:, 0])
        metrics["root_deg"] = jnp.degrees(error).mean()
        new_state = {
            name: {"root": result.model_state[name], "parts": parts_state[name]}
            for name in model_state
        }
        return terms["total"].mean(), (new_state, metrics)

    def _apply(self, stage: str, params: PyTree, model_state: PyTree, points: Array, key: Array):
        """One stage, with its own ``params``, in training mode: (output, new collections)."""
        sample, dropout = jax.random.split(key)
        state = {name: value[stage] for name, value in model_state.items()}
        return self.modules[stage].apply(
            {"params": params, **state},
            points,
            train=True,
            rngs={"sample": sample, "dropout": dropout},
            mutable=list(state),
        )

    def _truth(self, pose: ArticulatedPose, view: Rotations) -> ArticulatedPose:
        """A pose in the viewing frame and network units; sizes and centers less their means."""
        unit = self.category.unit
        mean_size = np.asarray(self.category.mean_size, np.float32)
        mean_center = np.asarray(self.category.mean_center, np.float32)
        return ArticulatedPose(
            rotation=multiply(view[:, None], pose.rotation),
            translation=rotate(view, pose.translation) * unit,
            size=(pose.size - mean_size) * unit,
            box_center=(pose.box_center - mean_center) * unit,
            joint_axis=pose.joint_axis,
            joint_pivot=pose.joint_pivot * unit,
            joint_state=pose.joint_state * self.category.state_units,
        )

    def _root_targets(self, truth: ArticulatedPose) -> RootTargets:
        axes = ["xyz".index(axis) for axis in self.category.directions]
        return RootTargets(
            directions=jnp.swapaxes(truth.rotation[:, 0], -1, -2)[:, axes],
            translation=truth.translation[:, 0],
            learn_confidence=self.network.rotation == "decoupled"
            and self.network.vertical_correction,
        )

    def _nearest_symmetry(
        self, outputs: RootOutput, batch: Any, view: Rotations
    ) -> tuple[ArticulatedPose, Array, Terms]:
        """Truth, labels and losses under that declared symmetry which costs an object least."""

        def candidate(pose: ArticulatedPose, labels: Array):
            truth = self._truth(pose, view)
            terms = stage1_loss(outputs, self._root_targets(truth), self.config)
            return terms.pop("total"), (truth, labels, terms)

        cost, best = candidate(batch.pose, batch.labels)
        for symmetry in self.category.symmetries:
            pose = apply_symmetry(batch.pose, symmetry, self.category)
            other_cost, other = candidate(pose, permute_labels(batch.labels, symmetry))
            better = (other_cost < cost) & is_ambiguous(batch.pose.size, symmetry)
            cost, best = where_samples(better, (other_cost, other), (cost, best))
        return best

    def _root_rotation(self, outputs: RootOutput) -> Rotations:
        """By vertical correction of the predicted directions (Eq 3)."""
        rotation, _ = rotation_from_directions(
            outputs.directions[:, 0],
            outputs.directions[:, 1],
            outputs.confidence[:, 0],
            outputs.confidence[:, 1],
            self.category.directions,
        )
        return rotation

    def _reference_pose(
        self,
        key: Array,
        predicted: Rotations,
        predicted_translation: Float[Array, "batch 3"],
        truth: ArticulatedPose,
    ) -> tuple[Poses, Classes]:
        """The pose that canonicalizes stage II's cloud: noise on the truth, or the prediction.

        The noise stands for the motion since a keyframe (the proxy canonical space of Sec 5.3.1).

        Returns:
          Reference poses, and by which cube rotation each is off: none but where a prediction is
          and the network has a rotation classifier.
        """
        config = self.config
        keys = jax.random.split(key, 4)
        batch = truth.translation.shape[0]
        spread = jnp.log(config.root_noise_spread)
        factor = jnp.exp(jax.random.uniform(keys[3], (batch, 1), minval=-spread, maxval=spread))
        sigma = factor * jnp.radians(config.root_noise_deg)
        twist = jax.random.normal(keys[0], (batch, 3)) * sigma
        shift = jax.random.normal(keys[1], (batch, 3)) * factor * config.root_noise
        rotation = multiply(truth.rotation[:, 0], so3.exp(twist))
        translation = truth.translation[:, 0] + shift
        if self.network.rotation_classifier.width:
            rotation_class, off = nearest_cube_rotation(predicted, truth.rotation[:, 0])
        else:
            rotation_class = jnp.zeros(batch, jnp.int32)
            off = so3.geodesic_distance(predicted, truth.rotation[:, 0])
        own = jax.random.uniform(keys[2], (batch,)) < config.predicted_root
        own &= off < _PREDICTION_LIMIT
        prediction = predicted, predicted_translation
        rotation, translation = where_samples(own, prediction, (rotation, translation))
        return se3.from_rt(rotation, translation), jnp.where(own, rotation_class, 0)

    def _parts_targets(
        self,
        points: Float[Array, "batch points 3"],
        labels: Int[Array, "batch points"],
        truth: ArticulatedPose,
        reference: Poses,
    ) -> PartsTargets:
        offset = losses.axis_offsets(points, truth.joint_axis, truth.joint_pivot)
        distance = jnp.sqrt((offset * offset).sum(-1))
        heatmap = losses.heatmap_target(distance, self.config.heatmap, self.config.heatmap_gate)
        voting = self.network.joints == "voting"
        root = se3.from_rt(truth.rotation[:, 0], truth.translation[:, 0])
        increment = se3.compose(se3.inverse(reference), root)
        return PartsTargets(
            points=points,
            labels=labels,
            joint_axis=truth.joint_axis,
            joint_pivot=truth.joint_pivot,
            joint_state=truth.joint_state,
            revolute=jnp.asarray([kind == "revolute" for kind in self.category.joint_types]),
            heatmap=heatmap if voting else None,
            offset=offset if voting else None,
            size=truth.size,
            center=truth.box_center,
            increment=increment_numbers(increment, self.network.increment),
            rotation_class=jnp.zeros(labels.shape[0], jnp.int32),
        )

    def _parts_metrics(
        self, outputs: PartsOutput, targets: PartsTargets, terms: Terms
    ) -> dict[str, Array]:
        """Means over the batch; of all but rotations, over references that need none."""
        unrotated = (targets.rotation_class == 0).astype(targets.points.dtype)

        def mean(values: Array) -> Array:
            return (values * unrotated).sum() / jnp.maximum(unrotated.sum(), 1.0)

        whole = ("rotation_class", "twist")
        metrics = {
            name: value.mean() if name in whole else mean(value)
            for name, value in terms.items()
            if name != "total"
        }
        off = jnp.abs(outputs.state - targets.joint_state)
        for number, kind in enumerate(self.category.joint_types):
            name, factor = ("deg", 180 / np.pi) if kind == "revolute" else ("unit", 1.0)
            metrics[f"state{number + 1}_{name}"] = mean(off[:, number] * factor)
        known = (targets.labels >= 0) * unrotated[:, None]
        right = outputs.segmentation.argmax(-1) == targets.labels
        metrics["segmentation_accuracy"] = (right * known).sum() / jnp.maximum(known.sum(), 1.0)
        if outputs.rotation_class is not None:
            right = outputs.rotation_class.argmax(-1) == targets.rotation_class
            metrics["rotation_class_accuracy"] = right.mean()
        predicted, true = (
            increment_transform(numbers, self.network.increment)[:, :3, :3]
            for numbers in (outputs.increment, targets.increment)
        )
        off = stop_gradient(so3.geodesic_distance(predicted, true))
        metrics["increment_deg"] = jnp.degrees(off).mean()
        return metrics


jax.tree_util.register_dataclass(
    Objective, data_fields=["config"], meta_fields=["category", "network"]
)


def rotate_references(
    key: Array,
    reference: Poses,
    rotation_class: Classes,
    rate: Any,
) -> tuple[Poses, Classes]:
    """Rotates some references by cube rotations, half of them by half turns.

    Args:
      key: PRNG key.
      reference: poses.
      rotation_class: by which cube rotation each is off already; those are left alone.
      rate: share of the others that are rotated.

    Returns:
      References, and by which cube rotation each is off now.
    """
    keys = jax.random.split(key, 4)
    shape = rotation_class.shape
    half = jax.random.choice(keys[0], jnp.array(HALF_TURNS), shape)
    some = jax.random.randint(keys[1], shape, 1, NUM_CUBE_ROTATIONS)
    drawn = jnp.where(jax.random.bernoulli(keys[2], 0.5, shape), half, some)
    chosen = jax.random.bernoulli(keys[3], rate, shape) & (rotation_class == 0)
    drawn = jnp.where(chosen, drawn, 0)
    away = transpose(jnp.asarray(CUBE_ROTATIONS)[drawn])
    return rotate_pose(reference, away), jnp.where(chosen, drawn, rotation_class)


def where_samples(chosen: Bool[Array, " batch"], new: PyTree, old: PyTree) -> PyTree:
    """Leaves [B, ...] of ``new`` for the samples that are chosen, of ``old`` for the others."""

    def pick(one: Array, other: Array) -> Array:
        return jnp.where(chosen.reshape(-1, *[1] * (one.ndim - 1)), one, other)

    return jax.tree.map(pick, new, old)
