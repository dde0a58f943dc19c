"""Robot arms: published kinematics, conventions, real sizes, mechanics and variety."""

from __future__ import annotations

import numpy as np
import pytest
from _helpers.shapes import boxes
from _helpers.solid_points import deepest_overlap
from scipy.spatial.transform import Rotation

from caper_jax.categories.robotarm import _FAMILIES, ROBOTARM, chains
from caper_jax.geometry.solids import bounds
from caper_jax.synthetic.instances import draw_instances

HALF = np.pi / 2
# Published Denavit-Hartenberg tables: (theta at zero, d, a, alpha), meters. Then the sign of each
# joint's published angle in the category's convention, and the columns of the category's frame
# (x, y, z) in the published base frame.
STANDARD = {
    "UR5e": (
        (chains.offset_cobot, 1),
        [
            (0, 0.1625, 0, HALF),
            (0, 0, -0.425, 0),
            (0, 0, -0.3922, 0),
            (0, 0.1333, 0, HALF),
            (0, 0.0997, 0, -HALF),
            (0, 0.0996, 0, 0),
        ],
        (1, 1, 1, 1, -1, 1),
        ((0, -1, 0), (0, 0, 1), (-1, 0, 0)),
    ),
    "IRB 120": (
        (chains.industrial, 0),
        [
            (0, 0.29, 0, -HALF),
            (-HALF, 0, 0.27, 0),
            (0, 0, 0.07, -HALF),
            (0, 0.302, 0, HALF),
            (0, 0, 0, -HALF),
            (0, 0.072, 0, 0),
        ],
        (1, 1, 1, 1, 1, 1),
        ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    ),
    "M1013": (
        (chains.upright_offset, 0),
        [
            (0, 0.1525, 0, -HALF),
            (-HALF, 0.0345, 0.62, 0),
            (HALF, 0, 0, HALF),
            (0, 0.559, 0, -HALF),
            (0, 0, 0, HALF),
            (0, 0.121, 0, 0),
        ],
        (1, 1, 1, 1, 1, 1),
        ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    ),
}


class Settled:
    """In the place of a numpy generator: ranges give their middle, choices what was asked for."""

    def __init__(self, row: int, chance: float = 0.0) -> None:
        self.row, self.chance = row, chance

    def uniform(self, low, high, size=None):
        middle = (np.asarray(low) + high) / 2
        return middle if size is None else np.full(size, middle)

    def integers(self, high):
        return self.row

    def random(self):
        return self.chance


