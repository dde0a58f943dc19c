"""Training both stages on generated batches: targets, noise of the root pose, total loss."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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
from caper_jax.models.layers import after
from caper_jax.models.parts import PartsNetwork, increment_numbers, increment_transform, vote
from caper_jax.models.root import RootNetwork
from caper_jax.models.rotation_classes import (
    CUBE_ROTATIONS,
    HALF_TURNS,
    NUM_CUBE_ROTATIONS,
    nearest_cube_rotation,
    rotate_pose,
)
from caper_jax.training import losses
from caper_jax.training.eager_gradient import value_with_eager_gradient


class Objective:
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
          batch: ``data.types.Batch``, meters, camera frame; points in any order.
          key: PRNG key.
          progress: fraction of the run done (unused).

        Returns:
          (loss, (new model_state, metrics)).
        """
        del progress
        keys = jax.random.split(key, 4)
        order = raster_order(batch.points)
        batch = replace(
            batch,
            points=to_raster_order(batch.points, order),
            labels=to_raster_order(batch.labels[..., None], order)[..., 0],
        )
        unit = self.category.unit
        seen = batch.points
        if self.config.root_input == "root":
            seen = part_points(batch.points, batch.labels == 0)
        view = view_rotation(seen, self.category.viewpoint.camera_roll)
        points = rotate(view, batch.points) * unit

        def stage_one(params, model_state, batch, view, cloud, key):
            output, new_state = self._apply("root", params, model_state, cloud, key)
            truth, labels, root_losses = self._choose_reading(batch, view, output)
            total = losses.weighted_total(self.config.weights, root_losses).mean()
            return total, (output, new_state, truth, labels, root_losses)

        total, found, done = value_with_eager_gradient(stage_one)(
            params["root"], model_state, batch, view, rotate(view, seen) * unit, keys[0]
        )
        output, root_state, truth, labels, root_losses = found
        points = after(done, points)  # stage I's activations are not needed any more

        reference, turn = self._noisy_root(keys[1], output, truth)
        if self.network.rotation_classifier.width:
            reference, turn = self._turned(keys[3], reference, turn)
        canonical = canonicalize(points, reference[:, :3, :3], reference[:, :3, 3])
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
        if self.network.rotation_classifier.width:
            parts_losses = {name: value * right for name, value in parts_losses.items()}
            parts_losses["rotation_class"] = losses.rotation_class_loss(parts.rotation_class, turn)
            metrics["rotation_class"] = parts_losses["rotation_class"].mean()
            metrics["rotation_class_accuracy"] = (parts.rotation_class.argmax(-1) == turn).mean()
            reference = rotate_pose(reference, jnp.asarray(CUBE_ROTATIONS)[turn])
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
        for symmetry in self.category.symmetries:
            other = self._targets(apply_symmetry(batch.pose, symmetry, self.category), view)
            other_losses = self._root_losses(output, other)
            weights = self.config.weights
            better = losses.weighted_total(weights, other_losses) < losses.weighted_total(
                weights, chosen
            )
            better &= is_ambiguous(batch.pose.size, symmetry)

            def pick(new, old, better=better):
                return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

            truth = jax.tree.map(pick, other, truth)
            labels = pick(permute_labels(batch.labels, symmetry), labels)
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
        if self.network.rotation_classifier.width:
            turn, off = nearest_cube_rotation(predicted, truth.rotation[:, 0])
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
        some = jax.random.randint(keys[1], shape, 1, NUM_CUBE_ROTATIONS)
        drawn = jnp.where(jax.random.bernoulli(keys[2], 0.5, shape), half, some)
        chosen = jax.random.bernoulli(keys[3], self.config.rotated_root, shape) & (turn == 0)
        drawn = jnp.where(chosen, drawn, 0)
        away = transpose(jnp.asarray(CUBE_ROTATIONS)[drawn])
        return rotate_pose(reference, away), jnp.where(chosen, drawn, turn)

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
