"""Pieces of a tracker's step: energy, joints from poses, increments, keyframes, running means."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.config import TrackerConfig
from caper_jax.models.parts import increment_numbers, increment_transform
from caper_jax.models.rotation_classes import CUBE_ROTATIONS, NUM_CUBE_ROTATIONS
from caper_jax.tracking import keyframes
from caper_jax.tracking.keyframes import chamfer_energy
from caper_jax.tracking.measurement import (
    PoseMeasurement,
    box_residual,
    diagonal,
    joints_from_poses,
    update_parameters,
)
from caper_jax.tracking.state import ObjectParameters

LAPTOP = categories.get("laptop")
# A door, and a drawer in it: of the category, only types and tree are looked at.
DOOR = SimpleNamespace(joint_types=("revolute", "prismatic"), parents=(0, 1))


def rigid(turn, shift=(0, 0, 0)):
    """[4, 4] of a rotation vector and a translation."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return pose


def unit(vector):
    return np.asarray(vector, float) / np.linalg.norm(vector)


def angle(one, other):
    """Degrees between two unit vectors."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other)), np.dot(one, other)))


class TestEnergy:
    energy = staticmethod(jax.jit(chamfer_energy, static_argnums=4))

    def clouds(self):
        rng = np.random.default_rng(0)
        first, second = rng.normal(size=(200, 3)), rng.normal(size=(150, 3))
        labels = rng.integers(0, 3, 200), rng.integers(0, 3, 150)
        return np.float32(first), labels[0], np.float32(second), labels[1]

    def by_trees(self, points, labels, others, other_labels):
        """Mean over parts, where both have some, by SciPy."""
        both = set(labels) & set(other_labels)
        ways = []
        for part in both:
            one, two = points[labels == part], others[other_labels == part]
            ways.append(cKDTree(two).query(one)[0].mean() / 2)
            ways.append(cKDTree(one).query(two)[0].mean() / 2)
        return sum(ways) / len(both)

    def test_is_the_mean_of_both_ways_part_by_part(self):
        first, labels, second, other = self.clouds()
        expected = self.by_trees(first, labels, second, other)
        found = self.energy(first, labels, second, other, 3, 1.0)
        assert found == pytest.approx(expected, rel=1e-5)
        # Relative to the size; clouds and object grow alike.
        found = self.energy(first, labels, second, other, 3, 4.0)
        assert found == pytest.approx(expected / 4, rel=1e-5)
        grown = self.energy(4 * first, labels, 4 * second, other, 3, 4.0)
        assert grown == pytest.approx(expected, rel=1e-5)

    def test_parts_that_one_cloud_lacks_are_left_out(self):
        first, labels, second, other = self.clouds()
        without = np.where(other == 1, 2, other)
        expected = self.by_trees(first, labels, second, without)
        found = self.energy(first, labels, second, without, 3, 1.0)
        assert found == pytest.approx(expected, rel=1e-5)
        assert self.energy(first, 0 * labels, second, 0 * other + 1, 3, 1.0) == 0

    def test_equal_clouds_cost_nothing(self):
        first, labels, *_ = self.clouds()
        assert self.energy(first, labels, first, labels, 3, 1.0) == 0
        slopes = jax.jit(jax.grad(partial(chamfer_energy, num_parts=3)))
        found = slopes(first, labels, first, labels, size=1.0)
        assert np.isfinite(found).all()


class TestJointsFromPoses:
    AXIS = np.array([unit([0.2, 1.0, -0.3]), unit([0.1, -0.4, 1.0])])
    PIVOT = np.array([[0.3, -0.2, 0.4], [0.0, 0.0, 0.0]])
    fit = staticmethod(jax.jit(partial(joints_from_poses, category=DOOR)))

    def parts(self, turn, slide):
        """[3, 4, 4] poses in the root's frame."""
        door = rigid(self.AXIS[0] * turn)
        door[:3, 3] = self.PIVOT[0] - door[:3, :3] @ self.PIVOT[0]
        return np.float32(
            np.stack([np.eye(4), door, door @ rigid([0, 0, 0], slide * self.AXIS[1])])
        )

    def votes(self, axis, pivot):
        return ObjectParameters(
            axis=np.float32(axis),
            pivot=np.float32(pivot),
            size=np.ones((3, 3), np.float32),
            center=np.zeros((3, 3), np.float32),
            num_frames=np.float32(1),
            known=np.zeros(2, np.float32),
        )

    def wrong(self):
        """Votes 20 degrees and 0.2 units beside the truth."""
        beside = np.cross(self.AXIS, [[1.0, 0, 0]])
        beside /= np.linalg.norm(beside, axis=1, keepdims=True)
        axis = np.cos(0.35) * self.AXIS + np.sin(0.35) * beside
        return axis, self.PIVOT + 0.2 * beside

    def off_the_line(self, pivot):
        return np.linalg.norm(np.cross(pivot - self.PIVOT[0], self.AXIS[0]))

    def test_a_large_motion_says_it_all(self):
        states, parameters = self.fit(self.parts(1.2, 0.9), self.votes(*self.wrong()))
        np.testing.assert_allclose(states, [1.2, 0.9], atol=1e-5)
        assert angle(parameters.axis[0], self.AXIS[0]) < 0.2
        assert angle(parameters.axis[1], self.AXIS[1]) < 0.3
        assert self.off_the_line(parameters.pivot[0]) < 0.005
        assert (np.asarray(parameters.known) > 100).all()

    def test_at_rest_the_votes_stay(self):
        votes = self.votes(*self.wrong())
        states, parameters = self.fit(self.parts(0.0, 0.0), votes)
        np.testing.assert_allclose(states, 0.0, atol=1e-6)
        np.testing.assert_allclose(parameters.axis, votes.axis, atol=1e-6)
        np.testing.assert_allclose(parameters.pivot, votes.pivot, atol=1e-6)
        np.testing.assert_allclose(parameters.known, 0.0, atol=1e-6)

    def test_in_between_both_count(self):
        errors, lines = [], []
        for share in (0.0, 0.05, 0.1, 0.3, 1.0):
            found = self.fit(self.parts(share, share), self.votes(*self.wrong()))[1]
            errors.append([angle(*pair) for pair in zip(found.axis, self.AXIS, strict=True)])
            lines.append(self.off_the_line(found.pivot[0]))
        assert (np.diff(errors, axis=0) < 0).all() and (np.diff(lines) < 0).all()

    def test_signs_follow_the_votes(self):
        axis, pivot = self.wrong()
        states, parameters = self.fit(self.parts(-0.7, -0.4), self.votes(axis, pivot))
        np.testing.assert_allclose(states, [-0.7, -0.4], atol=1e-5)
        assert (np.sum(parameters.axis * self.AXIS, 1) > 0.99).all()
        states, parameters = self.fit(self.parts(-0.7, -0.4), self.votes(-axis, pivot))
        np.testing.assert_allclose(states, [0.7, 0.4], atol=1e-5)
        assert (np.sum(parameters.axis * self.AXIS, 1) < -0.99).all()

    def test_slopes_are_finite_at_rest(self):
        def total(parts, votes):
            states, parameters = joints_from_poses(parts, votes, DOOR)
            return states.sum() + parameters.axis.sum() + parameters.pivot.sum()

        slopes = jax.jit(jax.grad(total, argnums=(0, 1)))
        for turn, slide in ((0.0, 0.0), (0.5, 0.2)):
            found = slopes(self.parts(turn, slide), self.votes(*self.wrong()))
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


