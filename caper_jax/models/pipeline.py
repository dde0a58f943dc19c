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
from caper_jax.models.parts import PartsNetwork, increment_transform, vote
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
      confidence, degenerate, evidence: see ``estimator.Prediction``.
    """

    estimate: StageEstimate
    segmentation: Float[Array, "B N K"]
    confidence: Float[Array, "B 2"]
    degenerate: Bool[Array, "B"]
    evidence: Float[Array, "B K E"]


def run_stages(
    variables: dict[str, Any],
    cloud: Float[Array, "B N 3"],
    category: Category,
    network: NetworkConfig,
) -> StageOutputs:
    """Both stages, without the refiner.

    Args:
      variables: see ``estimator.estimate``.
      cloud: viewing frame, network units, raster order (``observation.ObservedCloud.cloud``).
      category, network: static.
    """

    def apply(stage, module, cloud):
        own = {name: collection[stage] for name, collection in variables.items()}
        return module.apply(own, cloud, train=False, space=space)

    unit = category.unit
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
    unrefined = pose
    for _ in range(network.refine_steps):
        canonical = canonicalize(cloud, pose[:, :3, :3], pose[:, :3, 3])
        output = apply("parts", parts_network, canonical)
        if output.rotation_class is not None:
            pose = rotate_pose(
                pose, select_rotation(output.rotation_class, network.rotation_classifier.margin)
            )
        pose = se3.compose(pose, increment_transform(output.increment, network.increment))
    canonical = canonicalize(cloud, pose[:, :3, :3], pose[:, :3, 3])
    parts = apply("parts", parts_network, canonical)
    axis, pivot = vote(canonical, parts.heatmap, parts.offset, parts.direction)
    mean_size = jnp.asarray(category.mean_size, cloud.dtype) * unit
    widest = jnp.asarray(np.abs(category.network_state_bounds).max(-1), cloud.dtype)
    moved = se3.log(se3.compose(se3.inverse(unrefined), pose))
    return StageOutputs(
        estimate=StageEstimate(
            root=pose,
            axis=axis,
            pivot=pivot,
            state=jnp.clip(parts.state, -_ABSURD * widest, _ABSURD * widest),
            size=jnp.clip(mean_size + parts.size, SMALLEST_SIZE * mean_size, _ABSURD * mean_size),
            center=jnp.asarray(category.mean_center, cloud.dtype) * unit
            + jnp.clip(parts.center, -_ABSURD * mean_size, _ABSURD * mean_size),
        ),
        segmentation=parts.segmentation,
        confidence=root.confidence,
        degenerate=degenerate,
        evidence=uncertainty.evidence(root.confidence, moved, parts.segmentation),
    )


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
