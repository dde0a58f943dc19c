"""Joints and forward kinematics against URDF kinematics (yourdfpy) and finite differences."""

from __future__ import annotations

import functools
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yourdfpy
from scipy.spatial.transform import Rotation

from caper_jax.articulation import kinematics
from caper_jax.articulation.kinematics import forward_kinematics, forward_kinematics_float64
from caper_jax.errors import CaperError

# parents of parts 1, 2, ...: a serial chain, a star, and trees in between
TREES = {
    "one joint": ("r", (0,)),
    "chain": ("rprrpr", (0, 1, 2, 3, 4, 5)),
    "star": ("pprr", (0, 0, 0, 0)),
    "tree": ("rrprpr", (0, 0, 1, 1, 3, 2)),
}
STATES = 6
joint_transform = jax.jit(kinematics.joint_transform, static_argnums=0)
revolute, prismatic = (
    jax.jit(f) for f in (kinematics.revolute_transform, kinematics.prismatic_transform)
)


def random_urdf(letters: str, parents: tuple[int, ...], g: np.random.Generator) -> str:
    links = "".join(f'<link name="part{k}"/>' for k in range(len(parents) + 1))
    parts = [links]
    for j, (letter, parent) in enumerate(zip(letters, parents, strict=True)):
        axis = g.normal(size=3)
        axis /= np.linalg.norm(axis)  # URDF asks for it, and yourdfpy slides by axis times state
        xyz, rpy, axis = (" ".join(map(str, v)) for v in (*g.normal(size=(2, 3)), axis))
        kind = "revolute" if letter == "r" else "prismatic"
        parts.append(
            f'<joint name="joint{j}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<axis xyz="{axis}"/><parent link="part{parent}"/><child link="part{j + 1}"/>'
            '<limit lower="-10" upper="10" effort="1" velocity="1"/></joint>'
        )
    return f'<robot name="random">{"".join(parts)}</robot>'


@functools.cache
def urdf_case(name: str):
    """Axes, pivots and states for our kinematics, and the part poses that yourdfpy finds."""
    letters, parents = TREES[name]
    g = np.random.default_rng(len(letters))
    text = random_urdf(letters, parents, g)
    robot = yourdfpy.URDF.load(io.BytesIO(text.encode()), load_meshes=False)
    links = [f"part{k}" for k in range(len(parents) + 1)]

    def poses(state):
        robot.update_cfg({f"joint{j}": value for j, value in enumerate(state)})
        return np.stack([robot.get_transform(link, "part0") for link in links])

    rest = poses(np.zeros(len(parents)))
    axis = np.stack(
        [rest[j + 1, :3, :3] @ robot.joint_map[f"joint{j}"].axis for j in range(len(parents))]
    )
    state = g.uniform(-3, 3, (STATES, len(parents)))
    # A part's frame is the root's at rest; a URDF link has its own.
    moved = np.stack([poses(row) for row in state]) @ np.linalg.inv(rest)
    return axis, rest[1:, :3, 3], state, moved


def types(name: str) -> tuple[str, ...]:
    return tuple({"r": "revolute", "p": "prismatic"}[letter] for letter in TREES[name][0])


@pytest.mark.parametrize("name", TREES)
def test_forward_kinematics_against_urdf(name):
    axis, pivot, state, expected = urdf_case(name)
    root = np.eye(4)
    root[:3, :3] = Rotation.from_rotvec([0.4, -2.0, 1.0]).as_matrix()
    root[:3, 3] = [0.1, 0.2, 1.5]
    forward = jax.jit(forward_kinematics, static_argnums=(4, 5))
    tree = types(name), TREES[name][1]
    found = forward(root, axis, pivot, state.astype(np.float32), *tree)
    assert found.shape == (STATES, len(axis) + 1, 4, 4)
    np.testing.assert_allclose(found, root @ expected, atol=2e-5)
    found = forward_kinematics_float64(root, axis, pivot, state, *tree)
    np.testing.assert_allclose(found, root @ expected, atol=1e-12)


def test_batches_broadcast_and_map():
    axis, pivot, state, _ = urdf_case("tree")
    tree = types("tree"), TREES["tree"][1]
    state = state.astype(np.float32)
    mapped = jax.jit(jax.vmap(lambda s: forward_kinematics(np.eye(4), axis, pivot, s, *tree)))(
        state
    )
    whole = forward_kinematics_float64(np.eye(4), axis, pivot, state, *tree)
    np.testing.assert_allclose(whole, mapped, atol=2e-5)
    shape = jax.eval_shape(
        lambda root: forward_kinematics(root, axis, pivot, state, *tree),
        jax.ShapeDtypeStruct((5, 1, 4, 4), jnp.float32),
    )
    assert shape.shape == (5, STATES, 7, 4, 4)
    # No joints: the root alone.
    alone = forward_kinematics(np.eye(4), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), (), ())
    np.testing.assert_array_equal(alone, np.eye(4)[None])