def screw(axis, angle, shift):
    """[4, 4] turn about a coordinate axis and shift along it."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    pose["xyz".index(axis), 3] = shift
    return pose


def link_poses(axes, pivots, states):
    """Pose [4, 4] of every link, by SciPy, one joint after the other."""
    poses = [np.eye(4)]
    for axis, pivot, state in zip(axes, pivots, states, strict=True):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(np.asarray(axis) * state).as_matrix()
        motion[:3, 3] = pivot - motion[:3, :3] @ pivot
        poses.append(poses[-1] @ motion)
    return poses


def skeleton(chain):
    axes = np.array([np.eye(3)["xyz".index(axis)] for axis in chain.axes])
    return axes, np.array([path[0] for path in chain.paths[1:]])


@pytest.fixture(scope="module")
def arms():
    return draw_instances(ROBOTARM, 200, "train", 5)


@pytest.mark.parametrize("name", STANDARD)
def test_flanges_go_where_published_kinematics_puts_them(name):
    (family, row), table, signs, frame = STANDARD[name]
    chain = family(Settled(row))
    axes, pivots = skeleton(chain)
    to_base = np.array(frame).T
    flange = chain.paths[-1][-1]
    rng = np.random.default_rng(0)
    offsets = []
    for states in (np.zeros(6), *rng.uniform(-2, 2, (5, 6))):
        published = np.eye(4)
        for (zero, d, a, alpha), angle in zip(table, np.array(signs) * states, strict=True):
            published = published @ screw("z", zero + angle, d) @ screw("x", alpha, a)
        last = link_poses(axes, pivots, states)[-1]
        ours = to_base @ (last[:3, :3] @ flange + last[:3, 3])
        np.testing.assert_allclose(to_base @ last[:3, :3] @ chain.tip, published[:3, 2], atol=1e-12)
        offsets.append(ours - published[:3, 3])
    # The rows of the families are rounded to millimeters, the side of the M1013's forearm to 5 mm.
    assert np.linalg.norm(offsets, axis=1).max() < (0.006 if name == "M1013" else 0.002)


@pytest.mark.parametrize("chance", [0.0, 1.0])
def test_the_panda_is_the_published_one(chance):
    """Modified DH: alpha and a of the link before, then d; seven joints, one of them fixed."""
    before = [(0, 0), (-HALF, 0), (HALF, 0), (HALF, 0.0825), (-HALF, -0.0825), (HALF, 0)]
    before += [(HALF, 0.088)]
    along = [0.333, 0, 0.316, 0, 0.384, 0, 0]
    moving = [0, 1, 2, 3, 4, 5] if chance == 0.0 else [0, 1, 3, 4, 5, 6]
    signs = np.array([1, 1, 1, -1, 1, -1, -1])[moving]
    chain = chains.panda(Settled(0, chance))
    axes, pivots = skeleton(chain)
    to_base = np.array([(0, 1, 0), (0, 0, 1), (1, 0, 0)]).T
    for states in (np.zeros(6), *np.random.default_rng(1).uniform(-2, 2, (5, 6))):
        angles = np.zeros(7)
        angles[moving] = signs * states
        pose = np.eye(4)
        for (alpha, a), d, angle in zip(before, along, angles, strict=True):
            pose = pose @ screw("x", alpha, a) @ screw("z", angle, d)
        published = pose @ [0, 0, 0.107, 1]
        last = link_poses(axes, pivots, states)[-1]
        ours = to_base @ (last[:3, :3] @ chain.paths[-1][-1] + last[:3, 3])
        np.testing.assert_allclose(ours, published[:3], atol=1e-9)
        np.testing.assert_allclose(to_base @ last[:3, :3] @ chain.tip, pose[:3, 2], atol=1e-9)


def test_rest_frames_and_signs(arms):
    """y up from the base, z forward; axes along positive canonical ones; the first is vertical."""
    for model in arms:
        np.testing.assert_array_equal(np.sort(model.axis, axis=1), [[0, 0, 1]] * 6)
        np.testing.assert_array_equal(model.axis[:2], [[0, 1, 0], [1, 0, 0]])
        low, high = boxes(model).transpose(1, 0, 2)
        column = model.pivot[0]
        assert low[0, 1] <= low[:, 1].min() + 0.06  # nothing reaches far below the foot
        assert low[0, 1] < column[1] < high[0, 1] + 1e-9
        assert (low[6] + high[6])[2] / 2 > column[2] - 1e-6  # the tip is in front, or above
        # The foot tells the front from the back: connectors behind it, or a plate set back.
        reach = np.array([solid.extent() for solid in model.parts[0]])[:, :, 2] - column[2]
        assert any(-back > front + 0.005 for back, front in reach)


def test_joints_sit_where_their_links_meet(arms):
    for model in arms[:60]:
        low, high = boxes(model).transpose(1, 0, 2)
        for j, pivot in enumerate(model.pivot):
            for part in (j, j + 1):
                assert np.maximum(low[part] - pivot, pivot - high[part]).max() < 0.005


def test_sizes_are_those_of_real_arms(arms):
    reach, thick = [], []
    for model in arms:
        reach.append(np.linalg.norm(np.diff(model.pivot, axis=0), axis=1).sum())
        thick.append(np.ptp(boxes(model)[2], axis=0).min())  # of the upper arm, at its joints
    assert 0.35 < min(reach) < 0.7 and 1.1 < max(reach) < 2.4
    assert min(thick) > 0.03 and max(thick) < 0.35


def test_most_poses_clear_the_floor_and_the_arm_itself(arms):
    rng = np.random.default_rng(3)
    sunk, struck = [], []
    for model in arms:
        states = rng.uniform(*model.limits.T)
        poses = link_poses(model.axis, model.pivot, states)
        floor = bounds(model.parts[0])[0][1]
        lowest = min(
            (solid.corners() @ poses[k][1, :3] + poses[k][1, 3]).min()
            for k in range(2, 7)
            for solid in model.parts[k]
        )
        sunk.append(lowest < floor - 0.05)
        # Links that no joint joins: the hand against column, shoulder, upper arm and forearm.
        deep = [
            deepest_overlap(rng, model.parts[6], model.parts[k], np.linalg.inv(poses[k]) @ poses[6])
            for k in (0, 1, 2, 3)
        ]
        struck.append(max(deep) > 0.02)
    assert np.mean(sunk) < 0.08
    assert np.mean(struck) < 0.12


def test_links_do_not_overlap_at_rest_but_at_their_joints(arms):
    rng = np.random.default_rng(4)
    for model in arms[:60]:
        for k in range(5):
            for other in range(k + 3, 7):
                depth = deepest_overlap(rng, model.parts[other], model.parts[k], np.eye(4))
                assert depth < 0.03


def test_all_kinds_occur(arms):
    axes = {"".join("xyz"[i] for i in model.axis.argmax(1)) for model in arms}
    assert axes == {"yxxxyx", "yxyxyx", "yxxyxy", "yxxzxz"}
    kinds = [{solid.kind for part in model.parts for solid in part} for model in arms]
    for kind in ("box", "cylinder", "cone", "ellipsoid", "frustum"):
        assert any(kind in own for own in kinds)
    # Two fingers and a palm, a suction cup, a bare flange.
    hands = {tuple(solid.kind for solid in model.parts[6])[-3:] for model in arms}
    assert any(hand == ("box", "box", "box") for hand in hands)
    assert any(hand[-1] == "cone" for hand in hands)
    assert any(hand[-1] == "cylinder" for hand in hands)
    # Stretched out, upright, or bent at rest.
    shapes = [np.ptp(boxes(model)[1:], axis=(0, 1)) for model in arms]
    slender = [size[1] / size[2] for size in shapes]
    assert min(slender) < 0.6 and max(slender) > 4.0


def test_limits_of_the_category_are_those_of_its_families(arms):
    drawn = [family(Settled(0, chance)) for family in _FAMILIES for chance in (0.0, 1.0)]
    limits = np.array([chain.limits for chain in drawn])
    expected = np.stack([limits[:, :, 0].min(0), limits[:, :, 1].max(0)], axis=1)
    np.testing.assert_allclose(np.degrees([joint.limits for joint in ROBOTARM.joints]), expected)
    widths = np.array([np.ptp(model.limits, axis=1) for model in arms])
    assert len(np.unique(widths.round(6), axis=0)) == len(arms)
    assert np.degrees(widths.min()) > 60
