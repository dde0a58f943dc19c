"""Registration of a cloud to the surface seen so far, on the kinematic tree.

Beyond the paper: its network says in one pass how far the object moved, and is right to a degree
or two; the clouds themselves say it to a tenth of that. The clouds of keyframes become a few
hundred Gaussians (local mean and covariance, so that noise averages out and normals need no
search), each in the frame of its part; a later keyframe adds only what was not seen before, so that
what was seen first stays where it was. Every point of a new cloud is matched with the nearest
Gaussian, and Gauss-Newton steps on the root's twist and the joint states minimize the robust
Mahalanobis distances. All of it is differentiable but the choice of matches.

Lengths are network units; a joint's state is radians or network units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from caper_jax.articulation.kinematics import joint_transforms
from caper_jax.config import RegistrationConfig
from caper_jax.lie import linalg, se3
from caper_jax.models.encoders.neighbors import gather, smallest, squared_distances

_NOWHERE = 1e3  # where Gaussians lie that are none


@flax.struct.dataclass
class SurfaceMap:
    """Gaussians on the parts' surfaces, each in the frame of its part.

    Attributes:
      mean: [M, 3]; far away where there is none yet.
      information: [M, 3, 3] inverse covariances, across the surface only.
      labels: [M] int32 part of each.
      added: [] int32, how many were ever added; the next one takes the place ``added`` modulo M.
    """

    mean: Float[Array, "M 3"]
    information: Float[Array, "M 3 3"]
    labels: Int[Array, "M"]
    added: Int[Array, ""]


@flax.struct.dataclass
class JointTree:
    """The joints of an object, in the root's canonical frame.

    Attributes:
      axis: [J, 3] unit vectors.
      pivot: [J, 3].
      types, parents: static, see ``forward_kinematics``.
    """

    axis: Float[Array, "J 3"]
    pivot: Float[Array, "J 3"]
    types: tuple[str, ...] = flax.struct.field(pytree_node=False)
    parents: tuple[int, ...] = flax.struct.field(pytree_node=False)


@flax.struct.dataclass
class PartPoses:
    """Part poses as functions of the joint states, exact at the keyframe.

    Attributes:
      tree: joints.
      state: [J] of the keyframe.
      poses: [K, 4, 4] part poses in the root's frame there.
    """

    tree: JointTree
    state: Float[Array, "J"]
    poses: Float[Array, "K 4 4"]

    def at(self, state):
        """[K, 4, 4] poses at joint states [J]: the keyframe's, moved by the joints (Eq 8)."""
        before, after = part_poses(self.tree, self.state), part_poses(self.tree, state)
        return se3.compose(se3.compose(after, se3.inverse(before)), self.poses)


def part_poses(tree: JointTree, state):
    """[K, 4, 4] poses of the parts in the root's frame."""
    moves = joint_transforms(tree.types, tree.axis, tree.pivot, state)
    poses = [jnp.eye(4, dtype=moves.dtype)]
    for joint, parent in enumerate(tree.parents):
        poses.append(se3.compose(poses[parent], moves[joint]))
    return jnp.stack(poses)


def empty_surface(config: RegistrationConfig) -> SurfaceMap:
    """No Gaussians."""
    size = config.capacity
    return SurfaceMap(
        mean=jnp.full((size, 3), _NOWHERE),
        information=jnp.tile(jnp.eye(3), (size, 1, 1)),
        labels=jnp.zeros(size, jnp.int32),
        added=jnp.asarray(0, jnp.int32),
    )


