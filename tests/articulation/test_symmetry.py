"""Second readings: the same object in the camera, by other names."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.category import Category, Joint, Symmetry
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.articulation.symmetry import apply_symmetry, is_ambiguous, permute_labels
from caper_jax.errors import CaperError

DECLARED = [
    (name, symmetry) for name in categories.names() for symmetry in categories.get(name).symmetries
]
HALF_TURN_Z = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
HALF_TURN_Y = ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))


def made_up(*joints: Joint, symmetry: Symmetry) -> Category:
    parts = len(joints) + 1
    return Category(
        name="made up",
        parts=tuple(f"part {k}" for k in range(parts)),
        joints=joints,
        directions=("x", "y"),
        directions_reason="",
        unit=1.0,
        mean_size=((1.0, 1.0, 1.0),) * parts,
        mean_center=((0.0, 0.0, 0.0),) * parts,
        symmetries=(symmetry,),
    )


HINGE = Joint("revolute", 0, (0.0, 1.0))
SLIDE = Joint("prismatic", 0, (0.0, 1.0))
# Two side parts change places (as the temples of glasses); a chain read from its other end.
SIDES = made_up(HINGE, HINGE, symmetry=Symmetry((0, 2, 1), HALF_TURN_Y, ""))
CHAIN = made_up(
    HINGE, dataclasses.replace(HINGE, parent=1), symmetry=Symmetry((2, 1, 0), HALF_TURN_Z, "")
)


def kinematics(pose: ArticulatedPose, category: Category):
    """Poses of all parts from the root's, in float64 by SciPy: (rotation, translation)."""
    rotations, translations = [pose.rotation[:, 0]], [pose.translation[:, 0]]
    for j, joint in enumerate(category.joints):
        axis, pivot, state = pose.joint_axis[:, j], pose.joint_pivot[:, j], pose.joint_state[:, j]
        if joint.type == "revolute":
            turn = Rotation.from_rotvec(axis * state[:, None]).as_matrix()
            shift = pivot - np.einsum("fij,fj->fi", turn, pivot)
        else:
            turn, shift = np.tile(np.eye(3), (len(axis), 1, 1)), axis * state[:, None]
        parent = rotations[joint.parent]
        rotations.append(parent @ turn)
        shift = np.einsum("fij,fj->fi", parent, shift)
        translations.append(translations[joint.parent] + shift)
    return np.stack(rotations, 1), np.stack(translations, 1)


def random_pose(category: Category, frames: int = 5) -> ArticulatedPose:
    rng = np.random.default_rng(0)
    parts, joints = category.num_parts, category.num_joints
    axis = rng.normal(size=(frames, joints, 3))
    pose = ArticulatedPose(
        rotation=np.tile(Rotation.random(frames, rng=rng).as_matrix()[:, None], (1, parts, 1, 1)),
        translation=np.tile(rng.normal(size=(frames, 1, 3)), (1, parts, 1)),
        size=rng.uniform(0.1, 0.4, (frames, parts, 3)),
        box_center=rng.normal(size=(frames, parts, 3)),
        joint_axis=axis / np.linalg.norm(axis, axis=-1, keepdims=True),
        joint_pivot=rng.normal(size=(frames, joints, 3)),
        joint_state=rng.uniform(0.2, 1.5, (frames, joints)),
    )
    rotation, translation = kinematics(pose, category)
    return pose.replace(rotation=rotation, translation=translation)


