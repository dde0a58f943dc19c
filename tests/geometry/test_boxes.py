"""Oriented boxes: exact IoU against halfspace intersection and convex hulls (scipy)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from caper_jax.errors import CaperError
from caper_jax.geometry import boxes
from caper_jax.lie import so3

KINDS = {
    # worst error in float64 against scipy, in float32 against float64 on the same numbers
    "random": (1e-12, 2e-6),
    "identical": (1e-12, 2e-6),
    "same rotation": (1e-12, 2e-6),
    "nearly identical": (1e-12, 2e-6),
    "2 mm plates": (1e-11, 2e-5),
    "identical 2 mm plates": (1e-11, 2e-6),
    "quarter turns, shared faces": (1e-12, 4e-6),
    "disjoint": (0.0, 0.0),
    "contained": (1e-12, 2e-6),
}


iou = jax.jit(boxes.iou_full)  # compiled once per shape and precision, as it ships


def pairs(kind: str, count: int = 30) -> tuple[np.ndarray, ...]:
    """Rotation, center and size of a, then of b: [count, 3, 3], [count, 3], [count, 3]."""
    g = np.random.default_rng(list(KINDS).index(kind))

    def turns() -> np.ndarray:
        return Rotation.random(count, random_state=g).as_matrix()

    def small_turns(low: float, high: float) -> np.ndarray:
        w = g.normal(size=(count, 3))
        w *= 10 ** g.uniform(low, high, (count, 1)) / np.linalg.norm(w, axis=1, keepdims=True)
        return Rotation.from_rotvec(w).as_matrix()

    rotation, center = turns(), g.normal(size=(count, 3))
    size = np.exp(g.uniform(-2.5, 0.0, (count, 3)))
    if "plates" in kind:
        size[:, 1] = 0.002
    other = rotation.copy(), center.copy(), size.copy()
    if kind == "random":
        other = (
            turns(),
            center + g.normal(size=(count, 3)) * 0.1,
            np.exp(g.uniform(-2.5, 0, size.shape)),
        )
    elif kind == "same rotation":
        shift = np.einsum("nij,nj->ni", rotation, size * g.uniform(-0.6, 0.6, size.shape))
        other = rotation, center + shift, size * g.uniform(0.7, 1.4, size.shape)
    elif kind == "nearly identical":
        other = rotation @ small_turns(-8, -2), center + g.normal(size=size.shape) * 1e-6, size
    elif kind == "2 mm plates":
        shift = g.normal(size=size.shape) * 5e-4
        other = rotation @ small_turns(-8, -1), center + shift, size * g.uniform(0.9, 1.1, (1, 3))
    elif kind == "quarter turns, shared faces":
        quarter = Rotation.create_group("O").as_matrix()[g.integers(24, size=count)]
        steps = size * g.integers(-1, 2, size.shape) / 2
        other = (
            rotation @ quarter,
            center + np.einsum("nij,nj->ni", rotation, steps),
            np.abs(np.einsum("nji,nj->ni", quarter, size)),
        )
    elif kind == "disjoint":
        other = turns(), center + np.array([4.0, 0.0, 0.0]), size
    elif kind == "contained":
        other = turns(), center, np.repeat(size.min(axis=1, keepdims=True) / 2, 3, axis=1)
    return rotation, center, size, *other


def scipy_iou(rotation_a, center_a, size_a, rotation_b, center_b, size_b) -> float:
    normals = np.concatenate([rotation_a.T, -rotation_a.T, rotation_b.T, -rotation_b.T])
    offsets = np.concatenate(
        [sign * r.T @ c + s / 2 for r, c, s in ((rotation_a, center_a, size_a),
                                                 (rotation_b, center_b, size_b))
         for sign in (1, -1)]
    )  # fmt: skip
    inner = linprog(
        [0, 0, 0, -1],
        A_ub=np.c_[normals, np.ones(12)],
        b_ub=offsets,
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    if inner.status != 0 or inner.x[3] < 1e-9:
        return 0.0
    corners = HalfspaceIntersection(np.c_[normals, -offsets], inner.x[:3]).intersections
    common = ConvexHull(corners).volume
    return common / (size_a.prod() + size_b.prod() - common)


@pytest.mark.parametrize("kind", KINDS)
def test_iou_against_scipy(kind):
    double, single = KINDS[kind]
    case = pairs(kind)
    reference = np.array([scipy_iou(*row) for row in zip(*case, strict=True)])
    rounded = [array.astype(np.float32) for array in case]
    in_single = iou(*rounded)
    assert in_single.dtype == jnp.float32
    with jax.enable_x64(True):
        in_double = np.asarray(iou(*case))
        same_input = np.asarray(iou(*(array.astype(np.float64) for array in rounded)))
    assert np.abs(in_double - reference).max() <= double
    assert np.abs(in_single - same_input).max() <= single
    if "identical" in kind and "nearly" not in kind:
        assert np.abs(np.asarray(in_single) - 1).max() < 1e-6


def test_axis_aligned_integer_boxes_are_exact():
    g = np.random.default_rng(0)
    centers = g.integers(-2, 3, (2, 500, 3)).astype(np.float32)
    sizes = g.integers(1, 5, (2, 500, 3)).astype(np.float32)
    low, high = (centers - sizes / 2).max(axis=0), (centers + sizes / 2).min(axis=0)
    common = np.maximum(high - low, 0).prod(axis=1)
    expected = common / (sizes.prod(axis=2).sum(axis=0) - common)
    assert (common == 0).any() and ((high == low).any(axis=1)).any()  # apart, and touching
    one, other = ((np.eye(3), center, size) for center, size in zip(centers, sizes, strict=True))
    found = jax.jit(boxes.iou_full)(*one, *other)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_symmetric_and_independent_of_the_frame():
    a, b = pairs("random")[:3], pairs("random")[3:]
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    moved = [
        (turn @ rotation, center @ turn.T + [1.0, 2.0, 3.0], size)
        for rotation, center, size in (a, b)
    ]
    with jax.enable_x64(True):
        plain = iou(*a, *b)
        np.testing.assert_allclose(iou(*b, *a), plain, atol=1e-12)
        np.testing.assert_allclose(iou(*moved[0], *moved[1]), plain, atol=1e-12)
        mapped = jax.jit(jax.vmap(boxes.iou_full))(*a, *b)
        np.testing.assert_allclose(mapped, plain, atol=1e-12)


gradients = jax.jit(jax.grad(lambda *case: boxes.iou_full(*case).sum(), argnums=tuple(range(6))))


def test_degenerate_boxes_give_zero():
    case = [array.astype(np.float32) for array in pairs("identical")]
    for row, bad in enumerate((0.0, -0.1, np.nan, np.inf)):
        for row_of, size in ((3 * row, case[2]), (3 * row + 1, case[5])):
            size[row_of, 1] = bad
        case[2][3 * row + 2, 1] = case[5][3 * row + 2, 1] = bad
    case[0][12, 0, 0] = case[1][13, 0] = case[4][14, 0] = np.nan
    np.testing.assert_array_equal(np.asarray(iou(*case)[:15]), 0)
    np.testing.assert_array_equal(np.asarray(boxes.iou_size(case[2], case[5])[:12]), 0)
    for gradient in gradients(*case):
        np.testing.assert_array_equal(gradient[:15], 0)
        assert jnp.isfinite(gradient).all()


def moved_iou(change, rotation_a, center_a, size_a, rotation_b, center_b, size_b):
    """IoU after changes [..., 18]: turn, shift and growth of a, then of b."""
    turn_a, shift_a, grow_a, turn_b, shift_b, grow_b = jnp.split(change, 6, axis=-1)
    return boxes.iou_full(
        so3.multiply(so3.exp(turn_a), rotation_a),
        center_a + shift_a,
        size_a + grow_a,
        so3.multiply(so3.exp(turn_b), rotation_b),
        center_b + shift_b,
        size_b + grow_b,
    )


def test_gradients_equal_finite_differences():
    kinds = ("random", "contained", "disjoint")  # no coinciding faces, where IoU has a kink
    case = [np.concatenate(arrays) for arrays in zip(*(pairs(k, 6) for k in kinds), strict=True)]
    count, step = len(case[0]), 1e-7
    with jax.enable_x64(True):
        gradient = jax.jit(jax.grad(lambda *a: moved_iou(*a).sum()))(jnp.zeros((count, 18)), *case)
        steps = step * np.stack([np.eye(18), -np.eye(18)])[:, :, None]
        up, down = np.asarray(
            jax.jit(moved_iou)(jnp.broadcast_to(steps, (2, 18, count, 18)), *case)
        )
    difference = ((up - down) / (2 * step)).T
    np.testing.assert_allclose(gradient, difference, rtol=1e-4, atol=1e-6)


def test_gradients_of_identical_boxes_are_finite():
    case = [array.astype(np.float32) for array in pairs("identical 2 mm plates")]
    found = gradients(*case)
    assert all(bool(jnp.isfinite(gradient).all()) for gradient in found)
    # Growing both boxes alike changes nothing.
    np.testing.assert_allclose(found[2] + found[5], 0, atol=1e-3)


def test_iou_size():
    assert boxes.iou_size([1.0, 2.0, 3.0], [1.0, 2.0, 3.0]) == 1
    # common 1 * 2 * 2 = 4, union 6 + 8 - 4
    np.testing.assert_allclose(boxes.iou_size([1.0, 2.0, 3.0], [2.0, 2.0, 2.0]), 0.4, rtol=1e-6)


def test_corners():
    turn = Rotation.from_rotvec([0.0, 0.0, np.pi / 2]).as_matrix()
    found = boxes.corners(turn, [1.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 2.0, 4.0])
    assert found.shape == (8, 3)
    # local (0, -1, -2) is turned to (1, 0, -2), then moved
    np.testing.assert_allclose(found[0], [2.0, 0.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(found[-1], [0.0, 1.0, 2.0], atol=1e-6)
    assert boxes.corners(np.eye(3), np.zeros((5, 1, 3)), np.zeros((4, 3)), np.ones(3)).shape == (
        5,
        4,
        8,
        3,
    )


def test_wrong_shape_is_an_error():
    with pytest.raises(CaperError, match=r"size_b must have shape \[\.\.\., 3\]"):
        boxes.iou_size(np.ones(3), np.ones(2))


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-12), (np.float32, 1e-6)])
def test_signed_distance_against_the_nearest_point_of_the_surface(dtype, tolerance):
    g = np.random.default_rng(7)
    center, size = g.normal(size=(300, 3)), g.uniform(0.1, 2, (300, 3))
    points = center + 0.5 * g.normal(size=(300, 3))
    with jax.enable_x64(dtype == np.float64):
        arguments = [np.asarray(a, dtype) for a in (points, center, size)]
        distance = np.asarray(boxes.signed_distance(*arguments))
    low, high = center - size / 2, center + size / 2
    nearest = np.clip(points, low, high)
    outside = np.linalg.norm(points - nearest, axis=-1)
    to_faces = np.minimum(points - low, high - points).min(-1)  # of points inside
    assert 30 < (outside == 0).sum() < 270
    expected = np.where(outside > 0, outside, -to_faces)
    assert np.abs(distance - expected).max() < tolerance * 10


def test_signed_distance_has_finite_derivatives_of_length_one():
    places = [[0, 0, 0], [0.3, 0, 0], [0.5, 0, 0], [0.5, 1, 1.5], [2, 0, 0], [2, 3, 0]]
    points = jnp.array(places, float)
    gradient = jax.vmap(jax.grad(boxes.signed_distance), (0, None, None))(
        points, jnp.zeros(3), jnp.array([1.0, 2.0, 3.0])
    )
    assert jnp.isfinite(gradient).all()
    assert gradient[1] == pytest.approx([1, 0, 0])  # the nearest face
    assert gradient[4] == pytest.approx([1, 0, 0])
    assert gradient[5] == pytest.approx(np.array([1.5, 2, 0]) / 2.5)
