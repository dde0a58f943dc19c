"""Rotations and rigid transforms against 50-digit arithmetic, jaxlie and finite differences."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import jaxlie
import mpmath as mp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caper_jax.errors import CaperError
from caper_jax.lie import se3, so3
from caper_jax.lie.linalg import norm

ANGLES = (
    0.0,
    *(10.0**-k for k in range(8, 0, -1)),
    *(0.3, 1.0, 2.0, 3.0),
    *(float(np.pi - 10.0**-k) for k in range(1, 7)),
)
AXES = 14  # per angle: the three coordinate axes and random ones
EXP_ERROR, LOG_ERROR = 3e-7, 5e-7  # float32, translations of order 1

exp, log, compose = jax.jit(se3.exp), jax.jit(se3.log), jax.jit(se3.compose)


@functools.cache
def twists() -> np.ndarray:
    """[len(ANGLES) * AXES, 6] float32 (w, rho) with |w| in ANGLES."""
    g = np.random.default_rng(0)
    axes = np.concatenate([np.eye(3), g.normal(size=(AXES - 3, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    w = np.concatenate([angle * axes for angle in ANGLES])
    return np.c_[w, g.uniform(-1, 1, w.shape)].astype(np.float32)


def to_mp(array) -> mp.matrix:
    return mp.matrix(np.asarray(array, np.float64).tolist())


def to_numpy(matrix: mp.matrix) -> np.ndarray:
    return np.array(matrix.tolist(), dtype=np.float64)


def mp_exp(xi: np.ndarray) -> np.ndarray:
    w, rho = to_mp(xi[:3]), to_mp(xi[3:])
    t = mp.norm(w)
    hat = mp.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if t == 0:
        a, b, c = mp.mpf(1), mp.mpf(1) / 2, mp.mpf(1) / 6
    else:
        a, b, c = mp.sin(t) / t, (1 - mp.cos(t)) / t**2, (t - mp.sin(t)) / t**3
    result = np.eye(4)
    result[:3, :3] = to_numpy(mp.eye(3) + a * hat + b * hat * hat)
    result[:3, 3:] = to_numpy((mp.eye(3) + b * hat + c * hat * hat) * rho)
    return result


def mp_log(transform: np.ndarray) -> np.ndarray:
    """Twist of a matrix that is a rotation but for rounding: of the nearest rotation."""
    rotation = to_mp(transform[:3, :3])
    for _ in range(6):  # Newton's iteration for the polar factor
        rotation = (rotation + (rotation**-1).T) / 2
    pairs = ((2, 1), (0, 2), (1, 0))
    skew = mp.matrix([(rotation[i, j] - rotation[j, i]) / 2 for i, j in pairs])
    sine = mp.norm(skew)
    t = mp.atan2(sine, (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1) / 2)
    w = skew * (t / sine) if sine > 0 else mp.matrix([0, 0, 0])
    hat = mp.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    c = (1 - t / 2 * mp.cot(t / 2)) / t**2 if t > mp.mpf(10) ** -15 else mp.mpf(1) / 12
    rho = (mp.eye(3) - hat / 2 + c * hat * hat) * to_mp(transform[:3, 3])
    return np.concatenate([to_numpy(w), to_numpy(rho)])[:, 0]


@functools.cache
def exact_transforms() -> np.ndarray:
    with mp.workdps(50):
        return np.stack([mp_exp(xi) for xi in twists()])


def test_exp_float32_against_50_digits():
    found = exp(twists())
    assert found.dtype == jnp.float32
    assert np.abs(found - exact_transforms()).max() <= EXP_ERROR
    np.testing.assert_array_equal(found[:, 3], np.tile([0, 0, 0, 1], (len(found), 1)))


def test_log_float32_against_50_digits():
    rounded = exact_transforms().astype(np.float32)
    found = log(rounded)
    assert found.dtype == jnp.float32
    # Read both ways: as the rounded image of the twist, and as a matrix of its own right.
    assert np.abs(found - twists()).max() <= LOG_ERROR
    with mp.workdps(50):
        of_rounded = np.stack([mp_log(matrix) for matrix in rounded])
    assert np.abs(found - of_rounded).max() <= LOG_ERROR


def test_float64_against_50_digits():
    xi = twists().astype(np.float64)
    with jax.enable_x64(True):
        found = exp(xi)
        assert found.dtype == jnp.float64
        assert np.abs(np.asarray(found) - exact_transforms()).max() < 1e-15
        # A rounding of the matrix moves the twist by about as much.
        assert np.abs(np.asarray(log(exact_transforms())) - xi).max() < 2e-15


def test_half_turns_agree_as_group_elements():
    g = np.random.default_rng(1)
    axes = np.concatenate([np.eye(3), -np.eye(3), g.normal(size=(AXES * len(ANGLES) - 6, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    transform = np.tile(np.eye(4), (len(axes), 1, 1))
    transform[:, :3, :3] = 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    transform[:, :3, 3] = g.uniform(-1, 1, axes.shape)
    xi = log(transform.astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(xi[:, :3], axis=1), np.pi, atol=5e-7)
    assert np.abs(exp(xi) - transform).max() <= LOG_ERROR


def test_several_turns():
    g = np.random.default_rng(2)
    w = g.normal(size=(len(ANGLES) * AXES, 3))
    xi = np.c_[w / np.linalg.norm(w, axis=1, keepdims=True) * 12, 0 * w].astype(np.float32)
    expected = Rotation.from_rotvec(xi[:, :3].astype(np.float64)).as_matrix()
    assert np.abs(exp(xi)[:, :3, :3] - expected).max() <= 5e-7
    assert np.linalg.norm(log(exp(xi))[:, :3], axis=1).max() <= np.pi + 3e-7


def test_against_jaxlie():
    xi = twists().astype(np.float64)
    xi = xi[np.linalg.norm(xi[:, :3], axis=1) >= 0.9e-3]

    @jax.jit
    def errors(xi):
        # jaxlie's twists carry the translation first.
        other = jaxlie.SE3.exp(jnp.roll(xi, 3, axis=-1))
        matrix = other.as_matrix()
        adjoint = jnp.roll(other.adjoint(), (3, 3), axis=(-2, -1))
        return {
            "exp": se3.exp(xi) - matrix,
            "log": se3.log(matrix) - jnp.roll(other.log(), 3, axis=-1),
            "adjoint": se3.adjoint(matrix) - adjoint,
        }

    with jax.enable_x64(True):
        worst = {name: np.abs(error).max() for name, error in errors(xi).items()}
    assert worst["exp"] < 1e-11
    assert worst["log"] < 1e-9
    assert worst["adjoint"] < 1e-11


NAMES = ("exp", "log", "norm", "angle")


def functions(xi: jax.Array, change: jax.Array) -> dict[str, jax.Array]:
    """To be differentiated by the change at 0."""
    transform = se3.exp(xi + change)
    return {
        "exp": transform,
        "log": se3.log(se3.compose(se3.exp(xi), jnp.eye(4) + se3.hat(change))),
        "norm": norm(xi + change),
        "angle": so3.angle(transform[:3, :3]),
    }


@functools.cache
def derivatives() -> tuple[np.ndarray, dict, dict, dict]:
    """Twists, forward and reverse Jacobians in float32, central differences in float64."""
    step = 1e-7
    half_turn = np.concatenate([[np.pi, 0, 0], np.full(3, 0.5)])
    xi = np.concatenate([twists(), np.stack([np.zeros(6), half_turn])]).astype(np.float32)
    zero = np.zeros(6, np.float32)
    forward, reverse = (
        jax.jit(jax.vmap(lambda x, d=d: d(lambda c: functions(x, c))(zero)))(xi)
        for d in (jax.jacfwd, jax.jacrev)
    )
    with jax.enable_x64(True):
        batched = jax.jit(jax.vmap(jax.vmap(functions, (None, 0)), (0, None)))
        values = batched(xi.astype(np.float64), step * np.concatenate([np.eye(6), -np.eye(6)]))
        values = {name: np.asarray(value) for name, value in values.items()}
    numerical = {
        name: np.moveaxis(value[:, :6] - value[:, 6:], 1, -1) / (2 * step)
        for name, value in values.items()
    }
    return xi.astype(np.float64), forward, reverse, numerical


@pytest.mark.parametrize("name", NAMES)
def test_gradients(name):
    xi, forward, reverse, numerical = derivatives()
    # log has no derivative at half turns, and the norm of a twist none at 0.
    angle = np.linalg.norm(xi[:, :3], axis=1)
    smooth = np.abs(angle - np.pi) > 5e-7
    if name in ("norm", "angle"):
        smooth &= angle > 0.9e-4
    expected = numerical[name][smooth]
    scale = np.abs(expected).max(axis=tuple(range(1, expected.ndim)), keepdims=True)
    for jacobian in (forward[name], reverse[name]):
        assert jnp.isfinite(jacobian).all()
        assert (np.abs(np.asarray(jacobian)[smooth] - expected) / scale).max() <= 1e-4


def test_gradients_at_large_angles_are_finite():
    xi = np.array([[1e3, 2.0, -5.0, 1, 1, 1], [2e5, 0, 0, 1, 1, 1]], np.float32)
    gradient = jax.jit(jax.grad(lambda x: se3.exp(x).sum()))(xi)
    assert jnp.isfinite(gradient).all()


def test_jacobians():
    xi = twists().astype(np.float64)

    def moved(xi, change):  # exp(xi + change) exp(xi)^-1, to first order in the change
        product = se3.compose(se3.exp(xi + change), se3.inverse(se3.exp(xi)))
        return se3.vee(product - jnp.eye(4))

    left, left_inverse = jax.jit(se3.left_jacobian), jax.jit(se3.left_jacobian_inverse)
    with jax.enable_x64(True):
        numerical = jax.vmap(lambda x: jax.jacfwd(lambda c: moved(x, c))(jnp.zeros(6)))
        numerical = np.asarray(jax.jit(numerical)(xi))
        jacobian, inverse = np.asarray(left(xi)), np.asarray(left_inverse(xi))
    np.testing.assert_allclose(jacobian, numerical, atol=1e-12)
    identity = np.broadcast_to(np.eye(6), jacobian.shape)
    np.testing.assert_allclose(jacobian @ inverse, identity, atol=1e-12)
    assert np.abs(left(twists()) - jacobian).max() < 3e-6
    assert np.abs(left_inverse(twists()) - inverse).max() < 3e-6
    w = twists()[:, :3]
    assert np.abs(jax.jit(so3.left_jacobian)(w) - jacobian[:, 3:, 3:]).max() < 3e-7
    assert np.abs(jax.jit(so3.left_jacobian_inverse)(w) - inverse[:, 3:, 3:]).max() < 5e-7


def test_group_operations():
    g = np.random.default_rng(3)
    inverse = jax.jit(se3.inverse)
    a, b = exp(twists()), exp(g.permutation(twists()))
    a64, b64 = np.asarray(a, np.float64), np.asarray(b, np.float64)
    np.testing.assert_allclose(compose(a, b), a64 @ b64, atol=1e-6)
    np.testing.assert_allclose(inverse(a), np.linalg.inv(a64), atol=1e-6)
    points = g.normal(size=(len(a), 5, 3)).astype(np.float32)
    expected = np.einsum("bij,bnj->bni", a64[:, :3, :3], points) + a64[:, None, :3, 3]
    np.testing.assert_allclose(se3.act(a, points), expected, atol=2e-6)
    xi = g.normal(size=(len(a), 6)).astype(np.float32)
    turned = compose(compose(a, exp(xi)), inverse(a))
    np.testing.assert_allclose(
        turned, exp(np.asarray(so3.apply(se3.adjoint(a), jnp.asarray(xi)))), atol=1e-5
    )
    np.testing.assert_array_equal(se3.vee(se3.hat(xi)), xi)
    np.testing.assert_array_equal(so3.vee(so3.hat(xi[:, :3])), xi[:, :3])
    np.testing.assert_allclose(
        so3.apply(so3.hat(xi[:, :3]), jnp.asarray(xi[:, 3:])),
        np.cross(xi[:, :3], xi[:, 3:]),
        atol=1e-5,
    )


def test_interpolation():
    interpolate = jax.jit(se3.interpolate)
    xi = np.roll(twists(), 1, axis=0)
    xi[np.linalg.norm(xi[:, :3], axis=1) > 3.1] *= 0.9
    a = exp(np.tile(np.float32([0.1, 0.2, 0.3, 1, 2, 3]), (len(xi), 1)))
    b = compose(a, exp(xi))
    for fraction in (0.0, 0.25, 1.0, 2.0):
        expected = compose(a, exp(fraction * xi))
        np.testing.assert_allclose(interpolate(a, b, fraction), expected, atol=1e-5)
    turn = jax.jit(so3.interpolate)(a[:, :3, :3], b[:, :3, :3], np.full(len(xi), 0.5))
    np.testing.assert_allclose(turn, interpolate(a, b, 0.5)[:, :3, :3], atol=1e-6)


def test_geodesic_distances():
    xi = twists()
    a = exp(np.roll(xi, 7, axis=0))
    b = compose(a, exp(xi))
    angle = np.linalg.norm(xi[:, :3].astype(np.float64), axis=1)
    found = jax.jit(so3.geodesic_distance)(a[:, :3, :3], b[:, :3, :3])
    np.testing.assert_allclose(found, angle, atol=1e-6)
    np.testing.assert_allclose(
        jax.jit(se3.geodesic_distance)(a, b),
        np.linalg.norm(xi.astype(np.float64), axis=1),
        atol=4e-6,
    )
    # 0.01 deg, which arccos of the trace reads as 0 in float32
    small = so3.angle(so3.exp(np.float32([0, np.deg2rad(0.01), 0])))
    np.testing.assert_allclose(small, np.deg2rad(0.01), rtol=1e-6)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_batch_shapes(batch):
    xi = jax.ShapeDtypeStruct((*batch, 6), jnp.float32)
    transform = jax.eval_shape(se3.exp, xi)
    assert transform.shape == (*batch, 4, 4)
    assert jax.eval_shape(se3.log, transform).shape == (*batch, 6)
    assert jax.eval_shape(se3.left_jacobian, xi).shape == (*batch, 6, 6)
    assert jax.eval_shape(se3.geodesic_distance, transform, transform).shape == batch
    points = jax.ShapeDtypeStruct((5, 3, 4, 2, 7, 3), jnp.float32)
    assert jax.eval_shape(se3.act, transform, points).shape == points.shape
    assert jax.eval_shape(se3.from_rt, jnp.eye(3), points).shape == (5, 3, 4, 2, 7, 4, 4)


def test_integers_become_floats_and_wrong_shapes_are_errors():
    np.testing.assert_allclose(so3.exp([0, 0, 0]), np.eye(3))
    with pytest.raises(CaperError, match=r"w must have shape \[\.\.\., 3\], got \[4\]"):
        so3.exp(np.zeros(4))
    with pytest.raises(CaperError, match=r"transform must have shape \[\.\.\., 4, 4\]"):
        se3.log(np.eye(3))
    with pytest.raises(CaperError, match="xi must have shape"):
        se3.exp(np.float32(0))
