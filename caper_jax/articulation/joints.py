"""Transforms of single joints (paper Sec 5.2.2, Eq 8 in its right form)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from caper_jax.errors import unknown_name
from caper_jax.geometry import se3, so3
from caper_jax.geometry.linalg import as_floating, unit


def revolute_transform(axis: ArrayLike, pivot: ArrayLike, angle: ArrayLike) -> jax.Array:
    """Turn by plus ``angle`` about the line through ``pivot``: ``[R | (I - R) q]``.

    R is Rodrigues' rotation about the unit axis u, ``cos I + (1 - cos) u u^T + sin hat(u)``.

    Args:
      axis: [..., 3] direction of the line, scaled to unit length here; a zero vector gives the
        identity.
      pivot: [..., 3] metres; any point of the line.
      angle: [...] radians.

    Returns:
      [..., 4, 4].
    """
    u = unit(as_floating(axis, (3,), "axis"))
    q = as_floating(pivot, (3,), "pivot")
    angle = as_floating(angle, (), "angle")
    sin, versine = jnp.sin(angle), 2 * jnp.sin(angle / 2) ** 2
    # (I - R) q from the same terms: small for small angles, where the difference q - R q would
    # be left with the rounding of q.
    turned = jnp.cross(u, q)
    shift = -sin[..., None] * turned - versine[..., None] * jnp.cross(u, turned)
    return se3.from_rt(so3.rodrigues(u, sin, versine), shift)


def prismatic_transform(axis: ArrayLike, displacement: ArrayLike) -> jax.Array:
    """Slide by plus ``displacement`` along the axis: ``[I | d u]``.

    Args:
      axis: [..., 3] direction, scaled to unit length here; a zero vector gives the identity.
      displacement: [...] metres.

    Returns:
      [..., 4, 4].
    """
    u = unit(as_floating(axis, (3,), "axis"))
    shift = u * as_floating(displacement, (), "displacement")[..., None]
    return se3.from_rt(jnp.eye(3, dtype=shift.dtype), shift)


def joint_transform(
    joint_type: str, axis: ArrayLike, pivot: ArrayLike, state: ArrayLike
) -> jax.Array:
    """Transform [..., 4, 4] of a joint at a state.

    Args:
      joint_type: "revolute" or "prismatic".
      axis: [..., 3] unit vector in the root's canonical (rest) frame.
      pivot: [..., 3] metres, same frame; ignored by a prismatic joint.
      state: [...] radians or metres from the rest pose; positive opens.

    Raises:
      CaperError: unknown joint type.
    """
    if joint_type == "revolute":
        return revolute_transform(axis, pivot, state)
    if joint_type == "prismatic":
        return prismatic_transform(axis, state)
    raise unknown_name("joint type", joint_type, ("revolute", "prismatic"))