SIZES = {"lie": 6, "euclidean": 9}  # numbers of an increment


class TestIncrement:
    """Transforms as numbers of a network, and back."""

    transform = staticmethod(jax.jit(increment_transform, static_argnums=1))
    numbers = staticmethod(jax.jit(increment_numbers, static_argnums=1))

    @pytest.mark.parametrize("kind", SIZES)
    def test_round_trip(self, kind):
        rng = np.random.default_rng(1)
        poses = np.float32([rigid(0.5 * row[:3], row[3:]) for row in rng.normal(size=(20, 6))])
        numbers = self.numbers(poses, kind)
        assert numbers.shape == (20, SIZES[kind])
        np.testing.assert_allclose(self.transform(numbers, kind), poses, atol=2e-6)

    @pytest.mark.parametrize("kind", SIZES)
    def test_zeros_are_the_identity_with_finite_slopes(self, kind):
        zeros = np.zeros(SIZES[kind], np.float32)
        np.testing.assert_array_equal(self.transform(zeros, kind), np.eye(4))
        slopes = jax.jit(jax.jacobian(partial(increment_transform, kind=kind)))(zeros)
        assert np.isfinite(slopes).all()
        # Six degrees of freedom.
        assert np.linalg.matrix_rank(np.asarray(slopes).reshape(16, -1)) == 6
        np.testing.assert_allclose(self.numbers(np.eye(4, dtype=np.float32), kind), 0, atol=1e-7)

    def test_lie_is_the_exponential(self):
        xi = np.array([0.3, -0.8, 0.4, 0.2, 0.5, -0.1])
        matrix = np.zeros((4, 4))
        matrix[:3, :3], matrix[:3, 3] = np.cross(np.eye(3), xi[:3]), xi[3:]
        np.testing.assert_allclose(self.transform(np.float32(xi), "lie"), expm(matrix), atol=1e-6)

    def test_euclidean_is_a_rotation_whatever_comes_out(self):
        numbers = np.float32(np.random.default_rng(2).normal(size=(50, 9)))
        numbers[0, :3] = (-1, 0, 0)  # no first axis
        numbers[1, 3:6] = numbers[1, :3] + (1, -1, 0)  # twice the same
        numbers[2, :6] = (-1, 0, 0, 0, -1, 0)  # none
        turn = np.asarray(self.transform(numbers, "euclidean"), float)[:, :3, :3]
        np.testing.assert_allclose(turn @ turn.swapaxes(1, 2), np.eye(3) + 0 * turn, atol=2e-6)
        np.testing.assert_allclose(np.linalg.det(turn), 1.0, atol=2e-6)


