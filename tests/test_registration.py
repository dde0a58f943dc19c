"""Registration to the surface seen so far: what it keeps of clouds, and the motions it finds."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import quick_jit
from scipy.spatial.transform import Rotation

from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.geometry import se3
from caper_jax.networks.graph import smallest
from caper_jax.tracking import registration
from caper_jax.tracking.registration import (
    PartPoses,
    RegistrationConfig,
    Tree,
    empty_surface,
    extend_surface,
    hold_still,
    mismatch,
    move_surface,
    part_poses,
    register,
)

CONFIG = RegistrationConfig()
EYE = jnp.eye(4)
# Types, parents, axes, pivots, and the boxes of the parts (size, centre) at rest; units.
TREES = {
    "hinge": (
        ("revolute",),
        (0,),
        [[1, 0, 0]],
        [[0, 0.1, -0.5]],
        [((1.4, 0.2, 1.0), (0, 0, 0)), ((1.4, 1.0, 0.2), (0, 0.7, -0.4))],
    ),
    "slide": (
        ("prismatic",),
        (0,),
        [[0, 0, 1]],
        [[0, 0, 0]],
        [((1.0, 1.0, 1.0), (0, 0, 0)), ((0.6, 0.4, 0.8), (0, 0.1, 0.7))],
    ),
    "chain": (
        ("revolute", "prismatic", "revolute"),
        (0, 1, 2),
        [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        [[0, 0.2, 0], [0, 0, 0], [0, 0.4, 1.2]],
        [
            ((0.8, 0.4, 0.6), (0, 0, 0)),
            ((0.4, 0.5, 0.9), (0, 0.45, 0.3)),
            ((0.3, 0.3, 0.6), (0, 0.4, 0.9)),
            ((0.5, 0.2, 0.8), (0, 0.4, 1.6)),
        ],
    ),
}
# Twist, and what each kind of joint moves by, from frame to frame.
TWIST = np.array([0.04, -0.03, 0.05, 0.03, 0.05, -0.04])
MOVE = {"revolute": 0.08, "prismatic": 0.06}


def tree_of(name: str) -> Tree:
    types, parents, axis, pivot, _ = TREES[name]
    return Tree(jnp.array(axis, float), jnp.array(pivot, float), types, parents)


def plane(rng, count, z=0.0, side=1.0):
    """[N, 3] points of a square around the z axis."""
    return np.column_stack([rng.uniform(-side / 2, side / 2, (count, 2)), np.full(count, z)])


def own_points(name: str, each: int, seed: int):
    """(points [N, 3] in the frames of their parts, labels [N]): the faces of the boxes, evenly."""
    rng = np.random.default_rng(seed)
    points, labels = [], []
    for part, (size, center) in enumerate(TREES[name][-1]):
        size = np.array(size)
        area = size.prod() / size
        face = rng.choice(3, each, p=area / area.sum())
        unit = rng.uniform(-0.5, 0.5, (each, 3))
        unit[np.arange(each), face] = rng.choice([-0.5, 0.5], each)
        points.append(unit * size + center)
        labels.append(np.full(each, part))
    mixed = rng.permutation(each * len(points))  # so that every stride sees all parts
    return np.concatenate(points)[mixed], np.concatenate(labels)[mixed]


@cache
def seen(name: str):
    """A surface, part poses, a new cloud and its true pose: root [4, 4] and states [J]."""
    tree = tree_of(name)
    each = 512 // len(TREES[name][-1])
    state = jnp.array([0.3 if kind == "revolute" else 0.1 for kind in tree.types])
    parts = PartPoses(tree, state, part_poses(tree, state))
    points, labels = own_points(name, 4 * each, 0)
    surface = quick_jit(partial(extend_surface, config=CONFIG))(
        empty_surface(CONFIG), jnp.asarray(points, float), jnp.asarray(labels)
    )
    root = se3.from_rt(Rotation.from_rotvec([0.5, 0.9, -0.3]).as_matrix(), [0.1, -0.2, 3.0])
    moved = state + jnp.array([MOVE[kind] for kind in tree.types])
    after = se3.compose(root, se3.exp(TWIST))
    points, labels = own_points(name, each, 1)
    poses = forward_kinematics(after, tree.axis, tree.pivot, moved, tree.types, tree.parents)
    cloud = se3.act(poses[labels], jnp.asarray(points, float)[:, None])[:, 0]
    return surface, parts, cloud, jnp.asarray(labels), (root, state), (after, moved)


class TestSurface:
    """What a cloud leaves behind."""

    extend = staticmethod(quick_jit(extend_surface, static_argnums=3))

    def test_gaussians_of_a_plane_lie_on_it_and_inform_across_it(self):
        turn = Rotation.from_rotvec([0.4, -0.7, 0.2])
        points = turn.apply(plane(np.random.default_rng(0), 1024)) + [0.3, 0.1, 0.2]
        surface = self.extend(empty_surface(CONFIG), points, np.zeros(1024, np.int32), CONFIG)
        assert surface.added == 256
        mean, information = np.asarray(surface.mean[:256]), np.asarray(surface.information[:256])
        normal = turn.as_matrix()[:, 2]
        np.testing.assert_allclose((mean - [0.3, 0.1, 0.2]) @ normal, 0.0, atol=1e-5)
        across = np.einsum("i,nij,j->n", normal, information, normal)
        np.testing.assert_allclose(across, 1 / CONFIG.noise**2, rtol=0.1)
        for along in turn.as_matrix().T[:2]:
            assert np.einsum("i,nij,j->n", along, information, along).max() < 0.01 / CONFIG.noise**2
        # Nothing beyond: the rest of the surface is nowhere.
        assert np.linalg.norm(surface.mean[256:], axis=1).min() > 100

    def test_what_was_seen_before_adds_nothing(self):
        points = plane(np.random.default_rng(1), 1024)
        labels = np.zeros(1024, np.int32)
        once = self.extend(empty_surface(CONFIG), points, labels, CONFIG)
        twice = self.extend(once, points, labels, CONFIG)
        jax.tree.map(np.testing.assert_array_equal, twice, once)
        # Of the other part it was not.
        other = self.extend(once, points, labels + 1, CONFIG)
        assert other.added == 512
        np.testing.assert_array_equal(other.labels, np.repeat([0, 1], 256))
        # A patch that lies half beyond is added half.
        more = self.extend(once, points + [0.5, 0, 0], labels, CONFIG)
        fresh = np.asarray(more.mean[256 : int(more.added)])
        assert 80 < len(fresh) < 128 and fresh[:, 0].min() > 0.5

    def test_the_oldest_give_way(self):
        config = RegistrationConfig(gaussians=32, capacity=64)
        rng = np.random.default_rng(2)
        surface, places = empty_surface(config), [(0, 0, 0), (5, 0, 0), (0, 5, 0), (0, 0, 5)]
        for number, place in enumerate(places):
            points = plane(rng, 64) + place
            surface = self.extend(surface, points, np.full(64, number % 2, np.int32), config)
            half = 32 * (number % 2)
            assert surface.added == 32 * (number + 1)
            near = np.abs(np.asarray(surface.mean) - place).max(1) < 0.6
            np.testing.assert_array_equal(near, (np.arange(64) // 32) * 32 == half)
        np.testing.assert_array_equal(surface.labels, np.repeat([0, 1], 32))

    def test_parts_never_mix(self):
        """Two sheets, a fraction of the window apart."""
        rng = np.random.default_rng(3)
        labels = np.arange(1024) % 2
        points = plane(rng, 1024) + np.outer(labels, [0, 0, 0.02])
        surface = self.extend(empty_surface(CONFIG), points, labels, CONFIG)
        kinds = np.asarray(surface.labels[: int(surface.added)])
        assert set(kinds) == {0, 1}
        np.testing.assert_allclose(surface.mean[: len(kinds), 2], 0.02 * kinds, atol=1e-5)

    def test_moving_the_frames_leaves_it_where_it_is(self):
        surface, parts, *_ = seen("chain")
        rng = np.random.default_rng(4)
        new = se3.compose(parts.poses, se3.exp(rng.normal(size=(4, 6)) * 0.2))
        motions = se3.compose(se3.inverse(new), parts.poses)
        moved = move_surface(surface, motions)

        def in_camera(surface, poses):
            poses = poses[surface.labels]
            turn = poses[:, :3, :3]
            spread = turn @ surface.information @ jnp.swapaxes(turn, 1, 2)
            return se3.act(poses, surface.mean[:, None])[:, 0], spread

        count = int(surface.added)
        for one, other in zip(in_camera(moved, new), in_camera(surface, parts.poses), strict=True):
            np.testing.assert_allclose(one[:count], other[:count], rtol=1e-4, atol=0.05 * 1e-2)
        assert np.abs(np.asarray(moved.mean - surface.mean))[:count].max() > 0.05


@pytest.mark.parametrize("name", TREES)
def test_part_poses_are_forward_kinematics(name):
    tree = tree_of(name)
    rng = np.random.default_rng(5)
    before, after = jnp.asarray(rng.normal(size=(2, len(tree.types))))

    def truth(state):
        return forward_kinematics(EYE, tree.axis, tree.pivot, state, tree.types, tree.parents)

    found = PartPoses(tree, before, truth(before)).at(after)
    np.testing.assert_allclose(found, truth(after), atol=1e-5)
    # Poses that no joints explain are kept as they are at their own states.
    odd = se3.compose(truth(before), se3.exp(rng.normal(size=(len(tree.types) + 1, 6)) * 0.1))
    np.testing.assert_allclose(PartPoses(tree, before, odd).at(before), odd, atol=1e-6)


class TestRegister:
    @pytest.mark.parametrize("name", TREES)
    def test_finds_a_known_motion(self, name):
        """Other points of the same faces, moved; without anything to expect."""
        surface, parts, cloud, labels, start, (root, state) = seen(name)
        run = quick_jit(partial(register, expected=(), config=RegistrationConfig(steps=6)))
        found, joints, information = run(surface, parts, cloud, labels, start)
        off = se3.log(se3.compose(se3.inverse(root), found))
        assert np.degrees(np.linalg.norm(off[:3])) < 0.1
        assert np.linalg.norm(off[3:]) < 0.005
        for kind, error in zip(parts.tree.types, np.abs(joints - state), strict=True):
            assert error < (np.radians(0.1) if kind == "revolute" else 0.005)
        assert np.linalg.eigvalsh(np.asarray(information)).min() > 0
