"""Registration to the surface seen so far: what it keeps of clouds, and the motions it finds."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.config import RegistrationConfig
from caper_jax.errors import CaperError
from caper_jax.lie import se3
from caper_jax.models.encoders.neighbors import smallest
from caper_jax.tracking import registration
from caper_jax.tracking.registration import (
    JointTree,
    PartPoses,
    empty_surface,
    extend_surface,
    match_cost,
    move_surface,
    register,
    suppress_jitter,
)

CONFIG = RegistrationConfig()
# Types, parents, axes, pivots, and the boxes of the parts (size, center) at rest; units.
TREES = {
    "hinge": (
        ("revolute",),
        (0,),
        [[1, 0, 0]],
        [[0, 0.5, -0.5]],
        [((1.4, 0.8, 1.0), (0, 0, 0)), ((1.4, 0.7, 1.0), (0, 1.0, 0))],
    ),
    "slide": (
        ("prismatic",),
        (0,),
        [[0, 0, 1]],
        [[0, 0, 0]],
        [((1.0, 1.0, 1.0), (0, 0, 0)), ((0.8, 0.7, 0.8), (0, 0.1, 1.1))],
    ),
    "chain": (
        ("revolute", "prismatic", "revolute"),
        (0, 1, 2),
        [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        [[0, 0.5, 0], [0, 0, 0], [0, 1.0, 1.8]],
        [
            ((1.0, 0.7, 0.9), (0, 0, 0)),
            ((0.8, 0.7, 1.0), (0, 1.0, 0.0)),
            ((0.7, 0.8, 0.7), (0, 1.0, 1.2)),
            ((0.9, 0.7, 0.8), (0, 1.0, 2.3)),
        ],
    ),
}
# Twist, and what each kind of joint moves by, from frame to frame.
TWIST = np.array([0.04, -0.03, 0.05, 0.03, 0.05, -0.04])
MOVE = {"revolute": 0.08, "prismatic": 0.06}


def tree_of(name: str) -> JointTree:
    types, parents, axis, pivot, _ = TREES[name]
    return JointTree(np.array(axis, np.float32), np.array(pivot, np.float32), types, parents)


def rigid(turn, shift):
    """[4, 4] of a rotation vector and a translation."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return pose


def twist(xi):
    """[4, 4] of a twist (w, rho): the exponential of its matrix."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = np.cross(np.eye(3), xi[:3]), xi[3:]
    return expm(matrix)


def kinematics(tree: JointTree, state):
    """[K, 4, 4] part poses in the root's frame, by SciPy."""
    poses = [np.eye(4)]
    for kind, parent, axis, pivot, value in zip(
        tree.types, tree.parents, tree.axis, tree.pivot, state, strict=True
    ):
        move = rigid(axis * value, 0.0) if kind == "revolute" else rigid(np.zeros(3), axis * value)
        move[:3, 3] += pivot - move[:3, :3] @ pivot
        poses.append(poses[parent] @ move)
    return np.stack(poses)


def act(poses, points):
    """[N, 3] points, each moved by its own pose [N, 4, 4]."""
    return np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3]


def turn_and_shift(one, other):
    """Degrees and units between two rigid transforms."""
    one, other = np.asarray(one, float), np.asarray(other, float)
    turn = Rotation.from_matrix(one[:3, :3].T @ other[:3, :3]).magnitude()
    return np.degrees(turn), np.linalg.norm(one[:3, 3] - other[:3, 3])


def plane(rng, count, z=0.0, side=1.0):
    """[N, 3] points of a square around the z axis."""
    return np.column_stack([rng.uniform(-side / 2, side / 2, (count, 2)), np.full(count, z)])