class TestPolicies:
    @pytest.mark.parametrize(
        ("policy", "energy", "unmatched", "age", "due"),
        [
            ("none", 0.0, 0.0, 0, True),
            ("fixed", 9.0, 1.0, 3, False),
            ("fixed", 0.0, 0.0, 4, True),
            ("dynamic", 0.02, 0.1, 99, False),
            ("dynamic", 0.04, 0.1, 0, True),
            ("dynamic", 0.02, 0.2, 0, True),
            ("promote", 0.02, 0.1, 99, False),
            ("promote", 0.04, 0.1, 0, True),
        ],
    )
    def test_when_a_keyframe_is_due(self, policy, energy, unmatched, age, due):
        config = TrackerConfig(policy=policy, interval=5, threshold=0.03, max_unmatched=0.12)
        assert bool(keyframes.is_keyframe(energy, unmatched, age, config)) == due


def laptop_fix(root, state=0.0) -> PoseMeasurement:
    """A laptop whose boxes are 2 x 2 x 2 about the origin and 2 x 1 x 1 about y = 3."""
    lid = rigid([state, 0, 0])
    parameters = ObjectParameters(
        axis=np.float32([[1, 0, 0]]),
        pivot=np.zeros((1, 3), np.float32),
        size=np.float32([[2, 2, 2], [2, 1, 1]]),
        center=np.float32([[0, 0, 0], [0, 3, 0]]),
        num_frames=np.float32(1),
        known=np.zeros(1, np.float32),
    )
    return PoseMeasurement(
        root=np.float32(root),
        joint_state=np.float32([state]),
        parts=np.float32(np.stack([np.eye(4), lid])),
        labels=POINT_LABELS,
        parameters=parameters,
        confidence=np.float32(1),
        rotation_log_odds=np.zeros(NUM_CUBE_ROTATIONS, np.float32),
        reason=np.int32(0),
    )


