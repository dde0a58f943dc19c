"""URDF import: kinematics as yourdfpy has them, parts, frames and rest poses as documented."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trimesh")
pytest.importorskip("yourdfpy")

import yourdfpy
from _helpers import solid_meshes
from _helpers.solid_meshes import mesh_object, part_mesh
from _helpers.urdf_models import (
    DRAWER_LEVELS,
    DRAWER_SIZE,
    LAPTOP_BASE,
    LAPTOP_LID,
    Robot,
    partnet_drawer,
    partnet_laptop,
    serial_arm,
)

from caper_jax import categories
from caper_jax.categories.drawer import DRAWER
from caper_jax.categories.laptop import LAPTOP
from caper_jax.categories.robotarm import ROBOTARM
from caper_jax.data.urdf import ImportOptions
from caper_jax.data.urdf.canonical import import_model, import_urdf
from caper_jax.data.urdf.load import UrdfModel, read_urdf
from caper_jax.data.urdf.parts import map_parts
from caper_jax.data.urdf.xml import UrdfJoint
from caper_jax.geometry.meshes import join
from caper_jax.synthetic.instances import draw_instances
from caper_jax.synthetic.urdf_export import write_urdf

# Canonical axes -> those of a file with z up and x to the front, as in robotics.
Z_UP = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)
WITH_RULES = (
    "laptop", "box", "stapler", "dishwasher", "drawer", "cutter", "eyeglasses", "scissors",
    "robotarm",
)  # fmt: skip


@pytest.fixture(autouse=True)
def coarse_circles(monkeypatch):
    monkeypatch.setattr(solid_meshes, "SECTIONS", 24)


def fit_rigid(source, target):
    """The transform [4, 4] that takes points [N, 3] to others best (Kabsch)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    sign = np.diag([1, 1, np.linalg.det(u @ vt)])
    pose = np.eye(4)
    pose[:3, :3] = (u @ sign @ vt).T
    pose[:3, 3] = target.mean(0) - pose[:3, :3] @ source.mean(0)
    return pose


@pytest.mark.parametrize(
    ("build", "category", "scale"),
    [(partnet_laptop, LAPTOP, 0.3), (partnet_drawer, DRAWER, 0.5), (serial_arm, ROBOTARM, 1.0)],
)
def test_joint_values_of_the_file_become_states(build, category, scale, tmp_path):
    """By the map of the report, every vertex is where yourdfpy puts it, seen from the root."""
    path = build(tmp_path)
    model = read_urdf(path)
    item = import_model(model, category, ImportOptions(scale=scale))
    report = json.loads(json.dumps(item.report()))
    assert list(report["joints"]) == list(category.parts[1:])
    maps = list(report["joints"].values())
    names = [joint["file_joint"] for joint in maps]
    factor, offset = (np.array([joint[key] for joint in maps]) for key in ("factor", "offset"))
    robot = yourdfpy.URDF.load(str(path), load_meshes=False)
    tree = map_parts(model, category, None, {})
    child = {joint.name: joint.child for joint in model.joints}
    parts = [tree.links[0], *(next(p for p in tree.links if child[n] in p) for n in names)]

    def in_file(values):
        """The parts' vertices [V_k, 3] by yourdfpy."""
        robot.update_cfg({**tree.locked, **dict(zip(names, values, strict=True))})
        places = []
        for links in parts:
            meshes = [(model.links[n], robot.get_transform(n)) for n in links]
            places.append(join([m.moved(pose) for m, pose in meshes if m is not None]).vertices)
        return [scale * vertices for vertices in places]

    ours = [part.vertices for part in item.at_rest.parts]
    at_rest = in_file(-offset / factor)
    to_canonical = fit_rigid(at_rest[0], ours[0])
    for part, vertices in zip(ours, at_rest, strict=True):
        np.testing.assert_allclose(
            vertices @ to_canonical[:3, :3].T + to_canonical[:3, 3], part, atol=1e-9
        )
    rng = np.random.default_rng(1)
    for _ in range(5):
        values = rng.uniform(-1, 1, category.num_joints)
        states = factor * values + offset
        np.testing.assert_allclose(
            [joint.value(state) for joint, state in zip(item.joints, states, strict=True)],
            values,
            atol=1e-12,
        )
        theirs = in_file(values)
        for pose, rest, moved in zip(item.at_rest.poses(states), ours, theirs, strict=True):
            expected = moved @ to_canonical[:3, :3].T + to_canonical[:3, 3]
            np.testing.assert_allclose(rest @ pose[:3, :3].T + pose[:3, 3], expected, atol=1e-9)