def corners(pose: ArticulatedPose, frame: int, part: int) -> np.ndarray:
    """The 8 corners of a part's box in the camera frame, in a fixed order."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    local = pose.box_center[frame, part] + signs * pose.size[frame, part]
    camera = local @ pose.rotation[frame, part].T + pose.translation[frame, part]
    return camera[np.lexsort(camera.round(9).T)]


CASES = [(categories.get(name), e) for name, e in DECLARED] + [
    (category, category.symmetries[0]) for category in (SIDES, CHAIN)
]
IDS = [*(name for name, _ in DECLARED), "sides", "chain"]


@pytest.mark.parametrize(("category", "symmetry"), CASES, ids=IDS)
def test_second_reading_is_the_same_object(category, symmetry):
    pose = random_pose(category)
    other = apply_symmetry(pose, symmetry, category)
    # Forward kinematics from the new root, with the new joints, finds the same parts.
    rotation, translation = kinematics(other, category)
    np.testing.assert_allclose(other.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(other.translation, translation, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(other.rotation), 1.0, atol=1e-12)
    for frame, part in itertools.product(range(5), range(category.num_parts)):
        np.testing.assert_allclose(
            corners(other, frame, part),
            corners(pose, frame, symmetry.permutation[part]),
            atol=1e-9,
        )
    # Nothing turns into its opposite: what was open stays as open.
    assert sorted(other.joint_state[0]) == sorted(pose.joint_state[0])


@pytest.mark.parametrize(("category", "symmetry"), CASES, ids=IDS)
def test_second_reading_twice_is_the_first(category, symmetry):
    pose = random_pose(category)
    twice = apply_symmetry(apply_symmetry(pose, symmetry, category), symmetry, category)
    for name, values in vars(pose).items():
        np.testing.assert_allclose(getattr(twice, name), values, atol=1e-12, err_msg=name)
    labels = np.random.default_rng(0).integers(-1, category.num_parts, (3, 7))
    again = permute_labels(permute_labels(labels, symmetry), symmetry)
    np.testing.assert_array_equal(again, labels)


@pytest.mark.parametrize(
    ("name", "symmetry"), [pair for pair in DECLARED if pair[0] in ("box", "laptop")]
)
def test_second_readings_of_clamshells_keep_their_conventions(name, symmetry):
    """Hinge along -x (so that positive opens) and behind the middle, in both readings."""
    category = categories.get(name)
    pivot = {"box": (0.0, 0.02, -0.1), "laptop": (0.0, -0.1, -0.12)}[name]
    pose = random_pose(category, frames=1).replace(
        joint_axis=np.array([[[-1.0, 0.0, 0.0]]]), joint_pivot=np.array([[pivot]])
    )
    other = apply_symmetry(pose, symmetry, category)
    np.testing.assert_allclose(other.joint_axis, [[[-1, 0, 0]]], atol=1e-12)
    mirrored = {"box": (0.0, -0.02, -0.1), "laptop": (0.0, -0.12, -0.1)}[name]
    np.testing.assert_allclose(other.joint_pivot, [[mirrored]], atol=1e-12)


def test_second_reading_keeps_numpy_arrays_and_their_precision():
    category = categories.get("box")
    pose = random_pose(category)
    for dtype in (np.float32, np.float64):
        cast = ArticulatedPose(**{name: v.astype(dtype) for name, v in vars(pose).items()})
        other = apply_symmetry(cast, category.symmetries[0], category)
        assert all(type(v) is np.ndarray and v.dtype == dtype for v in vars(other).values())


def test_second_labels_name_the_parts_anew():
    three_cycle = Symmetry((1, 2, 0), HALF_TURN_Z, "")
    # Part k of the second reading is part permutation[k] of the first: old 1 is new 0.
    labels = np.array([[0, 1, 2, -1]])
    np.testing.assert_array_equal(permute_labels(labels, three_cycle), [[2, 0, 1, -1]])


def test_is_ambiguous_compares_what_changes_places():
    (box,), (laptop,) = (categories.get(name).symmetries for name in ("box", "laptop"))
    like = np.array([[0.22, 0.02, 0.09], [0.22, 0.017, 0.09]])
    deep = np.array([[0.22, 0.12, 0.09], [0.22, 0.01, 0.09]])
    np.testing.assert_array_equal(is_ambiguous(np.stack([like, deep]), box), [True, False])
    assert not is_ambiguous(like, dataclasses.replace(box, tolerance=0.1))
    # At rest a lid stands: its height is the depth of the base, its thickness the other's height.
    plates = np.array([[0.33, 0.012, 0.23], [0.33, 0.22, 0.010]])
    thick = np.array([[0.33, 0.030, 0.23], [0.33, 0.22, 0.008]])
    np.testing.assert_array_equal(is_ambiguous(np.stack([plates, thick]), laptop), [True, False])
    assert not is_ambiguous(like, laptop)


def test_permutations_that_break_the_tree_are_refused():
    pose = random_pose(SIDES)
    with pytest.raises(CaperError, match="joint between parts 1 and 2, which have none"):
        apply_symmetry(pose, Symmetry((1, 2, 0), HALF_TURN_Z, ""), SIDES)
    mixed = made_up(HINGE, SLIDE, symmetry=Symmetry((0, 2, 1), HALF_TURN_Y, ""))
    with pytest.raises(CaperError, match=r"'made up'.* prismatic joint of part 2"):
        apply_symmetry(pose, mixed.symmetries[0], mixed)