POINT_LABELS = np.int32([0, 0, 1, 1])
ROOT = rigid([0.4, -0.6, 0.2], [0.1, -0.2, 4.0])
# In the frames of their parts.
INSIDE = np.array([[0, 0, 0], [1, -1, 1], [0.9, 3.4, 0.4], [-1, 2.5, -0.5]])
BESIDE = np.array([[0, 0, 0], [1, -1, 1.3], [1.3, 3.4, 0.9], [-1, 2.3, -0.5]])


def in_camera(points, fix: PoseMeasurement):
    poses = (fix.root @ fix.parts)[POINT_LABELS]
    return np.float32(np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3])


class TestBoxResidual:
    measure = staticmethod(jax.jit(box_residual))

    def test_points_in_their_boxes_fit(self):
        fix = laptop_fix(ROOT, 0.5)
        assert self.measure(fix, in_camera(INSIDE, fix)) < 1e-6

    def test_distances_are_those_by_hand(self):
        """0, 0.3, (0.3, 0, 0.4) and 0.2 units; the boxes span 2 x 4.5 x 2."""
        fix = laptop_fix(ROOT, 0.5)
        span = np.sqrt(4 + 4.5**2 + 4)
        assert diagonal(fix.parameters) == pytest.approx(span)
        found = self.measure(fix, in_camera(BESIDE, fix))
        assert found == pytest.approx((0.3 + 0.5 + 0.2) / 4 / span, rel=1e-4)


def turned_answer(variables, points, labels, reference, *_):
    """Stage II's: where it is asked about, with the estimator's joint state."""
    return replace(variables, root=reference)


@pytest.fixture(scope="module")
def programs():
    """Settings -> compiled ``update_keyframe``; the estimator answers with its ``variables``."""
    compiled = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keyframes, "estimate_measurement", lambda variables, *_: variables)
        patch.setattr(keyframes, "measure", turned_answer)
        yield compiled


