"""Both stages on clouds: points -> root pose -> canonical cloud -> joints and boxes (Sec 5)."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from caper_jax.articulation.category import Category
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import NetworkConfig
from caper_jax.geometry.frames import canonicalize, multiply, rotate, transpose
from caper_jax.geometry.raster_order import from_raster_order, raster_order, to_raster_order
from caper_jax.geometry.two_axis_rotation import rotation_from_directions
from caper_jax.lie import se3
from caper_jax.models import uncertainty
from caper_jax.models.encoders import shared_neighborhoods
from caper_jax.models.parts import PartsNetwork, increment_transform, vote
from caper_jax.models.refiner import BoxRefiner, StageEstimate, apply_residual, refiner_features
from caper_jax.models.root import RootNetwork
from caper_jax.models.rotation_classes import rotate_pose, select_rotation

# Part sizes are residuals to a mean; nothing else keeps a regression from going below zero.
SMALLEST_SIZE = 0.01  # of the mean


@flax.struct.dataclass
class StageOutputs:
    """What both stages say of a batch of clouds, viewing frame, network units.

    Attributes:
      reading: boxes, pose and joints.
      segmentation: [B, N, K] logits.
      confidence, degenerate, evidence: see ``Prediction``.
    """

    reading: StageEstimate
    segmentation: Any
    confidence: Any
    degenerate: Any
    evidence: Any


def read(
    variables: dict[str, Any], cloud, category: Category, network: NetworkConfig
) -> StageOutputs:
    """Both stages, before the sides of the boxes correct what they found.

    Args:
      variables: see ``estimate``.
      cloud: [B, N, 3] viewing frame, network units; in any order.
      category, network: static.
    """

    def apply(stage, module, cloud):
        own = {name: collection[stage] for name, collection in variables.items()}
        return module.apply(own, cloud, train=False, space=space)

    unit = category.unit
    order = raster_order(cloud)
    cloud = to_raster_order(cloud, order)
    space = shared_neighborhoods(network, cloud)
    root = apply("root", RootNetwork(network), cloud)
    rotation, degenerate = rotation_from_directions(
        root.directions[:, 0],
        root.directions[:, 1],
        root.confidence[:, 0],
        root.confidence[:, 1],
        category.directions,
    )
    pose = se3.from_rt(rotation, root.translation)
    parts_network = PartsNetwork(network, category.num_parts)
    uncorrected = pose
    for _ in range(network.refine_steps):
        canonical = canonicalize(cloud, pose[:, :3, :3], pose[:, :3, 3])
        output = apply("parts", parts_network, canonical)
        if output.turn is not None:
            pose = rotate_pose(
                pose, select_rotation(output.turn, network.rotation_classifier.margin)
            )
        pose = se3.compose(pose, increment_transform(output.increment, network.increment))
    canonical = canonicalize(cloud, pose[:, :3, :3], pose[:, :3, 3])
    parts = apply("parts", parts_network, canonical)
    axis, pivot = vote(canonical, parts.heatmap, parts.offset, parts.direction)
    mean_size = jnp.asarray(category.mean_size, cloud.dtype) * unit
    moved = se3.log(se3.compose(se3.inverse(uncorrected), pose))
    return StageOutputs(
        reading=StageEstimate(
            root=pose,
            axis=axis,
            pivot=pivot,
            state=parts.state,
            size=jnp.maximum(mean_size + parts.size, SMALLEST_SIZE * mean_size),
            center=jnp.asarray(category.mean_center, cloud.dtype) * unit + parts.center,
        ),
        segmentation=from_raster_order(parts.segmentation, order),
        confidence=root.confidence,
        degenerate=degenerate,
        evidence=uncertainty.evidence(root.confidence, moved, parts.segmentation),
    )


def refinements(
    variables: dict[str, Any],
    found: StageOutputs,
    cloud,
    category: Category,
    network: NetworkConfig,
) -> list[StageEstimate]:
    """What both stages found, and what each pass over the sides of its boxes makes of it.

    Args:
      variables: see ``estimator.estimate``.
      found: by ``read`` in this cloud.
      cloud: [B, N, 3] viewing frame, network units.
      category, network: static.
    """
    stages = [found.reading]
    if network.refiner.width:
        module = BoxRefiner(network.refiner.width, category.num_parts)
        own = {"params": variables["params"]["refiner"]}
        for _ in range(network.refiner.iterations):
            output: Any = module.apply(own, refiner_inputs(found, stages[-1], cloud, category))
            stages.append(apply_residual(stages[-1], output))
    return stages


def refiner_inputs(found: StageOutputs, reading: StageEstimate, cloud, category: Category):
    """``refiner.refiner_features`` [B, F] of an estimate of a cloud with these stage outputs."""
    share = jax.nn.softmax(found.segmentation)
    return refiner_features(reading, cloud, share, found.evidence[:, 0], category)


def articulated_pose(reading: StageEstimate, view, category: Category) -> ArticulatedPose:
    """A reading as the camera sees it, in meters.

    Args:
      reading: viewing frame, network units.
      view: [B, 3, 3] camera -> viewing frame.
      category: static.
    """
    unit, back = category.unit, transpose(view)
    state_units = jnp.asarray(category.state_units, reading.state.dtype)
    pivot, state = reading.pivot / unit, reading.state / state_units
    translation = rotate(back, reading.root[:, None, :3, 3])[:, 0] / unit
    poses = forward_kinematics(
        se3.from_rt(multiply(back, reading.root[:, :3, :3]), translation),
        reading.axis,
        pivot,
        state,
        category.joint_types,
        category.parents,
    )
    return ArticulatedPose(
        rotation=poses[..., :3, :3],
        translation=poses[..., :3, 3],
        size=reading.size / unit,
        box_center=reading.center / unit,
        joint_axis=reading.axis,
        joint_pivot=pivot,
        joint_state=state,
    )