def own_points(name: str, count: int, seed: int):
    """(points [N, 3] in the frames of their parts, labels [N]): the faces of the boxes.

    Without their rims: where a Gaussian bends round an edge it lies within the box.
    """
    rng = np.random.default_rng(seed)
    sizes, centers = (np.array(rows) for rows in zip(*TREES[name][-1], strict=True))
    labels = rng.integers(0, len(sizes), count)
    points = rng.uniform(-0.25, 0.25, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
    return points * sizes[labels] + centers[labels], labels.astype(np.int32)


extend = jax.jit(extend_surface, static_argnums=3)


@cache
def seen(name: str):
    """A surface, part poses, a new cloud, its labels, and pairs of root pose [4, 4] and states [J].

    The pairs are those of the surface's frame and the new cloud's.
    """
    tree = tree_of(name)
    state = np.array([0.3 if kind == "revolute" else 0.1 for kind in tree.types])
    parts = PartPoses(tree, np.float32(state), np.float32(kinematics(tree, state)))
    points, labels = own_points(name, 2048, 0)
    surface = extend(empty_surface(CONFIG), np.float32(points), labels, CONFIG)
    root = rigid([0.5, 0.9, -0.3], [0.1, -0.2, 3.0])
    moved = state + [MOVE[kind] for kind in tree.types]
    after = root @ twist(TWIST)
    points, labels = own_points(name, 512, 1)
    cloud = act((after @ kinematics(tree, moved))[labels], points)
    pairs = [
        (np.float32(pose), np.float32(value)) for pose, value in ((root, state), (after, moved))
    ]
    return surface, parts, np.float32(cloud), labels, *pairs


class TestSurface:
    """What clouds leave behind."""

    def test_gaussians_of_a_plane_lie_on_it_and_inform_across_it(self):
        turn = Rotation.from_rotvec([0.4, -0.7, 0.2])
        points = turn.apply(plane(np.random.default_rng(0), 2048)) + [0.3, 0.1, 0.2]
        surface = extend(
            empty_surface(CONFIG), np.float32(points), np.zeros(2048, np.int32), CONFIG
        )
        assert surface.added == 256
        mean, information = np.asarray(surface.mean[:256]), np.asarray(surface.information[:256])
        normal = turn.as_matrix()[:, 2]
        np.testing.assert_allclose((mean - [0.3, 0.1, 0.2]) @ normal, 0.0, atol=1e-5)
        across = np.einsum("i,nij,j->n", normal, information, normal)
        np.testing.assert_allclose(across, 1 / CONFIG.noise**2, rtol=0.1)
        for along in turn.as_matrix().T[:2]:
            assert np.einsum("i,nij,j->n", along, information, along).max() < 0.01 * across.min()
        # Nothing beyond: the rest of the surface is nowhere.
        assert np.linalg.norm(surface.mean[256:], axis=1).min() > 100

    def test_what_was_seen_before_adds_nothing(self):
        points = np.float32(plane(np.random.default_rng(1), 2048))
        labels = np.zeros(2048, np.int32)
        once = extend(empty_surface(CONFIG), points, labels, CONFIG)
        twice = extend(once, points, labels, CONFIG)
        jax.tree.map(np.testing.assert_array_equal, twice, once)
        # Of the other part it is new.
        other = extend(once, points, labels + 1, CONFIG)
        assert other.added == 512
        np.testing.assert_array_equal(other.labels, np.repeat([0, 1], 256))
        # Half of a patch that lies half beyond.
        more = extend(once, points + np.float32([0.5, 0, 0]), labels, CONFIG)
        fresh = np.asarray(more.mean[256 : int(more.added)])
        assert 80 < len(fresh) < 150 and (fresh[:, 0] > 0.45).mean() > 0.95

    def test_the_oldest_give_way(self):
        config = RegistrationConfig(gaussians=32, capacity=64)
        rng = np.random.default_rng(2)
        surface = empty_surface(config)
        for number, place in enumerate([(0, 0, 0), (5, 0, 0), (0, 5, 0), (0, 0, 5)]):
            points = np.float32(plane(rng, 64) + place)
            surface = extend(surface, points, np.full(64, number % 2, np.int32), config)
            assert surface.added == 32 * (number + 1)
            near = np.abs(np.asarray(surface.mean) - place).max(1) < 0.6
            np.testing.assert_array_equal(near, np.arange(64) // 32 == number % 2)
        np.testing.assert_array_equal(surface.labels, np.repeat([0, 1], 32))

    def test_every_region_of_a_cloud_counts(self):
        """Also where the number of points is no multiple of that of Gaussians."""
        points = np.float32(plane(np.random.default_rng(6), 1000))
        order = np.argsort(points[:, 0])
        surface = extend(empty_surface(CONFIG), points[order], np.zeros(1000, np.int32), CONFIG)
        assert surface.added == 256
        covered = np.asarray(surface.mean[:256, 0])
        assert covered.max() > points[:, 0].max() - CONFIG.window
        few = extend(empty_surface(CONFIG), points[:100], np.zeros(100, np.int32), CONFIG)
        assert few.added == 100

    def test_more_gaussians_than_room_are_refused(self):
        with pytest.raises(CaperError, match=r"gaussians = 65 must be at most .*capacity = 64"):
            RegistrationConfig(gaussians=65, capacity=64)

    def test_parts_never_mix(self):
        """Two sheets, a fraction of the window apart."""
        rng = np.random.default_rng(3)
        labels = rng.integers(0, 2, 2048).astype(np.int32)
        points = plane(rng, 2048) + np.outer(labels, [0, 0, 0.02])
        surface = extend(empty_surface(CONFIG), np.float32(points), labels, CONFIG)
        kinds = np.asarray(surface.labels[: int(surface.added)])
        assert set(kinds) == {0, 1}
        np.testing.assert_allclose(surface.mean[: len(kinds), 2], 0.02 * kinds, atol=1e-6)

    def test_moving_the_frames_leaves_it_where_it_is(self):
        surface, parts, *_ = seen("chain")
        turns = Rotation.random(4, rng=np.random.default_rng(4)).as_rotvec()
        new = parts.poses @ np.stack([rigid(0.2 * turn, 0.1 * turn) for turn in turns])
        moved = move_surface(surface, np.linalg.inv(new) @ parts.poses)
        old, count = parts.poses[surface.labels], int(surface.added)
        new = new[surface.labels]
        kept, there = act(old, surface.mean), act(new, moved.mean)
        np.testing.assert_allclose(there[:count], kept[:count], atol=1e-5)
        assert np.abs(moved.mean - surface.mean)[:count].max() > 0.1
        kept, there = (
            poses[:, :3, :3] @ information @ poses[:, :3, :3].swapaxes(1, 2)
            for poses, information in ((old, surface.information), (new, moved.information))
        )
        np.testing.assert_allclose(there, kept, atol=1e-5 / CONFIG.noise**2)


@pytest.mark.parametrize("parents", [(0, 1, 2), (0, 0, 1)])
def test_part_poses_are_forward_kinematics(parents):
    tree = replace(tree_of("chain"), parents=parents)
    rng = np.random.default_rng(5)
    before, after = np.float32(rng.normal(size=(2, 3)))

    @jax.jit
    def both(poses, state):
        joints = tree.axis, tree.pivot, state, tree.types, parents
        return PartPoses(tree, before, poses).at(state), forward_kinematics(jnp.eye(4), *joints)

    found, truth = both(np.float32(kinematics(tree, before)), after)
    np.testing.assert_allclose(found, truth, atol=2e-6)
    np.testing.assert_allclose(truth, kinematics(tree, after), atol=2e-6)
    # Poses that no joints explain are kept as they are at the keyframe's states.
    odd = np.stack([rigid(row[:3], row[3:]) for row in rng.normal(size=(4, 6))])
    np.testing.assert_allclose(both(np.float32(odd), before)[0], odd, atol=2e-6)


class TestRegister:
    @pytest.mark.parametrize("name", TREES)
    def test_finds_a_known_motion(self, name):
        """Other points of the same faces, moved; without anything to expect."""
        surface, parts, cloud, labels, start, (root, state) = seen(name)
        run = jax.jit(partial(register, expected=(), config=RegistrationConfig(steps=8)))
        found, joints, information = run(surface, parts, cloud, labels, start)
        degrees, shift = turn_and_shift(found, root)
        assert degrees < 0.1 and shift < 0.005
        for kind, error in zip(parts.tree.types, np.abs(joints - state), strict=True):
            assert error < (np.radians(0.1) if kind == "revolute" else 0.005)
        assert np.linalg.eigvalsh(np.asarray(information)).min() > 0

    def test_what_nothing_shows_is_as_expected(self):
        """A plane may slide in itself: only across it is anything found."""
        rng = np.random.default_rng(6)
        tree = tree_of("hinge")
        parts = PartPoses(tree, np.zeros(1, np.float32), np.float32(kinematics(tree, [0.0])))
        points = np.float32(plane(rng, 2048))
        surface = extend(empty_surface(CONFIG), points, np.zeros(2048, np.int32), CONFIG)
        start = np.eye(4, dtype=np.float32), np.zeros(1, np.float32)
        away = [0.0, 0.0, 0.05, 0.03, -0.04, 0.02]
        expected = np.float32(twist(away)), np.float32([0.3])
        sigma = np.float32([0.01] * 7)
        found, joints, _ = jax.jit(partial(register, config=CONFIG))(
            surface, parts, points[::4], np.zeros(512, np.int32), start, ((expected, sigma),)
        )
        truth = expected[0].copy()
        truth[2, 3] = 0.0
        np.testing.assert_allclose(found, truth, atol=2e-3)
        np.testing.assert_allclose(joints, 0.3, atol=1e-5)

    def test_jacobian_is_that_of_the_residuals(self):
        """Against differences in float64; steps too small to change a match."""
        surface, parts, cloud, labels, start, _ = seen("chain")
        with jax.enable_x64(True):
            rng = np.random.default_rng(7)
            wide = partial(jax.tree.map, lambda leaf: np.asarray(leaf, float))
            surface = wide(surface).replace(labels=surface.labels, added=surface.added)
            root, state = wide(start)
            odd = [rigid(0.1 * row[:3], 0.1 * row[3:]) for row in rng.normal(size=(4, 6))]
            parts = PartPoses(parts.tree, wide(parts.state) - 0.1, wide(parts.poses) @ odd)
            cloud = np.asarray(cloud[:100], float)

            @jax.jit
            def linearized(step):
                pose = se3.compose(root, se3.exp(step[:6])), state + step[6:]
                about = surface, parts, cloud, labels[:100], *pose, CONFIG
                matches = registration._residuals(*about)[-1]
                return *registration._linearize(*about)[:2], matches

            _, jacobian, matches = linearized(np.zeros(9))
            assert jacobian.shape == (100, 3, 9)
            assert len(set(np.asarray(surface.labels)[matches])) == 4
            for column, step in enumerate(1e-6 * np.eye(9)):
                ahead, behind = linearized(step), linearized(-step)
                np.testing.assert_array_equal(ahead[-1], matches)
                slope = (ahead[0] - behind[0]) / 2e-6
                np.testing.assert_allclose(jacobian[:, :, column], slope, atol=1e-7)


def test_mismatch_is_nothing_at_the_truth_and_one_far_away():
    surface, parts, cloud, labels, start, truth = seen("hinge")
    found = jax.jit(partial(match_cost, config=CONFIG))
    assert found(surface, parts, cloud, labels, truth) < 0.01
    assert 0.1 < found(surface, parts, cloud, labels, start) < 0.9
    assert found(surface, parts, cloud + np.float32([0, 0, 2]), labels, truth) > 0.99


class TestHoldStill:
    """With 1 / sigma^2 = 1e4 on the diagonal, and a threshold of 9: three sigma."""

    def held(self, xi, information=None):
        before = rigid([0.3, -0.8, 0.1], [0.2, 0.1, 2.0])
        root = before @ twist(xi)
        if information is None:
            information = 1e4 * np.eye(7)
        values = (np.float32(value) for value in (before, root, information))
        before, *rest = values
        return before, hold(before, *rest, 9.0), root

    def share(self, *arguments):
        """How much of the motion is left."""
        before, found, root = self.held(*arguments)
        along = np.linalg.inv(before) @ root
        return turn_and_shift(before, found)[1] / np.linalg.norm(along[:3, 3])

    def test_within_the_threshold_nothing_moves(self):
        for size in (0.0, 1e-4, 0.029):
            before, found, _ = self.held([0, 0, 0, size, 0, 0])
            np.testing.assert_allclose(found, before, atol=0)

    def test_far_beyond_all_of_it_does(self):
        _, found, root = self.held([0.1, 0.2, -0.1, 0.5, 0.3, 0.2])
        assert turn_and_shift(found, root) < (0.1, 0.001)

    def test_in_between_more_is_more(self):
        sizes = [0.031, 0.04, 0.06, 0.1, 0.3]
        shares = [self.share([0, 0, 0, size, 0, 0]) for size in sizes]
        np.testing.assert_allclose(shares, 1 - (0.03 / np.array(sizes)) ** 2, atol=1e-3)

    def test_joint_states_are_marginalized_out(self):
        """A motion that a joint explains as well is within the uncertainty."""
        information = 1e4 * np.eye(7)
        information[3, 6] = information[6, 3] = 0.99 * 1e4
        assert self.share([0, 0, 0, 0.1, 0, 0], information) == 0.0
        assert self.share([0, 0, 0, 0, 0.1, 0], information) == pytest.approx(0.91, abs=1e-3)


hold = jax.jit(suppress_jitter)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1, 7, 512, 1024, 1025])
def test_smallest_is_the_argmin(dtype, size):
    with jax.enable_x64(dtype == np.float64):
        rng = np.random.default_rng(8)
        squared = (rng.normal(size=(200, size)) ** 2 * 10.0 ** rng.integers(-4, 4)).astype(dtype)
        squared[0, size // 2] = 0.0
        squared[1, 1:] = np.inf
        index = np.asarray(smallest(jnp.asarray(squared)))
        chosen, least = squared[np.arange(200), index], squared.min(-1)
        exact = dtype == np.float64 or size > 1024
        assert (chosen <= least * (1 if exact else 1 + 2.0**-13)).all()
        assert (index == squared.argmin(-1)).mean() > 0.95
        assert (index[:2] == squared[:2].argmin(-1)).all()