def extend_surface(surface: SurfaceMap, points, labels, config: RegistrationConfig) -> SurfaceMap:
    """A surface with what a cloud shows of it for the first time.

    Args:
      surface: so far.
      points: [N, 3] each in the frame of its part.
      labels: [N] int32.
      config: sizes.
    """
    count = min(config.gaussians, points.shape[0])
    chosen = np.arange(count) * points.shape[0] // count  # evenly, the last ones too
    centers, kinds = points[chosen], labels[chosen]
    squared = squared_distances(centers[None], points[None])[0]
    weight = jnp.exp(-0.5 * squared / config.window**2) * (kinds[:, None] == labels)
    x, y, z = points.T
    moments = jnp.stack([x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], -1)
    moments = jnp.matmul(weight, moments, precision="highest")
    moments /= jnp.maximum(weight.sum(-1, keepdims=True), 1e-6)
    mean = moments[:, :3]
    second = moments[:, 3:][:, np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])]
    covariance = second - mean[:, :, None] * mean[:, None, :]
    covariance += config.noise**2 * jnp.eye(3, dtype=points.dtype)

    known = squared_distances(mean[None], surface.mean[None])[0]
    known = jnp.where(kinds[:, None] == surface.labels, known, jnp.inf).min(-1)
    new = known > config.window**2
    rank = jnp.cumsum(new) - 1
    at = jnp.where(new, (surface.added + rank) % config.capacity, config.capacity)
    return SurfaceMap(
        mean=surface.mean.at[at].set(mean, mode="drop"),
        information=surface.information.at[at].set(_across(_inverse(covariance)), mode="drop"),
        labels=surface.labels.at[at].set(kinds, mode="drop"),
        added=surface.added + new.sum(dtype=jnp.int32),
    )


def move_surface(surface: SurfaceMap, motions) -> SurfaceMap:
    """The surface after a change of the parts' frames: [K, 4, 4], old frame -> new frame."""
    motion = motions[surface.labels]
    turn = motion[:, :3, :3]
    information = linalg.multiply(
        linalg.multiply(turn, surface.information), linalg.transpose(turn)
    )
    mean = se3.act(motion, surface.mean[:, None])[:, 0]
    return replace(surface, mean=mean, information=information)


def register(
    surface: SurfaceMap,
    parts: PartPoses,
    points,
    labels,
    start,
    expected,
    config: RegistrationConfig,
):
    """Root pose and joint states at which a cloud lies on the surface.

    Args:
      surface: seen so far.
      parts: gives the part poses at any joint states.
      points: [N, 3] camera frame.
      labels: [N] int32 parts.
      start: (root pose [4, 4], joint states [J]) where the search starts.
      expected: pairs of such a pose with its standard deviations [6 + J]; what the result is
        drawn to, and all that decides about what nothing in view determines.
      config: steps and weights.

    Returns:
      (root [4, 4], state [J], information [6 + J, 6 + J] of (twist, states) in the last step).
    """
    joints = start[1].shape[0]

    def gauss_newton(pose, _):
        root, state = pose
        residual, jacobian, weight, matrix = _linearize(
            surface, parts, points, labels, root, state, config
        )
        weighted = jnp.einsum("nab,nbd->nad", matrix, jacobian, precision="highest")
        weighted *= weight[:, None, None]
        flat = weighted.reshape(-1, 6 + joints)
        information = jnp.matmul(flat.T, jacobian.reshape(flat.shape), precision="highest")
        gradient = jnp.matmul(flat.T, residual.reshape(-1), precision="highest")
        total = information
        for (there, there_state), sigma in expected:
            away = se3.log(se3.compose(se3.inverse(there), root))
            prior = 1.0 / jnp.square(sigma)
            gradient += prior * jnp.concatenate([away, state - there_state])
            total += jnp.diag(prior)
        step = -jnp.linalg.solve(total, gradient)
        return (se3.compose(root, se3.exp(step[:6])), state + step[6:]), information

    # A loop, not written out: it compiles in a third of the time.
    (root, state), information = jax.lax.scan(gauss_newton, start, length=config.steps)
    return root, state, information[-1]


def suppress_jitter(before, root, information, threshold: float):
    """A root pose drawn back to the one before, as far as the motion is within its uncertainty.

    The positive-part James-Stein estimate of the motion: zero up to the threshold, all of it far
    beyond.

    Args:
      before: [4, 4] root pose of the last frame.
      root: [4, 4] of this frame.
      information: [6 + J, 6 + J] from ``register``; joint states are marginalized out.
      threshold: squared Mahalanobis distance.
    """
    xi = se3.log(se3.compose(se3.inverse(before), root))
    joint = information[6:, 6:] + 1e-3 * jnp.eye(information.shape[0] - 6, dtype=xi.dtype)
    cross = information[:6, 6:]
    marginal = information[:6, :6] - cross @ jnp.linalg.solve(joint, cross.T)
    squared = xi @ marginal @ xi
    moved = squared > threshold
    share = jnp.where(moved, 1.0 - threshold / jnp.where(moved, squared, 1.0), 0.0)
    return se3.compose(before, se3.exp(share * xi))


