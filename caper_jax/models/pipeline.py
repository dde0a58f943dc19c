"""Both stages on clouds: points -> root pose -> canonical cloud -> joints and boxes (Sec 5).

Networks work in the viewing frame (``geometry.frames.view_rotation``) and in network units, meters
times ``Category.unit``.
"""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.config import NetworkConfig
from caper_jax.geometry.frames import canonicalize, multiply, rotate
from caper_jax.geometry.two_axis_rotation import rotation_from_directions
from caper_jax.lie import se3
from caper_jax.lie.linalg import transpose
from caper_jax.models import uncertainty
from caper_jax.models.encoders import shared_neighborhoods
from caper_jax.models.gravity import class_log_weights
from caper_jax.models.parts import PartsNetwork, PartsOutput, increment_transform, vote
from caper_jax.models.refiner import BoxRefiner, StageEstimate, apply_residual, refiner_features
from caper_jax.models.root import RootNetwork
from caper_jax.models.rotation_classes import rotate_pose, select_rotation

# Part sizes are residuals to a mean; nothing else keeps a regression from going below zero.
SMALLEST_SIZE = 0.01  # of the mean
# Clouds that are no object make networks say anything: beyond so many mean sizes, and ranges of
# joints, numbers only overflow.
_ABSURD = 100.0


@flax.struct.dataclass
class StageOutputs:
    """Outputs of both stages for a batch of clouds, viewing frame, network units.

    Attributes:
      estimate: pose, joints and boxes.
      segmentation: logits.
      rotation_class: logits of ``models.rotation_classes``, by which of them the estimate is still
        off; None without that head.
      confidence, degenerate, evidence: see ``estimator.Prediction``.
    """

    estimate: StageEstimate
    segmentation: Float[Array, "B N K"]
    rotation_class: Float[Array, "B 24"] | None
    confidence: Float[Array, "B 2"]
    degenerate: Bool[Array, "B"]
    evidence: Float[Array, "B K E"]


def run_stages(
    variables: dict[str, Any],
    cloud: Float[Array, "B N 3"],
    category: Category,
    network: NetworkConfig,
    gravity: Float[Array, "B 3"] | None = None,
) -> StageOutputs:
    """Both stages, without the refiner.

    Args:
      variables: see ``estimator.estimate``.
      cloud: viewing frame, network units, raster order (``observation.ObservedCloud.cloud``).
      category, network: static.
      gravity: unit vector in the viewing frame, zeros where it is unknown.
    """

    space = shared_neighborhoods(network, cloud)
    own = {name: collection["root"] for name, collection in variables.items()}
    root: Any = RootNetwork(network).apply(own, cloud, train=False, space=space)
    rotation, degenerate = rotation_from_directions(
        root.directions[:, 0],
        root.directions[:, 1],
        root.confidence[:, 0],
        root.confidence[:, 1],
        category.directions,
    )
    pose = unrefined = se3.from_rt(rotation, root.translation)
    for _ in range(network.refine_steps):
        _, output = see_parts(variables, cloud, pose, category, network, space)
        if output.rotation_class is not None:
            logits = output.rotation_class
            if gravity is not None:
                logits += class_log_weights(pose[:, :3, :3], gravity, category)
            pose = rotate_pose(pose, select_rotation(logits, network.rotation_classifier.margin))
        pose = se3.compose(pose, increment_transform(output.increment, network.increment))
    estimate, parts = see_parts(variables, cloud, pose, category, network, space)
    moved = se3.log(se3.compose(se3.inverse(unrefined), pose))
    return StageOutputs(
        estimate=estimate,
        segmentation=parts.segmentation,
        rotation_class=parts.rotation_class,
        confidence=root.confidence,
        degenerate=degenerate,
        evidence=uncertainty.evidence(root.confidence, moved, parts.segmentation),
    )


