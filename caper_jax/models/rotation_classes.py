"""Rotation classes of the root: the 24 rotations that map the coordinate axes onto each other.

Not in the paper. A closed box seen from the front and from behind differ in little, and a
regression that cannot tell lies between them or on the wrong one. In its canonical frame the
difference is easier to see, so stage II also says by which of them its reference is off.
"""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from caper_jax.geometry.frames import multiply
from caper_jax.lie import se3


def _rotations() -> np.ndarray:
    """[24, 3, 3] signed permutation matrices of determinant one, the identity first."""
    rotations = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(matrix) > 0:
                rotations.append(matrix)
    return np.stack(rotations).astype(np.float32)


CUBE_ROTATIONS = _rotations()
NUM_CUBE_ROTATIONS = len(CUBE_ROTATIONS)
# Half turns about x, y and z: what rectangular objects are mistaken for.
HALF_TURNS = tuple(
    i for i, turn in enumerate(CUBE_ROTATIONS) if i and np.array_equal(turn, np.diag(np.diag(turn)))
)


def nearest_cube_rotation(
    reference: Float[Array, "*batch 3 3"], truth: Float[Array, "*batch 3 3"]
) -> tuple[Int[Array, "*batch"], Float[Array, "*batch"]]:
    """The class that brings a rotation nearest to another.

    Returns:
      index: int32, the t for which reference @ CUBE_ROTATIONS[t] is nearest.
      angle: radians that remain.
    """
    off = multiply(jnp.swapaxes(reference, -1, -2), truth)
    # The trace of CUBE_ROTATIONS[t].T @ off grows as the angle between the two shrinks.
    traces = jnp.einsum(
        "tij,...ij->...t", CUBE_ROTATIONS.astype(off.dtype), off, precision="highest"
    )
    index = traces.argmax(-1).astype(jnp.int32)
    cosine = (traces.max(-1) - 1) / 2
    return index, jnp.arccos(jnp.clip(cosine, -1.0, 1.0))


def log_odds(logits: Float[Array, "*batch 24"]) -> Float[Array, "*batch 24"]:
    """Log odds of every class against the identity, in nats."""
    return logits - logits[..., :1]


def rotate_pose(
    pose: Float[Array, "*#batch 4 4"], rotation: Float[Array, "*#batch 3 3"]
) -> Float[Array, "... 4 4"]:
    """Poses rotated about their own origin."""
    return se3.from_rt(multiply(pose[..., :3, :3], rotation), pose[..., :3, 3])


def select_rotation(logits: Float[Array, "*batch 24"], margin: float) -> Float[Array, "*batch 3 3"]:
    """The likeliest class; the identity unless another one leads by ``margin``.

    The margin, in nats, is there because most references are right.
    """
    kept = logits.at[..., 0].add(margin)
    return jnp.asarray(CUBE_ROTATIONS)[kept.argmax(-1)].astype(logits.dtype)
