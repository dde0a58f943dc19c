"""Hessians of pose losses by the increment, against differences of the gradient in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.lie import se3

AXIS = np.array([0.6, -0.48, 0.64])
PI = np.pi
ANGLES = (0.0, 1e-9, 1e-6, 1e-3, 0.3, 0.999, 1.001, 2.0, 3.0, PI - 1e-3, PI - 1e-5)
POINTS = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
OBSERVED = POINTS + np.random.default_rng(1).normal(0, 0.1, (10, 3)).astype(np.float32)


def points(pose):
    return jnp.square(se3.act(pose, POINTS) - OBSERVED).sum()


def twist(pose):
    return jnp.square(se3.log(pose)).sum()


def twists(angle):
    return np.concatenate([angle * AXIS, [0.1, -0.2, 0.3]])


@pytest.mark.parametrize("loss", [points, twist], ids=lambda loss: loss.__name__)
def test_hessians_by_the_increment(loss):
    """Of zero increments from poses of all angles, and of increments of all angles.

    In float32 as well; at pi itself, where the logarithm jumps, only finite numbers are asked for.
    """

    def function(xi, pose):
        return loss(se3.compose(pose, se3.exp(xi)))

    hessians = jax.jit(jax.vmap(jax.hessian(function)))
    gradients = jax.jit(jax.vmap(jax.grad(function)))
    turned = np.stack([twists(angle) for angle in (*ANGLES, PI)])
    still = np.zeros_like(turned)
    xi = np.concatenate([still, turned])
    with jax.enable_x64(True):
        poses = np.asarray(se3.exp(np.concatenate([turned, still])))
        found = np.asarray(hessians(xi, poses))
        columns = [
            (gradients(xi + step, poses) - gradients(xi - step, poses)) / 2e-5
            for step in 1e-5 * np.eye(6)
        ]
    expected = np.stack(columns, -1)
    single = np.asarray(hessians(xi.astype(np.float32), poses.astype(np.float32)))
    assert single.dtype == np.float32 and np.isfinite(single).all() and np.isfinite(found).all()
    angles = np.tile([*ANGLES, PI], 2)
    sharp, clear = angles < PI - 1e-6, angles < PI - 1e-4
    assert np.abs(expected).max((1, 2)).min() > 0.5
    np.testing.assert_allclose(found[sharp], expected[sharp], atol=1e-7)
    np.testing.assert_allclose(found, np.swapaxes(found, -1, -2), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(single[clear], expected[clear], atol=1e-3)