class TestUpdateKeyframe:
    """What becomes of a track and an estimate of known poses."""

    # Of rotation, translation and joint states, by default: what one change of keyframe adds to
    # the variances, and those of the estimator.
    DRIFT = np.array([0.01, 0.01, 0.02]) ** 2
    STATIC = np.array([0.1, 0.1, 0.15]) ** 2
    # The estimate beside the track: turned by 0.1 about y and moved by 0.2 along it; joint at 0.9.
    TRACK, ESTIMATE = np.array([0, 0, 0.5]), np.array([0.1, 0.2, 0.9])

    @pytest.fixture
    def run(self, programs):
        def run(estimate=self.ESTIMATE, fits="track", variance=0.0, sure=0.9, **flags):
            """(turn, shift and joint state found, variance, asked, replaced)."""
            lost, due = (flags.pop(name, False) for name in ("lost", "due"))
            num_inconsistent = np.int32(
                flags.pop("num_inconsistent", 3 * flags.pop("doubted", False))
            )
            turned = np.int32(flags.pop("turned", 0))
            trial = flags.pop("trial", 0)
            turn, shift, state = estimate
            tracked = laptop_fix(ROOT, 0.5)
            static = laptop_fix(ROOT @ rigid([0, turn, 0], [0, shift, 0]), state)
            key = tuple(flags.items())
            if key not in programs:

                def update(static, points, tracked, state, due, num_inconsistent, turned):
                    state, settings = SimpleNamespace(**state), TrackerConfig(**flags)
                    rest = due, num_inconsistent, turned, LAPTOP, None, settings
                    known = static, points, None, None, tracked, box_residual(tracked, points)
                    return keyframes.update_keyframe(*known, state, *rest)

                programs[key] = jax.jit(update)
            points = in_camera(INSIDE, tracked if fits == "track" else static)
            state = {"variance": np.float32(variance) * np.ones(3, np.float32), "lost": lost}
            state |= {
                "rotation_votes": np.zeros(24, np.float32),
                "init_frames_left": np.int32(trial),
            }
            static = replace(static, confidence=np.float32(sure))
            said = programs[key](static, points, tracked, state, due, num_inconsistent, turned)
            fix, found = said.measurement, (said.variance, said.estimator_queried, said.replaced)
            assert said.accepted == (
                bool(said.estimator_queried) and (sure >= 0.5 or num_inconsistent >= 5)
            )
            assert said.rotation_votes.any() == (bool(said.accepted) and trial > 0)
            along = np.linalg.inv(tracked.root) @ np.asarray(fix.root, float)
            turned = Rotation.from_matrix(along[:3, :3]).as_rotvec()[1]
            lid = Rotation.from_matrix(fix.parts[1, :3, :3]).as_rotvec()
            # Poses of the parts and joint states stay together.
            np.testing.assert_allclose(lid, [fix.joint_state[0], 0, 0], atol=1e-5)
            return np.array([turned, along[1, 3], fix.joint_state[0]]), *found

        return run

    def test_between_keyframes_the_track_goes_on_unasked(self, run):
        found, variance, asked, replaced = run(variance=0.3)
        np.testing.assert_allclose(found, self.TRACK, atol=1e-6)
        np.testing.assert_allclose(variance, 0.3, rtol=1e-6)
        assert not asked and not replaced

    @pytest.mark.parametrize("variance", [0.0, 0.01, 1.0])
    def test_a_keyframe_weighs_both_by_their_variances(self, run, variance):
        found, after, asked, replaced = run(variance=variance, due=True)
        assert asked and not replaced
        grown = variance + self.DRIFT
        gain = grown / (grown + self.STATIC)
        np.testing.assert_allclose(
            found, self.TRACK + gain * (self.ESTIMATE - self.TRACK), rtol=1e-3, atol=1e-4
        )
        np.testing.assert_allclose(after, gain * self.STATIC, rtol=1e-4)

    def test_on_trial_the_estimator_is_asked_and_averaged(self, run):
        found, _, asked, replaced = run(variance=0.01, trial=5)
        assert asked and not replaced
        np.testing.assert_allclose(found[:2], [0.05, 0.1], atol=1e-3)  # of equal variances

    def test_a_track_without_variance_is_kept(self, run):
        """Doubted, but not by the policy: it did not drift. It fits, so it is not replaced."""
        found, variance, asked, replaced = run(doubted=True)
        np.testing.assert_allclose(found, self.TRACK, atol=1e-6)
        assert asked and not replaced and not variance.any()

    @pytest.mark.parametrize("estimate", [ESTIMATE, np.array([0.3, 0.5, 0.9])])
    def test_unfiltered_the_estimate_is_taken(self, run, estimate):
        found, variance, asked, replaced = run(estimate, due=True, kalman=False)
        np.testing.assert_allclose(found, estimate, atol=1e-5)
        assert asked and not replaced
        np.testing.assert_allclose(variance, self.STATIC, rtol=1e-6)

    @pytest.mark.parametrize("estimate", [(0.3, 0.0, 0.9), (0.0, 0.5, 0.9)])
    def test_poses_that_contradict_each_other_are_not_averaged(self, run, estimate):
        found, variance, asked, replaced = run(estimate, variance=0.1, due=True)
        np.testing.assert_allclose(found, self.TRACK, atol=1e-6)
        np.testing.assert_allclose(variance, 0.1 + self.DRIFT, rtol=1e-5)
        assert asked and not replaced

    @pytest.mark.parametrize("flags", [{"lost": True}, {"doubted": True, "fits": "estimate"}])
    def test_the_estimate_replaces_a_track_that_is_lost_or_doubted_and_worse(self, run, flags):
        estimate = np.array([0.4, 0.5, 0.9])
        found, variance, asked, replaced = run(estimate, variance=0.1, **flags)
        np.testing.assert_allclose(found, estimate, atol=1e-5)
        np.testing.assert_allclose(variance, self.STATIC, rtol=1e-5)
        assert asked and replaced

    def test_an_estimate_that_is_not_sure_changes_nothing_but_a_lost_track(self, run):
        for flags in ({"due": True}, {"doubted": True, "fits": "estimate"}):
            found, _, asked, replaced = run(variance=0.1, sure=0.4, **flags)
            np.testing.assert_allclose(found, self.TRACK, atol=1e-6)
            assert asked and not replaced
        found, *_, replaced = run(sure=0.4, num_inconsistent=4, fits="estimate")
        assert not replaced
        found, *_, replaced = run(sure=0.4, num_inconsistent=5, fits="estimate")
        np.testing.assert_allclose(found, self.ESTIMATE, atol=1e-5)
        assert replaced
        found, _, asked, replaced = run(sure=0.4, lost=True)
        np.testing.assert_allclose(found, self.ESTIMATE, atol=1e-5)
        assert asked and replaced

    def test_a_track_off_by_a_turn_is_turned_unasked(self, run):
        quarter = Rotation.from_euler("y", 90, degrees=True).as_matrix()
        (turn,) = np.flatnonzero(np.isclose(CUBE_ROTATIONS, quarter, atol=1e-6).all((1, 2)))
        found, variance, asked, replaced = run(turned=turn)
        np.testing.assert_allclose(found, [np.pi / 2, 0, self.ESTIMATE[2]], atol=1e-5)
        np.testing.assert_allclose(variance, self.STATIC, rtol=1e-5)
        assert replaced and not asked

    def test_a_tracked_pose_is_promoted_unasked(self, run):
        found, _, asked, replaced = run(variance=0.1, due=True, policy="promote")
        np.testing.assert_allclose(found, self.TRACK, atol=1e-6)
        assert not asked and not replaced