def match_cost(
    surface: SurfaceMap, parts: PartPoses, points, labels, pose, config: RegistrationConfig
):
    """Mean robust distance [] of a cloud from the surface, in [0, 1]: 1 is no match.

    Args as for ``register``; ``pose`` is (root [4, 4], joint states [J]).
    """
    root, state = pose
    residual, matrix, _, _ = _residuals(surface, parts, points, labels, root, state, config)
    squared = (residual * linalg.apply(matrix, residual)).sum(-1)
    ratio = squared / config.robust**2
    return (ratio / (1.0 + ratio)).mean()


def _residuals(surface, parts, points, labels, root, state, config):
    """(residual [N, 3], information [N, 3, 3], points [N, 3], all in the root's frame; matches)."""
    poses = parts.at(state)
    here = se3.act(se3.inverse(root), points)
    mean = se3.act(poses[surface.labels], surface.mean[:, None])[:, 0]
    squared = squared_distances(here[None], mean[None])[0]
    squared += jnp.where(labels[:, None] == surface.labels, 0.0, config.wrong_part**2)
    at = smallest(squared)
    turn = poses[surface.labels[at]][:, :3, :3]
    matrix = linalg.multiply(
        linalg.multiply(turn, gather(surface.information[None], at[None])[0]),
        linalg.transpose(turn),
    )
    residual = here - gather(mean[None], at[None])[0]
    return residual, matrix, here, at


def _linearize(surface, parts, points, labels, root, state, config):
    """Residuals [N, 3], their Jacobian [N, 3, 6 + J], robust weights [N], information."""
    residual, matrix, here, at = _residuals(surface, parts, points, labels, root, state, config)
    squared = (residual * linalg.apply(matrix, residual)).sum(-1)
    weight = config.share / (1.0 + squared / config.robust**2) ** 2
    # root -> root exp(xi) moves a point in the root's frame by -(w x p + rho).
    zero = jnp.zeros_like(here[:, 0])
    x, y, z = here.T
    turn = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    columns = [turn, -jnp.broadcast_to(jnp.eye(3, dtype=here.dtype), turn.shape)]
    tree = parts.tree
    axis, pivot = _moved_joints(tree, state)
    carried = jnp.asarray(_carried(tree.parents), here.dtype)
    target = here - residual
    for joint, kind in enumerate(tree.types):
        if kind == "revolute":
            motion = linalg.cross(
                jnp.broadcast_to(axis[joint], target.shape), target - pivot[joint]
            )
        else:
            motion = jnp.broadcast_to(axis[joint], target.shape)
        moves = carried[joint][surface.labels[at]]
        columns.append(-(motion * moves[:, None])[..., None])
    return residual, jnp.concatenate(columns, -1), weight, matrix


def _moved_joints(tree: JointTree, state):
    """Axes and pivots [J, 3] where the joints stand at a state, in the root's frame."""
    poses = part_poses(tree, state)[np.array(tree.parents, int)]
    axis = linalg.apply(poses[:, :3, :3], tree.axis)
    return axis, linalg.apply(poses[:, :3, :3], tree.pivot) + poses[:, :3, 3]


def _carried(parents: Sequence[int]) -> np.ndarray:
    """[J, K] float: whether joint j moves part k."""
    joints = len(parents)
    carried = np.zeros((joints, joints + 1), np.float32)
    for child in range(1, joints + 1):
        part = child
        while part:
            carried[part - 1, child] = 1.0
            part = parents[part - 1]
    return carried


def _across(information):
    """Information [..., 3, 3] across the surface only.

    Along it a Gaussian is as wide as its window, which says nothing about where a point should
    lie; yet on a link that turns under the camera many small pulls would hold it back. The square
    over the trace keeps the largest eigenvalue and all but removes the others.
    """
    trace = jnp.trace(information, axis1=-2, axis2=-1)[..., None, None]
    return linalg.multiply(information, information) / trace


def _inverse(matrix):
    """Inverse [..., 3, 3] of symmetric positive matrices, by cofactors."""
    a, b, c = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    cofactors = jnp.stack([linalg.cross(b, c), linalg.cross(c, a), linalg.cross(a, b)], -1)
    return cofactors / linalg.dot(a, cofactors[..., 0])[..., None, None]
