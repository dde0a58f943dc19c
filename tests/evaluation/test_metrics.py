"""Errors of poses, against SciPy and cases whose answer is known."""

import itertools

import jax
import numpy as np
import pytest
from _helpers.frames import random_pose
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.category import Category, Joint, Symmetry
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.articulation.symmetry import apply_symmetry
from caper_jax.data.types import pose_problems
from caper_jax.errors import CaperError
from caper_jax.evaluation.metrics import pose_errors, pose_errors_up_to_symmetry

BOX = categories.get("box")
FRAMES = 12


def rotated(pose, rotvec, moved=(0.0, 0.0, 0.0)):
    """Every part rotated about its own origin, and moved, both in the camera's frame."""
    turn = Rotation.from_rotvec(rotvec).as_matrix()
    return pose.replace(
        rotation=np.einsum("ij,...jk->...ik", turn, pose.rotation.astype(float)),
        translation=pose.translation + np.asarray(moved),
    )


def test_the_truth_scores_perfectly():
    truth = random_pose(FRAMES)
    for errors in (
        pose_errors(truth, truth, BOX),
        pose_errors_up_to_symmetry(truth, truth, BOX),
    ):
        for key in ("rotation_deg", "translation_m", "axis_deg", "pivot_m", "state"):
            assert (getattr(errors, key) == 0).all(), key
        for key in ("iou_full", "iou_size"):
            np.testing.assert_allclose(getattr(errors, key), 1, rtol=0, atol=1e-9)


@pytest.mark.parametrize("angle", [1e-4, 0.01, 30, 90, 120, 179.99, 180])
def test_rotation_error_is_the_angle_never_folded(angle):
    truth = random_pose(FRAMES)
    axis = np.array([1, 2, -2]) / 3
    errors = pose_errors(rotated(truth, np.radians(angle) * axis), truth, BOX)
    # The truth is float32, so orthonormal to 1e-7 only.
    np.testing.assert_allclose(errors.rotation_deg, angle, atol=2e-5)


def test_translation_is_the_distance_of_the_origins():
    truth = random_pose(FRAMES)
    errors = pose_errors(rotated(truth, [0, 0, 0], (0.003, -0.004, 0.012)), truth, BOX)
    np.testing.assert_allclose(errors.translation_m, 0.013, atol=1e-6)


def halfspaces(rotation, center, size):
    normals = np.concatenate([rotation.T, -rotation.T])
    return np.column_stack([normals, -(normals @ center) - np.tile(size / 2, 2)])


def test_full_iou_is_that_of_the_oriented_boxes_in_the_camera():
    truth = random_pose(FRAMES)
    guess = rotated(truth, [0.1, -0.2, 0.15], (0.004, 0.003, -0.005))
    guess = guess.replace(size=1.2 * truth.size, box_center=truth.box_center + 0.002)
    found = pose_errors(guess, truth, BOX).iou_full
    for frame, part in itertools.product(range(FRAMES), range(2)):
        planes, volumes = [], []
        for pose in (guess, truth):
            rotation = np.asarray(pose.rotation[frame, part], float)
            middle = rotation @ pose.box_center[frame, part] + pose.translation[frame, part]
            planes.append(halfspaces(rotation, middle, pose.size[frame, part]))
            volumes.append(np.prod(pose.size[frame, part], dtype=float))
        inside = middle  # the true center is well inside both boxes
        corners = HalfspaceIntersection(np.concatenate(planes), inside).intersections
        shared = ConvexHull(corners).volume
        assert found[frame, part] == pytest.approx(shared / (sum(volumes) - shared), abs=1e-5)


def test_size_iou_ignores_where_the_boxes_are():
    truth = random_pose(FRAMES)
    guess = rotated(truth, [1, 1, 1], (1, 1, 1)).replace(size=truth.size * [2, 0.5, 1])
    errors = pose_errors(guess, truth, BOX)
    np.testing.assert_allclose(errors.iou_size, 0.5 / (1 + 1 - 0.5), rtol=1e-6)
    assert (errors.iou_full == 0).all()