class TestUpdateParameters:
    mean = staticmethod(jax.jit(update_parameters))

    def frames(self, count):
        """ObjectParameters of two joints, as noisy as networks see them."""
        rng = np.random.default_rng(3)
        for _ in range(count):
            axis = np.array([[1, 0, 0], [0, 0, 1]]) + 0.1 * rng.normal(size=(2, 3))
            yield ObjectParameters(
                axis=np.float32(axis / np.linalg.norm(axis, axis=1, keepdims=True)),
                pivot=np.float32(rng.normal(size=(2, 3))),
                size=np.float32(rng.uniform(1, 2, (3, 3))),
                center=np.float32(rng.normal(size=(3, 3))),
                num_frames=np.float32(1),
                known=np.zeros(2, np.float32),
            )

    def test_running_means(self):
        frames = list(self.frames(30))
        # Whatever was there before the first frame does not count.
        found = replace(frames[-1], num_frames=np.float32(0))
        for frame in frames:
            found = self.mean(found, frame)
        assert found.num_frames == 30
        for name in ("pivot", "size", "center"):
            expected = np.mean([getattr(frame, name) for frame in frames], 0)
            np.testing.assert_allclose(getattr(found, name), expected, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(found.axis, axis=1), 1.0, atol=1e-6)
        for axis, votes in zip(
            found.axis, np.sum([frame.axis for frame in frames], 0), strict=True
        ):
            assert angle(axis, unit(votes)) < 0.2

    def test_old_frames_are_forgotten(self):
        """After an hour, what the object looks like now still counts a sixtieth."""
        old, new = self.frames(2)
        found = self.mean(replace(old, num_frames=np.float32(1e5)), new)
        np.testing.assert_allclose(found.size - old.size, (new.size - old.size) / 61, atol=1e-5)

    def test_known_joints_hardly_move(self):
        old, new = self.frames(2)
        found = self.mean(replace(old, known=np.float32([1000.0, 0.0])), new)
        moved = np.linalg.norm(found.pivot - old.pivot, axis=1)
        moved /= np.linalg.norm(new.pivot - old.pivot, axis=1)
        np.testing.assert_allclose(moved, [1 / 1002, 1 / 2], rtol=0.01)
        assert angle(found.axis[0], old.axis[0]) < 0.02 < 1 < angle(found.axis[1], old.axis[1])
        # Sizes are not joints: these move.
        np.testing.assert_allclose(found.size, (old.size + new.size) / 2, atol=1e-6)
