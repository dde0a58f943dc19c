"""Both stages on clouds: points -> root pose -> canonical cloud -> joints and boxes (Sec 5)."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from caper_jax import confidence
from caper_jax.articulation.category import Category
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.geometry import se3
from caper_jax.geometry.directions import rotation_from_directions
from caper_jax.geometry.scan import as_before, in_order, scan_order
from caper_jax.networks.canonical import canonicalise, multiply, rotate, transpose
from caper_jax.networks.caper import (
    NetworkConfig,
    PartsNetwork,
    RootNetwork,
    shared_neighbourhoods,
)
from caper_jax.networks.increment import increment_transform
from caper_jax.networks.sides import Reading, SidesNetwork, corrected, side_features
from caper_jax.networks.turns import chosen_turn, turned_pose
from caper_jax.networks.voting import vote

# Part sizes are residuals to a mean; nothing else keeps a regression from going below zero.
SMALLEST_SIZE = 0.01  # of the mean


@flax.struct.dataclass
class Found:
    """What both stages say of a batch of clouds, viewing frame, network units.

    Attributes:
      reading: boxes, pose and joints.
      segmentation: [B, N, K] logits.
      confidence, degenerate, evidence: see ``Prediction``.
    """

    reading: Reading
    segmentation: Any
    confidence: Any
    degenerate: Any
    evidence: Any


def read(variables: dict[str, Any], cloud, category: Category, network: NetworkConfig) -> Found:
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
    order = scan_order(cloud)
    cloud = in_order(cloud, order)
    space = shared_neighbourhoods(network, cloud)
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
    for _ in range(network.corrections):
        canonical = canonicalise(cloud, pose[:, :3, :3], pose[:, :3, 3])
        output = apply("parts", parts_network, canonical)
        if output.turn is not None:
            pose = turned_pose(pose, chosen_turn(output.turn, network.turn_margin))
        pose = se3.compose(pose, increment_transform(output.increment, network.increment))
    canonical = canonicalise(cloud, pose[:, :3, :3], pose[:, :3, 3])
    parts = apply("parts", parts_network, canonical)
    axis, pivot = vote(canonical, parts.heatmap, parts.offset, parts.direction)
    mean_size = jnp.asarray(category.mean_size, cloud.dtype) * unit
    moved = se3.log(se3.compose(se3.inverse(uncorrected), pose))
    return Found(
        reading=Reading(
            root=pose,
            axis=axis,
            pivot=pivot,
            state=parts.state,
            size=jnp.maximum(mean_size + parts.size, SMALLEST_SIZE * mean_size),
            center=jnp.asarray(category.mean_center, cloud.dtype) * unit + parts.center,
        ),
        segmentation=as_before(parts.segmentation, order),
        confidence=root.confidence,
        degenerate=degenerate,
        evidence=confidence.evidence(root.confidence, moved, parts.segmentation),
    )


def readings(
    variables: dict[str, Any], found: Found, cloud, category: Category, network: NetworkConfig
) -> list[Reading]:
    """What both stages found, and what each pass over the sides of its boxes makes of it.

    Args:
      variables: see ``estimator.estimate``.
      found: by ``read`` in this cloud.
      cloud: [B, N, 3] viewing frame, network units.
      category, network: static.
    """
    stages = [found.reading]
    if network.sides_width:
        module = SidesNetwork(network.sides_width, category.num_parts)
        own = {"params": variables["params"]["sides"]}
        for _ in range(network.sides_passes):
            output: Any = module.apply(own, features_of(found, stages[-1], cloud, category))
            stages.append(corrected(stages[-1], output))
    return stages


def features_of(found: Found, reading: Reading, cloud, category: Category):
    """``sides.side_features`` [B, F] of a reading of a cloud in which both stages found this."""
    share = jax.nn.softmax(found.segmentation)
    return side_features(reading, cloud, share, found.evidence[:, 0], category)


def articulated_pose(reading: Reading, view, category: Category) -> ArticulatedPose:
    """A reading as the camera sees it, in metres.

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