def test_the_report_has_limits_in_the_file_and_here(tmp_path):
    """A laptop that opens by negative values, with a wider range than the category's."""
    item = import_urdf(partnet_laptop(tmp_path / "101"), LAPTOP)
    (joint,) = item.report()["joints"].values()
    assert (joint["file_joint"], joint["unit"], joint["clipped"]) == ("joint_0", "rad", True)
    assert joint["factor"] == -1.0
    np.testing.assert_allclose(np.degrees(joint["offset"]), 20, atol=1e-6)
    np.testing.assert_allclose(np.degrees(joint["file_limits"]), [-40, 110], atol=1e-6)
    np.testing.assert_allclose(np.degrees(joint["state_limits"]), [-90, 60], atol=1e-6)
    np.testing.assert_allclose(np.degrees(joint["state_range"]), [-70, 60], atol=1e-6)
    arm = import_urdf(serial_arm(tmp_path / "arm"), ROBOTARM).report()["joints"]["link 4"]
    assert arm["file_limits"] == [None, None] and arm["clipped"]


def test_partnet_laptop_by_hand(tmp_path):
    """Modeled 110 deg open, closing is positive in the file; the rest pose is at +20 deg."""
    item = import_urdf(partnet_laptop(tmp_path / "101"), LAPTOP)
    assert item.name == "101"
    width, thick, depth = LAPTOP_BASE
    _, height, lid = LAPTOP_LID
    np.testing.assert_allclose(item.size, [LAPTOP_BASE, LAPTOP_LID], atol=1e-6)
    # The hinge is at the top back edge of the base, the lid stands behind it, centered at -lid / 2.
    low = np.array([-width / 2, -thick / 2, -depth / 2 - lid])
    high = np.array([width / 2, thick / 2 + height, depth / 2])
    middle = (low + high) / 2
    base, upright = -middle, np.array([0, thick / 2 + height / 2, -depth / 2 - lid / 2]) - middle
    np.testing.assert_allclose(item.box_center, [base, upright], atol=1e-6)
    np.testing.assert_allclose(item.at_rest.axis, [[-1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(np.degrees(item.at_rest.limits), [[-90, 60]], atol=1e-6)
    # Within the category's own range.
    np.testing.assert_allclose(np.degrees(item.states), [[-70, 60]], atol=1e-6)
    assert any("link_0 (screen)" in note for note in item.notes)


def test_partnet_drawer_by_hand(tmp_path):
    """Drawers from the bottom up, sliding to +z; door and knob locked and told of."""
    item = import_urdf(partnet_drawer(tmp_path / "7"), DRAWER)
    assert [joint.file_joint for joint in item.joints] == ["joint_1", "joint_2", "joint_0"]
    np.testing.assert_allclose(item.at_rest.axis, np.tile([0, 0, 1], (3, 1)), atol=1e-9)
    np.testing.assert_allclose(item.size[1:3], np.tile(DRAWER_SIZE, (2, 1)), atol=1e-6)
    assert (np.diff(item.box_center[1:, 1]) > 0).all()
    np.testing.assert_allclose(
        np.diff(item.box_center[1:3, 1]), DRAWER_LEVELS[1:2] - np.array([DRAWER_LEVELS[0]])
    )
    np.testing.assert_allclose(item.states, [[0, 0.36]] * 3)
    assert "locked: joint_4 (revolute) at 0" in item.notes
    assert "locked: joint_5 (prismatic) at 0" in item.notes


def test_links_that_mimic_a_joint_are_at_its_rest(tmp_path):
    """A flap in the lid of a laptop modeled shut: upright when shut, flat at rest, 90 deg open."""
    robot = Robot(tmp_path).link("base", ((0.12, 0, -0.01), (0.24, 0.34, 0.02)))
    robot.link("lid", ((0.12, 0, 0.005), (0.24, 0.34, 0.01)))
    robot.link("flap", ((0, 0, 0), (0.02, 0.02, 0.06)))
    robot.joint("hinge", "revolute", "base", "lid", axis=(0, 1, 0), limits=(-2.4, 0.0))
    robot.joint(
        "flap_hinge", "revolute", "lid", "flap", xyz=(0.1, 0, 0.005), axis=(0, 1, 0),
        limits=(-2.0, 2.0), extra='<mimic joint="hinge" multiplier="-1"/>',
    )  # fmt: skip
    item = import_urdf(robot.write(), LAPTOP)
    np.testing.assert_allclose(item.size[1], [0.34, 0.24, 0.02], atol=1e-9)
    assert "locked: flap_hinge (mimics hinge)" in item.notes


def test_arm_merges_wrist_and_fingers(tmp_path):
    model = read_urdf(serial_arm(tmp_path))
    tree = map_parts(model, ROBOTARM)
    assert tree.links[0] == ("world", "link0")
    assert tree.links[6] == ("link6", "link7", "flange", "finger1", "finger2")
    # The limit nearest to 0 is where a joint is held that may not stand at 0.
    assert tree.locked == {"joint7": 0.0, "finger1_joint": 0.01}
    assert "locked: finger2_joint (mimics finger1_joint)" in tree.notes


def as_urdf(model, category, turn, state):
    """A generated object as a URDF would hold it: axes turned, modeled at a state."""
    pose = np.eye(4)
    pose[:3, :3] = turn
    there = mesh_object(model, category).at(state).moved(pose)
    # A link's frame sits on its joint, as in most files.
    places = np.concatenate([np.zeros((1, 3)), there.pivot])
    links = {}
    for k, (part, place) in enumerate(zip(there.parts, places, strict=True)):
        links[f"l{k}"] = part.moved(_shift(-place))
    joints = tuple(
        UrdfJoint(
            f"j{j}",
            kind,
            f"l{parent}",
            f"l{j + 1}",
            _shift(places[j + 1] - places[parent]),
            there.axis[j],
            tuple(there.limits[j]),
        )
        for j, (kind, parent) in enumerate(zip(there.kinds, there.parents, strict=True))
    )
    return UrdfModel("it", Path("it.urdf"), links, joints, "l0")


def _shift(offset):
    pose = np.eye(4)
    pose[:3, 3] = offset
    return pose


@pytest.mark.parametrize("name", WITH_RULES)
def test_frames_and_rest_poses_are_found(name):
    """Generated shapes come back in their own frame from files with other axes and states."""
    category = categories.get(name)
    for index, model in enumerate(draw_instances(category, 4, "test", 11)):
        shut = model.limits[:, 0]
        states = [0 * shut] if name == "robotarm" else [0 * shut, shut, model.limits[:, 1]]
        for turn in (np.eye(3), Z_UP):
            for state in states:
                urdf = as_urdf(model, category, turn, state)
                item = import_model(urdf, category, ImportOptions())
                np.testing.assert_allclose(item.at_rest.axis, model.axis, atol=1e-6)
                # At the file's own rest exactly; else within what shapes say of an angle.
                loose = 0.0 if not state.any() else 3.5
                limits = model.limits
                if "prismatic" in category.joint_types:
                    np.testing.assert_allclose(item.at_rest.limits, limits, atol=1e-9)
                else:
                    off = np.degrees(np.abs(item.at_rest.limits - limits).max())
                    assert off <= loose + 1e-6, (index, off)
                if not state.any():
                    np.testing.assert_allclose(item.at_rest.pivot, _centered(model), atol=1e-6)


def test_up_is_where_drawers_follow_one_another():
    """Cabinets with y up and the front to x, against the convention of z up."""
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float)
    for model in draw_instances(DRAWER, 3, "test", 11):
        item = import_model(as_urdf(model, DRAWER, turn, np.zeros(3)), DRAWER, ImportOptions())
        np.testing.assert_allclose(item.at_rest.axis, model.axis, atol=1e-6)
        np.testing.assert_allclose(item.at_rest.pivot, _centered(model), atol=0.002)
        assert any("y = +y" in note and "up detected" in note for note in item.notes)


def test_up_is_assumed_where_drawers_stand_side_by_side(tmp_path):
    robot = Robot(tmp_path).link("body", ((0, 0, 0), (0.5, 1.9, 0.35)))
    for index, y in enumerate((-0.62, 0.0, 0.62)):
        robot.link(f"drawer{index}", ((0.06, y, 0), (0.4, 0.6, 0.3)))
        robot.joint(f"joint{index}", "prismatic", "body", f"drawer{index}", limits=(0.0, 0.3))
    item = import_urdf(robot.write(), DRAWER)
    assert any("y = +z" in note and "(up assumed and front" in note for note in item.notes)


def _centered(model):
    """Pivots from the center of the meshes' box (24-sided cylinders are a little smaller)."""
    meshes = [part_mesh(solids) for solids in model.parts]
    low = np.min([mesh.bounds[0] for mesh in meshes], axis=0)
    high = np.max([mesh.bounds[1] for mesh in meshes], axis=0)
    return model.pivot - (low + high) / 2


@pytest.mark.parametrize("name", WITH_RULES)
def test_exported_objects_come_back(name, tmp_path):
    """Exported and imported: the same frame, joints and sizes."""
    category = categories.get(name)
    (model,) = draw_instances(category, 1, "test", 12)
    item = import_urdf(write_urdf(tmp_path, model, category, name, sections=16), category)
    np.testing.assert_allclose(item.at_rest.axis, model.axis, atol=1e-5)
    np.testing.assert_allclose(item.at_rest.limits, model.limits, atol=1e-5)
    boxes = np.array([part_mesh(solids).bounds for solids in model.parts])
    middle = (boxes[:, 0].min(0) + boxes[:, 1].max(0)) / 2
    np.testing.assert_allclose(item.at_rest.pivot, model.pivot - middle, atol=1e-5)
    np.testing.assert_allclose(item.size, np.ptp(boxes, axis=1), atol=1e-5)
    np.testing.assert_allclose(item.box_center, boxes.mean(1) - middle, atol=1e-5)