def test_gradients_equal_finite_differences():
    axis, pivot, state, _ = urdf_case("tree")
    tree = types("tree"), TREES["tree"][1]
    base = np.concatenate([axis.ravel(), pivot.ravel(), state[0]])
    weights = np.random.default_rng(0).normal(size=(7, 4, 4))

    def value(x):
        a, q, s = x[..., :18], x[..., 18:36], x[..., 36:]
        a, q = (v.reshape(*v.shape[:-1], 6, 3) for v in (a, q))
        poses = forward_kinematics(jnp.eye(4), a, q, s, *tree)
        return jnp.sum(poses * weights, axis=(-3, -2, -1))

    forward, reverse = (
        np.asarray(jax.jit(derivative(value))(base.astype(np.float32)))
        for derivative in (jax.jacfwd, jax.grad)
    )
    step = 1e-6
    with jax.enable_x64(True):
        size = len(base)
        up, down = np.asarray(jax.jit(value)(base + step * np.stack([np.eye(size), -np.eye(size)])))
    numerical = (up - down) / (2 * step)
    for gradient in (forward, reverse):
        assert np.abs(gradient - numerical).max() <= 1e-4 * np.abs(numerical).max()


@pytest.mark.parametrize("joint_type", ["revolute", "prismatic"])
def test_gradients_are_finite_at_every_state(joint_type):
    state = np.float32([0.0, 1e-20, 1e-4, np.pi, -np.pi, 2 * np.pi, 50.0])
    axis = np.float32([[0, 0, 1], [0, 0, 0], [1e-20, 0, 0]])[:, None]

    def value(axis, pivot, state):
        return kinematics.joint_transform(joint_type, axis, pivot, state).sum()

    transform = joint_transform(joint_type, axis, np.float32([1, 2, 3]), state)
    assert jnp.isfinite(transform).all()
    np.testing.assert_array_equal(transform[1], np.tile(np.eye(4), (len(state), 1, 1)))
    gradients = jax.jit(jax.grad(value, argnums=(0, 1, 2)))(axis, np.float32([1, 2, 3]), state)
    assert all(bool(jnp.isfinite(gradient).all()) for gradient in gradients)


def test_directions_of_motion():
    # A positive state turns the child by plus the state about the axis, and slides it along.
    vectors = np.float32([[0.0, 0.0, 2.0], [1.0, 0.0, 5.0]])
    quarter = revolute(*vectors, np.float32(np.pi / 2))
    quarter = np.asarray(quarter)
    np.testing.assert_allclose(quarter @ np.array([2.0, 0, 0, 1]), [1, 1, 0, 1], atol=1e-6)
    np.testing.assert_allclose(quarter @ np.array([1.0, 0, 7, 1]), [1, 0, 7, 1], atol=1e-6)
    slid = prismatic(np.float32([0.0, 3.0, 0.0]), np.float32(0.25))
    np.testing.assert_array_equal(slid[:3], np.c_[np.eye(3), [0, 0.25, 0]])


def test_a_sliding_joint_needs_no_pivot():
    axis, nowhere = np.float32([0.0, 3.0, 0.0]), np.full(3, np.nan, np.float32)
    slid = joint_transform("prismatic", axis, nowhere, np.float32(0.25))
    np.testing.assert_array_equal(slid, prismatic(np.float32([0.0, 3.0, 0.0]), np.float32(0.25)))


def test_small_turns_about_far_pivots_keep_their_digits():
    # q - R q would leave the rounding of q: 1e-6 m here, a thousandth of the motion.
    axis, pivot, angle = np.array([0.0, 0.6, 0.8]), np.array([10.0, -7.0, 3.0]), 1e-4
    exact = kinematics.joint_transform_float64("revolute", axis, pivot, angle)
    found = revolute(*(np.float32(value) for value in (axis, pivot, angle)))
    np.testing.assert_allclose(found[:3, 3], exact[:3, 3], rtol=2e-6)


def test_mistakes_are_reported():
    vectors, state = np.ones((2, 3)), np.ones(2)
    good = {"root": np.eye(4), "axis": vectors, "pivot": vectors, "state": state}
    types = ("revolute", "prismatic")
    with pytest.raises(CaperError, match="unknown joint type 'revolut'; did you mean 'revolute'"):
        forward_kinematics(**good, joint_types=("revolut", "prismatic"), parents=(0, 1))
    with pytest.raises(CaperError, match=r"parents\[0\] = 1: part 1 needs a parent among"):
        forward_kinematics(**good, joint_types=types, parents=(1, 0))
    with pytest.raises(CaperError, match="joint_types names 2 joints, parents 1"):
        forward_kinematics(**good, joint_types=types, parents=(0,))
    with pytest.raises(CaperError, match=r"state must have shape \[\.\.\., 2\], got \[3\]"):
        forward_kinematics(**{**good, "state": np.ones(3)}, joint_types=types, parents=(0, 1))
