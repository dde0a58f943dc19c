"""Categories and batches on which losses are tested."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.category import Category, Joint
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.types import Batch
from caper_jax.geometry.raster_order import raster_order

BOX = categories.get("box")


THIN = ((0.22, 0.020, 0.09), (0.22, 0.018, 0.09))  # two like trays: which is the base?


DEEP = ((0.22, 0.120, 0.09), (0.22, 0.010, 0.09))


CABINET = Category(
    name="cabinet",
    parts=("body", "door", "drawer"),
    joints=(Joint("revolute", 0, (0.0, 1.5)), Joint("prismatic", 0, (0.0, 0.1))),
    directions=("y", "z"),
    directions_reason="",
    unit=4.0,
    mean_size=((0.3, 0.3, 0.2), (0.3, 0.2, 0.02), (0.25, 0.05, 0.15)),
    mean_center=((0.0, 0.0, 0.0), (0.0, 0.0, 0.11), (0.0, 0.1, 0.0)),
)


def surface(rng, size, center, count):
    """Points [count, 3] on the faces of a box."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    face = rng.integers(0, 3, count)
    points[np.arange(count), face] = rng.choice([-0.5, 0.5], count)
    return points * size + center


def frames(category, sizes, seed=0, count=64):
    """A batch, one frame per entry of ``sizes`` [B, K, 3], with SciPy for the kinematics."""
    rng = np.random.default_rng(seed)
    sizes = np.asarray(sizes)
    batch, parts = sizes.shape[:2]
    types = category.joint_types
    axis = np.tile([-1.0, 0.0, 0.0], (batch, parts - 1, 1))
    if "prismatic" in types:
        axis[:, types.index("prismatic")] = [0.0, 0.0, 1.0]
    pivot = np.zeros((batch, parts - 1, 3))
    pivot[:, 0, 2] = -sizes[:, 0, 2] / 2
    center = np.zeros((batch, parts, 3))
    center[:, 0, 1], center[:, 1, 1] = -sizes[:, 0, 1] / 2, sizes[:, 1, 1] / 2
    scale = np.where(np.array(types) == "revolute", 1.0, 0.1)
    state = rng.uniform(0.4, 1.4, (batch, parts - 1)) * scale
    root = Rotation.random(batch, rng=rng)
    shift = rng.uniform(-0.1, 0.1, (batch, 3)) + [0, 0, 0.7]
    rotation, translation = [root.as_matrix()], [shift]
    for j, kind in enumerate(types):
        move = axis[:, j] * state[:, j : j + 1]
        turn = Rotation.from_rotvec(move if kind == "revolute" else 0 * move)
        moved = pivot[:, j] - turn.apply(pivot[:, j]) + (move if kind == "prismatic" else 0)
        rotation.append((root * turn).as_matrix())
        translation.append(root.apply(moved) + shift)
    rotation, translation = np.stack(rotation, 1), np.stack(translation, 1)
    labels = np.tile(np.arange(count) % parts, (batch, 1))
    local = np.zeros((batch, count, 3))
    for b, k in np.ndindex(batch, parts):
        mine = labels[b] == k
        local[b, mine] = surface(rng, sizes[b, k], center[b, k], mine.sum())
    rows = np.arange(batch)[:, None]
    points = np.einsum("bnij,bnj->bni", rotation[rows, labels], local) + translation[rows, labels]
    labels[:, 5] = -1  # residue
    pose = (rotation, translation, sizes, center, axis, pivot, state)
    # As the networks will see them: an oracle that stands for them answers point by point.
    order = raster_order(points)
    return Batch(
        points=jnp.asarray(points[rows, order], jnp.float32),
        labels=jnp.asarray(labels[rows, order], jnp.int32),
        pose=ArticulatedPose(*(jnp.asarray(values, jnp.float32) for values in pose)),
        visible=None,
        instance=None,
    )
