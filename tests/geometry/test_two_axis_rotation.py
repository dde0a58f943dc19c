"""Rotation from two directions (paper Eq 3), against a numerical minimizer."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from caper_jax.errors import CaperError
from caper_jax.geometry.two_axis_rotation import rotation_from_directions

AXES = list(itertools.permutations("xyz", 2))
solve = jax.jit(rotation_from_directions, static_argnames="axes")


def assert_rotations(rotation):
    rotation = np.asarray(rotation, np.float64)
    gram = np.einsum("...ji,...jk->...ik", rotation, rotation)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-6)


def noisy_case(noise: float, count: int = 10):
    g = np.random.default_rng(0)
    truth = Rotation.random(count, random_state=g).as_matrix()
    first, second = g.normal(size=(2, count, 3)) * noise
    return truth, first, second, *g.uniform(0.01, 0.99, (2, count))


@pytest.mark.parametrize("axes", AXES)
def test_exact_directions_give_the_rotation(axes):
    truth, _, _, psi_first, psi_second = noisy_case(0.0)
    first, second = (truth[..., "xyz".index(axis)] for axis in axes)
    # Predicted directions need not have unit length.
    rotation, degenerate = solve(first * 3, second * 0.2, psi_first, psi_second, axes=axes)
    assert not degenerate.any()
    np.testing.assert_allclose(rotation, truth, atol=1e-6)


@pytest.mark.parametrize("axes", AXES)
def test_correction_minimizes_equation_3(axes):
    truth, first, second, psi_first, psi_second = noisy_case(0.3)
    i, j = ("xyz".index(axis) for axis in axes)
    first, second = truth[..., i] + first, truth[..., j] + second
    rotation, degenerate = solve(first, second, psi_first, psi_second, axes=axes)
    assert not degenerate.any()
    assert_rotations(rotation)

    def angle(a, b):
        return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))

    rotation = np.asarray(rotation, np.float64)
    # Both stay in their plane, so the third axis is its normal, and both move the same way.
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sign = np.linalg.det(np.stack([np.eye(3)[i], np.eye(3)[j], np.eye(3)[3 - i - j]]))
    np.testing.assert_allclose(rotation[..., 3 - i - j], sign * normal, atol=1e-6)
    moved_first, moved_second = angle(first, rotation[..., i]), angle(second, rotation[..., j])
    excess = angle(first, second) - np.pi / 2
    np.testing.assert_allclose(moved_first + moved_second, np.abs(excess), atol=1e-6)
    for row in range(len(first)):
        best = minimize_scalar(
            lambda d, row=row: (
                psi_first[row] * d**2 + psi_second[row] * (abs(excess[row]) - d) ** 2
            ),
            bounds=(0, abs(excess[row])),
            method="bounded",
            options={"xatol": 1e-9},
        )
        assert moved_first[row] == pytest.approx(best.x, abs=2e-6)
    confident = psi_first > psi_second
    assert (moved_first < moved_second)[confident].all()
    assert (moved_first > moved_second)[~confident].all()


X, Y, ZERO = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]
TILTED = [0.6, 0.0, 0.8]
DEGENERATE = {
    "parallel": (TILTED, TILTED, 0.5, 0.5),
    "nearly parallel": (X, [1.0, 1e-6, 0.0], 0.5, 0.5),
    "opposite": (TILTED, [-0.6, 0.0, -0.8], 0.9, 0.1),
    "first zero": (ZERO, TILTED, 0.5, 0.5),
    "second zero": (TILTED, ZERO, 0.5, 0.5),
    "both zero": (ZERO, ZERO, 0.5, 0.5),
    "confidences zero": (X, [0.1, 1.0, 0.0], 0.0, 0.0),
    "confidence not finite": (X, [0.1, 1.0, 0.0], np.nan, 0.5),
    "direction not finite": (X, [np.nan, 1.0, 0.0], 0.5, 0.5),
    "direction infinite": ([np.inf, 1.0, 0.0], Y, 0.5, 0.5),
}


@pytest.mark.parametrize("axes", AXES)
def test_degenerate_input(axes):
    arrays = [np.array(column, np.float32) for column in zip(*DEGENERATE.values(), strict=True)]
    rotation, degenerate = solve(*arrays, axes=axes)
    assert dict(zip(DEGENERATE, degenerate.tolist(), strict=True)) == dict.fromkeys(
        DEGENERATE, True
    )
    assert_rotations(rotation)
    row = dict(zip(DEGENERATE, rotation, strict=True))
    i, j = ("xyz".index(axis) for axis in axes)
    np.testing.assert_allclose(row["second zero"][:, i], TILTED, atol=1e-6)
    np.testing.assert_allclose(row["first zero"][:, j], TILTED, atol=1e-6)
    np.testing.assert_array_equal(row["both zero"], np.eye(3))


def test_degenerate_input_has_finite_gradients():
    arrays = [np.array(column, np.float32) for column in zip(*DEGENERATE.values(), strict=True)]
    weights = np.arange(9.0, dtype=np.float32).reshape(3, 3)
    gradients = jax.jit(
        jax.grad(lambda *a: jnp.sum(rotation_from_directions(*a)[0] * weights), argnums=range(4))
    )(*arrays)
    assert all(bool(jnp.isfinite(gradient).all()) for gradient in gradients)


def test_one_confidence_may_be_zero():
    truth, first, second, _, psi_second = noisy_case(0.3)
    first, second = truth[..., 0] + first, truth[..., 1] + second
    rotation, degenerate = solve(first, second, np.zeros(10), psi_second, axes=("x", "y"))
    assert not degenerate.any()
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    np.testing.assert_allclose(rotation[..., 1], second, atol=1e-6)


def test_gradients_equal_finite_differences():
    truth, first, second, psi_first, psi_second = noisy_case(0.3)
    base = np.c_[truth[..., 1] + first, truth[..., 2] + second, psi_first, psi_second]
    weights, step = np.random.default_rng(1).normal(size=(3, 3)), 1e-6

    def value(x):
        rotation, _ = rotation_from_directions(x[..., :3], x[..., 3:6], x[..., 6], x[..., 7])
        return jnp.sum(rotation * weights, axis=(-2, -1))

    in_single = np.asarray(jax.jit(jax.grad(lambda x: value(x).sum()))(base.astype(np.float32)))
    with jax.enable_x64(True):
        steps = step * np.stack([np.eye(8), -np.eye(8)])[:, :, None]
        up, down = np.asarray(jax.jit(value)(base + steps))
    difference = ((up - down) / (2 * step)).T
    scale = np.abs(difference).max(axis=1, keepdims=True)
    assert (np.abs(in_single - difference) / scale).max() < 1e-4


def test_batches_broadcast():
    shapes = jax.eval_shape(
        rotation_from_directions, np.ones((4, 1, 3)), np.ones((5, 3)), 0.5, np.ones((4, 5))
    )
    assert [leaf.shape for leaf in shapes] == [(4, 5, 3, 3), (4, 5)]
    assert shapes[1].dtype == bool


@pytest.mark.parametrize("axes", [("x", "x"), ("x", "w"), ("xy", "z"), ("x",), "x"])
def test_wrong_axes_are_an_error(axes):
    with pytest.raises(CaperError, match="axes must be two different ones"):
        rotation_from_directions(np.array(X), np.array(Y), 0.5, 0.5, axes=axes)