def test_joint_axes_have_a_sign_and_pivots_a_line():
    truth = random_pose(FRAMES)
    axis = truth.joint_axis.astype(float)
    across = np.cross(axis, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    guess = truth.replace(
        joint_axis=np.cos(0.3) * axis + np.sin(0.3) * across,
        joint_pivot=truth.joint_pivot + 0.07 * axis + 0.02 * across,
        joint_state=truth.joint_state - np.radians(200.0),
    )
    errors = pose_errors(guess, truth, BOX)
    np.testing.assert_allclose(errors.axis_deg, np.degrees(0.3), atol=1e-5)
    np.testing.assert_allclose(errors.pivot_m, 0.02, atol=1e-6)
    np.testing.assert_allclose(errors.state, 200, atol=1e-4)
    flipped = pose_errors(truth.replace(joint_axis=-truth.joint_axis), truth, BOX)
    np.testing.assert_allclose(flipped.axis_deg, 180, atol=1e-5)


def chain(*types):
    """A category whose parts hang on one another: body, door, and a third in the door."""
    limits = {"revolute": (0, 1.5), "prismatic": (0, 0.3)}
    return Category(
        name="chain",
        parts=("body", "door", "third"),
        joints=tuple(Joint(kind, j, limits[kind]) for j, kind in enumerate(types)),
        directions=("x", "z"),
        directions_reason="test",
        unit=1.0,
        mean_size=((1, 1, 1),) * 3,
        mean_center=((0, 0, 0),) * 3,
    )


TURN_AND_SLIDE, TURN_TWICE = chain("revolute", "prismatic"), chain("revolute", "revolute")


def chain_pose(category, frames=FRAMES):
    """Poses of a chain; SciPy and NumPy do the kinematics."""
    rng = np.random.default_rng(2)
    two = random_pose(frames, 2)
    axis, pivot = rng.normal(size=(2, frames, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    state = rng.uniform(0, 0.3, frames)
    if category.joint_types[1] == "revolute":
        turn = Rotation.from_rotvec(axis * state[:, None])
        step = turn.as_matrix(), pivot - turn.apply(pivot)
    else:
        step = np.eye(3), axis * state[:, None]
    door, shift = two.rotation[:, 1].astype(float), two.translation[:, 1]
    third = door @ step[0], shift + np.einsum("fij,fj->fi", door, step[1])
    return ArticulatedPose(
        rotation=np.concatenate([two.rotation, third[0][:, None]], 1),
        translation=np.concatenate([two.translation, third[1][:, None]], 1),
        size=rng.uniform(0.1, 0.3, (frames, 3, 3)),
        box_center=rng.normal(size=(frames, 3, 3)) * 0.01,
        joint_axis=np.stack([two.joint_axis[:, 0], axis], 1),
        joint_pivot=np.stack([two.joint_pivot[:, 0], pivot], 1),
        joint_state=np.stack([two.joint_state[:, 0], state], 1),
    )


def mixed(chosen, first, second):
    """``first`` in the chosen frames, ``second`` in the others."""
    return jax.tree.map(
        lambda a, b: np.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b), first, second
    )


def test_prismatic_joints_have_no_pivot_and_states_in_meters():
    truth = chain_pose(TURN_AND_SLIDE)
    guess = truth.replace(joint_state=truth.joint_state + 0.01, joint_pivot=truth.joint_pivot + 1)
    errors = pose_errors(guess, truth, TURN_AND_SLIDE)
    assert np.isnan(errors.pivot_m[:, 1]).all() and not np.isnan(errors.pivot_m[:, 0]).any()
    np.testing.assert_allclose(errors.state, np.tile([np.degrees(0.01), 0.01], (FRAMES, 1)))


def test_failed_frames_score_the_worst_value():
    truth = chain_pose(TURN_AND_SLIDE)
    failed = np.zeros(FRAMES, bool)
    failed[[1, 4]] = True
    guess = mixed(failed, jax.tree.map(lambda array: array * np.nan, truth), truth)
    for errors in (
        pose_errors(guess, truth, TURN_AND_SLIDE, failed),
        pose_errors_up_to_symmetry(guess, truth, TURN_AND_SLIDE, failed),
    ):
        assert (errors.rotation_deg[failed] == 180).all() and (errors.axis_deg[failed] == 180).all()
        assert (errors.iou_full[failed] == 0).all() and (errors.iou_size[failed] == 0).all()
        np.testing.assert_allclose(
            errors.translation_m[failed], np.linalg.norm(truth.translation, axis=-1)[failed]
        )
        np.testing.assert_allclose(errors.state[failed], [[np.degrees(1.5), 0.3]] * 2)
        assert (errors.rotation_deg[~failed] == 0).all() and (errors.state[~failed] == 0).all()
        # The closest point of the axis to the camera, by search along it.
        root = truth.rotation[1, 0].astype(float)
        reach = np.linspace(-6, 6, 200_001)[:, None]
        line = truth.joint_pivot[1, 0] + reach * truth.joint_axis[1, 0]
        nearest = np.linalg.norm(line @ root.T + truth.translation[1, 0], axis=-1).min()
        assert errors.pivot_m[1, 0] == pytest.approx(nearest, abs=1e-6)
        assert np.isnan(errors.pivot_m[:, 1]).all()
    with pytest.raises(CaperError, match="estimate rotation has NaN"):
        pose_errors(guess, truth, TURN_AND_SLIDE)


def corners(pose):
    """[F, K, 8, 3] corners of all boxes in the camera's frame."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    rest = pose.box_center[..., None, :] + signs * pose.size[..., None, :]
    corners_camera = np.einsum("fkij,fkcj->fkci", np.asarray(pose.rotation, float), rest)
    return corners_camera + pose.translation[..., None, :]


CYCLE = ((0, 0, 1), (-1, 0, 0), (0, -1, 0))


@pytest.mark.parametrize(
    ("category", "pose", "symmetry"),
    [
        (BOX, random_pose(FRAMES), BOX.symmetries[0]),
        # The chain seen from its other end: parents and children change places.
        (TURN_TWICE, chain_pose(TURN_TWICE), Symmetry((2, 1, 0), CYCLE, "test")),
    ],
)
def test_an_equivalent_pose_is_the_same_object(category, pose, symmetry):
    other = apply_symmetry(pose, symmetry, category)
    assert not pose_problems(other, category)
    found, expected = corners(other), corners(pose)[:, list(symmetry.permutation)]
    distance = np.linalg.norm(found[..., :, None, :] - expected[..., None, :, :], axis=-1)
    assert distance.min(-1).max() < 1e-6 and distance.min(-2).max() < 1e-6


def alike(size):
    """Extents [F, 3] of the box's other part with which both may change places."""
    return size @ np.abs(np.array(BOX.symmetries[0].rotation))


def test_errors_up_to_symmetry_take_the_better_truth_of_each_frame():
    truth = random_pose(FRAMES)
    truth.size[:, 1] = alike(truth.size[:, 0])
    other = apply_symmetry(truth, BOX.symmetries[0], BOX)
    swapped = np.arange(FRAMES) % 3 == 0
    guess = mixed(swapped, other, truth)
    guess = rotated(guess, [0.02, 0, 0], (0, 0.001, 0))
    plain, symmetric = (f(guess, truth, BOX) for f in (pose_errors, pose_errors_up_to_symmetry))
    np.testing.assert_allclose(symmetric.rotation_deg, np.degrees(0.02), atol=1e-5)
    np.testing.assert_allclose(symmetric.translation_m, 0.001, atol=1e-6)
    np.testing.assert_allclose(symmetric.iou_size, 1, atol=1e-9)
    for key in ("axis_deg", "pivot_m", "state"):
        np.testing.assert_allclose(getattr(symmetric, key), 0, atol=1e-5)
    assert (plain.rotation_deg[swapped, 0] > 5).all()
    np.testing.assert_array_equal(plain.rotation_deg[~swapped], symmetric.rotation_deg[~swapped])


def test_parts_that_are_not_alike_may_not_change_places():
    (symmetry,) = BOX.symmetries
    pose = random_pose(40)
    pose.size[:, 1] = alike(pose.size[:, 0])
    pose.size[20:, 1] *= 2
    guess = apply_symmetry(pose, symmetry, BOX)
    plain, symmetric = (f(guess, pose, BOX) for f in (pose_errors, pose_errors_up_to_symmetry))
    assert symmetric.rotation_deg[:20].max() < 1e-3
    np.testing.assert_array_equal(symmetric.rotation_deg[20:], plain.rotation_deg[20:])


def test_impossible_symmetries_and_shapes_are_named():
    pose, same = chain_pose(TURN_AND_SLIDE), ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    for order, message in (
        ((0, 2, 1), "puts a joint between parts 0 and 2, which have none"),
        ((2, 1, 0), "puts the prismatic joint of part 2 where a revolute one belongs"),
    ):
        with pytest.raises(CaperError, match=message):
            apply_symmetry(pose, Symmetry(order, same, ""), TURN_AND_SLIDE)
    with pytest.raises(CaperError, match="estimate rotation has shape"):
        pose_errors(random_pose(FRAMES), pose, TURN_AND_SLIDE)
    with pytest.raises(CaperError, match=r"shape \(3, 3, 3, 3\), expected \(12, 3, 3, 3\)"):
        pose_errors(chain_pose(TURN_AND_SLIDE, 3), pose, TURN_AND_SLIDE)
