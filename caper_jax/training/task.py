"""Training both stages on generated batches: targets, noise of the root pose, total loss."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.equivalence import is_ambiguous, second_labels, second_reading
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.errors import check_fractions, check_least
from caper_jax.geometry import se3, so3
from caper_jax.geometry.directions import rotation_from_directions
from caper_jax.geometry.scan import in_order, scan_order
from caper_jax.networks.canonical import (
    canonicalise,
    multiply,
    part_points,
    rotate,
    transpose,
    view_rotation,
)
from caper_jax.networks.caper import NetworkConfig, PartsNetwork, RootNetwork
from caper_jax.networks.increment import increment_numbers, increment_transform
from caper_jax.networks.layers import after
from caper_jax.networks.turns import HALF_TURNS, NUM_TURNS, TURNS, turn_between, turned_pose
from caper_jax.networks.voting import vote
from caper_jax.training import losses
from caper_jax.training.losses import HeatmapKind, LossWeights
from caper_jax.training.staging import gradient_at_once


@dataclass(frozen=True)
class LossConfig:
    """What the loss depends on besides the network.

    Attributes:
      weights: of Eqs 22 and 23.
      heatmap: form of Eq 5: "exponential" (as printed), "scaled" or "linear".
      state_penalty: alpha of Eq 20.
      root_noise_deg: stage II sees clouds canonicalised with a root pose that is off by a rotation
        with this standard deviation about each axis...
      root_noise: ... and a translation with this standard deviation, in network units...
      root_noise_spread: ... both times a factor drawn log-uniformly, per sample, between this
        and one over this: errors of keyframes and of motion between frames, small and large.
      predicted_root: fraction of samples canonicalised with stage I's own (detached) prediction,
        where that is within 25 deg of the truth; with a turn head, of the truth after a turn.
      turned: with a turn head, fraction of samples whose reference is turned on purpose, half of
        them by half turns; there, only turn and increment are learned.
      root_input: what stage I sees: the "whole" object, or the "root" part's points alone, by true
        labels (Table 7).
    """

    weights: LossWeights = LossWeights()
    heatmap: HeatmapKind = "exponential"
    state_penalty: float = 20.0
    root_noise_deg: float = 4.0
    root_noise: float = 0.03
    root_noise_spread: float = 4.0
    predicted_root: float = 0.5
    turned: float = 0.2
    root_input: Literal["whole", "root"] = "whole"

    def __post_init__(self) -> None:
        noise = {"state_penalty": 0, "root_noise_deg": 0, "root_noise": 0, "root_noise_spread": 1}
        check_least("loss", self, **noise)
        check_fractions("loss", self, ("predicted_root", "turned"))


class Task:
    """Networks of one category with their loss; the training loop sees only ``loss``.

    Attributes:
      category: what is estimated.
      network: sizes of both networks.
      config: the loss.
    """

    def __init__(self, category: Category, network: NetworkConfig, config: LossConfig) -> None:
        self.category = category
        self.network = network
        self.config = config
        self.root = RootNetwork(network)
        self.parts = PartsNetwork(network, category.num_parts)
        self._mean_size = np.asarray(category.mean_size, np.float32)
        self._mean_center = np.asarray(category.mean_center, np.float32)

    def init(self, key) -> dict[str, Any]:
        """Variables of both stages: {"params": {"root", "parts"}, "batch_stats": {...}}."""
        points = jnp.zeros((2, self.network.num_points, 3))
        streams = dict(zip(("params", "sample", "dropout"), jax.random.split(key, 3), strict=True))
        both = {
            name: jax.jit(module.init, static_argnames="train")(streams, points, train=False)
            for name, module in (("root", self.root), ("parts", self.parts))
        }
        collections = sorted({c for variables in both.values() for c in variables})
        return {c: {n: v[c] for n, v in both.items() if c in v} for c in collections}

    def loss(self, params, model_state, batch, key, progress):
        """Eqs 22 + 23 on one batch.

        Args:
          params: {"root", "parts"}.
          model_state: mutable collections by name, each {"root", "parts"}.
          batch: data.synthetic.scene.Batch, metres, camera frame; points in any order.
          key: PRNG key.
          progress: fraction of the run done (unused).

        Returns:
          (loss, (new model_state, metrics)).
        """
        del progress
        keys = jax.random.split(key, 4)
        order = scan_order(batch.points)
        batch = replace(
            batch,
            points=in_order(batch.points, order),
            labels=in_order(batch.labels[..., None], order)[..., 0],
        )
        unit = self.category.unit
        seen = batch.points
        if self.config.root_input == "root":
            seen = part_points(batch.points, batch.labels == 0)
        view = view_rotation(seen, self.category.viewpoint.mean_roll)
        points = rotate(view, batch.points) * unit

        def stage_one(params, model_state, batch, view, cloud, key):
            output, new_state = self._apply("root", params, model_state, cloud, key)
            truth, labels, root_losses = self._choose_reading(batch, view, output)
            total = losses.weighted_total(self.config.weights, root_losses).mean()
            return total, (output, new_state, truth, labels, root_losses)

        total, found, done = gradient_at_once(stage_one)(
            params["root"], model_state, batch, view, rotate(view, seen) * unit, keys[0]
        )
        output, root_state, truth, labels, root_losses = found
        points = after(done, points)  # stage I's activations are not needed any more

        reference, turn = self._noisy_root(keys[1], output, truth)
        if self.network.turn_width:
            reference, turn = self._turned(keys[3], reference, turn)
        canonical = canonicalise(points, reference[:, :3, :3], reference[:, :3, 3])
        parts, parts_state = self._apply("parts", params["parts"], model_state, canonical, keys[2])
        stride = self.network.point_stride
        labels = labels[:, ::stride]
        parts_losses, metrics = self._parts_losses(canonical[:, ::stride], parts, truth, labels)
        # Seen from a turned reference, everything else would have to be said twice.
        right = (turn == 0).astype(canonical.dtype)
        metrics |= parts_losses
        metrics = {
            name: (v * right).sum() / jnp.maximum(right.sum(), 1.0) for name, v in metrics.items()
        }
        known = (labels >= 0) * right[:, None]
        found = parts.segmentation.argmax(-1) == labels
        metrics["segmentation_accuracy"] = (found * known).sum() / jnp.maximum(known.sum(), 1.0)
        if self.network.turn_width:
            parts_losses = {name: value * right for name, value in parts_losses.items()}
            parts_losses["turn"] = losses.turn_loss(parts.turn, turn)
            metrics["turn"] = parts_losses["turn"].mean()
            metrics["turn_accuracy"] = (parts.turn.argmax(-1) == turn).mean()
            reference = turned_pose(reference, jnp.asarray(TURNS)[turn])
        increment_loss, off = self._increment_loss(parts.increment, reference, truth)
        parts_losses["twist"] = increment_loss
        metrics["twist"] = increment_loss.mean()
        metrics["increment_deg"] = off

        total += losses.weighted_total(self.config.weights, parts_losses).mean()
        metrics |= {name: value.mean() for name, value in root_losses.items()}
        error = so3.geodesic_distance(self._root_rotation(output), truth.rotation[:, 0])
        metrics["root_deg"] = jnp.degrees(jax.lax.stop_gradient(error)).mean()
        new_state = {
            name: {"root": root_state[name], "parts": parts_state[name]} for name in model_state
        }
        return total, (new_state, metrics)

    def _apply(self, stage: str, params, model_state, points, key):
        """One stage, with its own ``params``, in training mode: (output, new collections)."""
        module = self.root if stage == "root" else self.parts
        sample, dropout = jax.random.split(key)
        state = {name: value[stage] for name, value in model_state.items()}
        return module.apply(
            {"params": params, **state},
            points,
            train=True,
            rngs={"sample": sample, "dropout": dropout},
            mutable=list(state),
        )

    def _targets(self, pose: ArticulatedPose, view) -> ArticulatedPose:
        """Ground truth in the viewing frame and network units."""
        unit = self.category.unit
        return ArticulatedPose(
            rotation=multiply(view[:, None], pose.rotation),
            translation=rotate(view, pose.translation) * unit,
            size=(pose.size - self._mean_size) * unit,
            box_center=(pose.box_center - self._mean_center) * unit,
            joint_axis=pose.joint_axis,
            joint_pivot=pose.joint_pivot * unit,
            joint_state=pose.joint_state * self.category.state_units,
        )

    def _root_losses(self, output, truth: ArticulatedPose) -> dict[str, jax.Array]:
        axes = ["xyz".index(axis) for axis in self.category.directions]
        directions = jnp.swapaxes(truth.rotation[:, 0], -1, -2)[:, axes]
        found = {
            "rotation": losses.rotation_loss(output.directions, directions),
            "translation": losses.translation_loss(output.translation, truth.translation[:, 0]),
        }
        if self.network.rotation == "decoupled" and self.network.vertical_correction:
            found["confidence"] = losses.confidence_loss(
                output.confidence, output.directions, directions
            )
        return found

    def _choose_reading(self, batch, view, output):
        """Truth, labels and stage I losses under the better reading of each ambiguous sample."""
        truth = self._targets(batch.pose, view)
        labels = batch.labels
        chosen = self._root_losses(output, truth)
        for equivalence in self.category.equivalences:
            other = self._targets(second_reading(batch.pose, equivalence, self.category), view)
            other_losses = self._root_losses(output, other)
            weights = self.config.weights
            better = losses.weighted_total(weights, other_losses) < losses.weighted_total(
                weights, chosen
            )
            better &= is_ambiguous(batch.pose.size, equivalence)

            def pick(new, old, better=better):
                return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

            truth = jax.tree.map(pick, other, truth)
            labels = pick(second_labels(batch.labels, equivalence), labels)
            chosen = jax.tree.map(pick, other_losses, chosen)
        return truth, labels, chosen

    def _root_rotation(self, output):
        """[B, 3, 3] by vertical correction of the predicted directions (Eq 3)."""
        rotation, _ = rotation_from_directions(
            output.directions[:, 0],
            output.directions[:, 1],
            output.confidence[:, 0],
            output.confidence[:, 1],
            self.category.directions,
        )
        return rotation

    def _noisy_root(self, key, output, truth: ArticulatedPose):
        """Reference poses: the truth with noise, or stage I's own prediction.

        Returns:
          [B, 4, 4] and the turns [B] they are off by: none, but where a turn head may learn from
          predictions that are.
        """
        config = self.config
        keys = jax.random.split(key, 4)
        batch = truth.translation.shape[0]
        spread = np.log(config.root_noise_spread)
        factor = jnp.exp(jax.random.uniform(keys[3], (batch, 1), minval=-spread, maxval=spread))
        sigma = factor * np.radians(config.root_noise_deg)
        twist = jax.random.normal(keys[0], (batch, 3)) * sigma
        shift = jax.random.normal(keys[1], (batch, 3)) * factor * config.root_noise
        rotation = multiply(truth.rotation[:, 0], so3.exp(twist))
        translation = truth.translation[:, 0] + shift
        predicted = jax.lax.stop_gradient(self._root_rotation(output))
        if self.network.turn_width:
            turn, off = turn_between(predicted, truth.rotation[:, 0])
        else:
            turn = jnp.zeros(batch, jnp.int32)
            off = so3.geodesic_distance(predicted, truth.rotation[:, 0])
        own = jax.random.uniform(keys[2], (batch,)) < config.predicted_root
        own &= off < np.radians(25.0)
        rotation = jnp.where(own[:, None, None], predicted, rotation)
        guess = jax.lax.stop_gradient(output.translation)
        reference = se3.from_rt(rotation, jnp.where(own[:, None], guess, translation))
        return reference, jnp.where(own, turn, 0)

    def _turned(self, key, reference, turn):
        """Some references turned away from where they are, with the turns they are then off by."""
        keys = jax.random.split(key, 4)
        shape = turn.shape
        half = jax.random.choice(keys[0], jnp.array(HALF_TURNS), shape)
        some = jax.random.randint(keys[1], shape, 1, NUM_TURNS)
        drawn = jnp.where(jax.random.bernoulli(keys[2], 0.5, shape), half, some)
        chosen = jax.random.bernoulli(keys[3], self.config.turned, shape) & (turn == 0)
        drawn = jnp.where(chosen, drawn, 0)
        away = transpose(jnp.asarray(TURNS)[drawn])
        return turned_pose(reference, away), jnp.where(chosen, drawn, turn)

    def _increment_loss(self, numbers, reference, truth: ArticulatedPose):
        """Eq 21 for the increment from the reference to the true root pose (Eq 10).

        Returns:
          (loss [B], mean angle in degrees between the corrected and the true rotation).
        """
        kind = self.network.increment
        true_root = se3.from_rt(truth.rotation[:, 0], truth.translation[:, 0])
        increment = se3.compose(se3.inverse(reference), true_root)
        loss = losses.twist_loss(numbers, increment_numbers(increment, kind))
        corrected = se3.compose(reference, increment_transform(numbers, kind))
        off = so3.geodesic_distance(corrected[:, :3, :3], true_root[:, :3, :3])
        return loss, jnp.degrees(jax.lax.stop_gradient(off)).mean()

    def _parts_losses(self, points, output, truth: ArticulatedPose, labels):
        """Losses of stage II, and metrics for people, both per sample."""
        config = self.config
        offsets = losses.axis_offsets(points, truth.joint_axis, truth.joint_pivot)
        distance = jnp.sqrt((offsets * offsets).sum(-1))
        heatmap = losses.heatmap_target(distance, config.heatmap)
        axis, pivot = vote(points, output.heatmap, output.offset, output.direction)
        revolute = [kind == "revolute" for kind in self.category.joint_types]
        parts = {
            "location": losses.location_loss(pivot, truth.joint_axis, truth.joint_pivot, revolute),
            "direction": losses.direction_loss(axis, truth.joint_axis),
            "heatmap": losses.heatmap_loss(output.heatmap, heatmap),
            "offset": losses.offset_loss(output.offset, offsets, heatmap),
            "state": losses.state_loss(output.state, truth.joint_state, config.state_penalty),
            "scale": losses.scale_loss(output.size, truth.size)
            + losses.scale_loss(output.center, truth.box_center),
            "segmentation": losses.segmentation_loss(output.segmentation, labels),
        }
        if self.network.joints == "direct":  # nobody votes
            del parts["heatmap"], parts["offset"]
            # Not of unit length: from an axis that points the other way no gradient leads back.
            parts["direction"] = losses.direction_loss(output.direction[:, 0], truth.joint_axis)
        off = jnp.abs(output.state - truth.joint_state)
        metrics = {}
        for number, kind in enumerate(self.category.joint_types):
            name, factor = ("deg", 180 / np.pi) if kind == "revolute" else ("unit", 1.0)
            metrics[f"state{number + 1}_{name}"] = off[:, number] * factor
        return parts, metrics