def see_parts(
    variables: dict[str, Any],
    cloud: Float[Array, "B N 3"],
    pose: Float[Array, "B 4 4"],
    category: Category,
    network: NetworkConfig,
    space: Any,
) -> tuple[StageEstimate, PartsOutput]:
    """Stage II of clouds whose roots are in given poses: the whole estimate, and all it says.

    Args:
      variables, cloud, category, network: see ``run_stages``.
      pose: of the roots, viewing frame, network units.
      space: of ``shared_neighborhoods`` for the cloud.
    """
    own = {name: collection["parts"] for name, collection in variables.items()}
    canonical = canonicalize(cloud, pose[:, :3, :3], pose[:, :3, 3])
    module = PartsNetwork(network, category.num_parts)
    parts: Any = module.apply(own, canonical, train=False, space=space)
    axis, pivot = vote(canonical, parts.heatmap, parts.offset, parts.direction)
    mean_size = jnp.asarray(category.mean_size, cloud.dtype) * category.unit
    mean_center = jnp.asarray(category.mean_center, cloud.dtype) * category.unit
    widest = jnp.asarray(np.abs(category.network_state_bounds).max(-1), cloud.dtype)
    estimate = StageEstimate(
        root=pose,
        axis=axis,
        pivot=pivot,
        state=jnp.clip(parts.state, -_ABSURD * widest, _ABSURD * widest),
        size=jnp.clip(mean_size + parts.size, SMALLEST_SIZE * mean_size, _ABSURD * mean_size),
        center=mean_center + jnp.clip(parts.center, -_ABSURD * mean_size, _ABSURD * mean_size),
    )
    return estimate, parts


def refinements(
    variables: dict[str, Any],
    outputs: StageOutputs,
    cloud: Float[Array, "B N 3"],
    category: Category,
    network: NetworkConfig,
) -> list[StageEstimate]:
    """The estimate of both stages, and what each iteration of the refiner makes of it.

    Args:
      variables: see ``estimator.estimate``.
      outputs: of ``run_stages`` for this cloud.
      cloud: viewing frame, network units.
      category, network: static.
    """
    estimates = [outputs.estimate]
    if network.refiner.width:
        module = BoxRefiner(network.refiner.width, category.num_parts)
        own = {"params": variables["params"]["refiner"]}
        for _ in range(network.refiner.iterations):
            residual: Any = module.apply(
                own, refiner_inputs(outputs, estimates[-1], cloud, category)
            )
            estimates.append(apply_residual(estimates[-1], residual))
    return estimates


def refiner_inputs(
    outputs: StageOutputs, estimate: StageEstimate, cloud: Float[Array, "B N 3"], category: Category
) -> Float[Array, "B F"]:
    """``refiner.refiner_features`` of an estimate of a cloud with these stage outputs."""
    share = jax.nn.softmax(outputs.segmentation)
    return refiner_features(estimate, cloud, share, outputs.evidence[:, 0], category)


def articulated_pose(
    estimate: StageEstimate, view: Float[Array, "B 3 3"], category: Category
) -> ArticulatedPose:
    """An estimate in the camera frame, in meters; states stay within ``Category.state_bounds``.

    Args:
      estimate: viewing frame, network units.
      view: camera -> viewing frame.
      category: static.
    """
    unit, back = category.unit, transpose(view)
    state_units = jnp.asarray(category.state_units, estimate.state.dtype)
    pivot, state = estimate.pivot / unit, estimate.state / state_units
    low, high = category.state_bounds.astype(state.dtype).T
    state = jnp.clip(state, low, high)
    translation = rotate(back, estimate.root[:, None, :3, 3])[:, 0] / unit
    poses = forward_kinematics(
        se3.from_rt(multiply(back, estimate.root[:, :3, :3]), translation),
        estimate.axis,
        pivot,
        state,
        category.joint_types,
        category.parents,
    )
    return ArticulatedPose(
        rotation=poses[..., :3, :3],
        translation=poses[..., :3, 3],
        size=estimate.size / unit,
        box_center=estimate.center / unit,
        joint_axis=estimate.axis,
        joint_pivot=pivot,
        joint_state=state,
    )
