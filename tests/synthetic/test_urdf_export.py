"""URDF export: kinematics as yourdfpy reads them, meshes closed and as large as the solids."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")
pytest.importorskip("yourdfpy")

import trimesh
import yourdfpy
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.kinematics import forward_kinematics
from caper_jax.errors import CaperError
from caper_jax.geometry.solids import bounds, box, cone, cylinder, ellipsoid, frustum
from caper_jax.synthetic.instances import draw_instances
from caper_jax.synthetic.urdf_export import part_mesh, write_urdf

NAMES = ("laptop", "drawer", "robotarm")


@pytest.fixture(scope="module", params=NAMES)
def exported(request, tmp_path_factory):
    """(category, centered model, path of its URDF)."""
    category = categories.get(request.param)
    (model,) = draw_instances(category, 1, "test", 2)
    folder = tmp_path_factory.mktemp(request.param) / "new" / "0"
    return category, model, write_urdf(folder, model, category, "thing", sections=32)


def link_names(robot):
    """Links from the base on, in the order of the file."""
    return list(robot.link_map)


def test_links_move_as_the_parts_do(exported):
    category, model, path = exported
    robot = yourdfpy.URDF.load(str(path), load_meshes=False)
    pivots = np.concatenate([np.zeros((1, 3)), model.pivot])
    names = link_names(robot)
    assert len(names) == category.num_parts and robot.base_link == names[0]
    tree = (category.joint_types, category.parents)
    place = jax.jit(lambda s: forward_kinematics(np.eye(4), model.axis, model.pivot, s, *tree))
    rng = np.random.default_rng(0)
    for _ in range(5):
        state = rng.uniform(model.limits[:, 0], model.limits[:, 1])
        robot.update_cfg(
            {f"{name}_joint": value for name, value in zip(names[1:], state, strict=True)}
        )
        for name, pivot, pose in zip(names, pivots, np.asarray(place(state)), strict=True):
            link = np.array(robot.get_transform(name))
            link[:3, 3] -= link[:3, :3] @ pivot  # the part's own frame: canonical at rest
            np.testing.assert_allclose(link, pose, atol=1e-6)


def test_joints_are_those_of_the_model(exported):
    category, model, path = exported
    robot = yourdfpy.URDF.load(str(path), load_meshes=False)
    for name, joint, axis, limits in zip(
        link_names(robot)[1:], category.joints, model.axis, model.limits, strict=True
    ):
        written = robot.joint_map[f"{name}_joint"]
        assert written.type == joint.type and written.child == name
        assert written.parent == link_names(robot)[joint.parent]
        np.testing.assert_allclose(written.axis, axis, atol=1e-9)
        np.testing.assert_allclose([written.limit.lower, written.limit.upper], limits, atol=1e-9)


def test_meshes_lie_in_the_canonical_frame_and_are_closed(exported):
    """Read back by trimesh: watertight; placed by yourdfpy at rest: where the solids are."""
    _, model, path = exported
    robot = yourdfpy.URDF.load(str(path), load_meshes=True)
    assert len(robot.scene.geometry) == len(model.parts)
    for name, solids in zip(link_names(robot), model.parts, strict=True):
        (visual,) = robot.link_map[name].visuals
        mesh = trimesh.load(path.parent / visual.geometry.mesh.filename, process=False)
        assert mesh.is_watertight and mesh.volume > 0
        place = np.array(robot.get_transform(name)) @ visual.origin
        np.testing.assert_allclose(place, np.eye(4), atol=1e-9)
        plain = [dataclasses.replace(solid, hole=None) for solid in solids]
        np.testing.assert_allclose(part_mesh(plain, 32).bounds, bounds(solids), atol=1e-6)
        low, high = bounds(solids)
        assert (mesh.bounds[0] > low - 1e-6).all() and (mesh.bounds[1] < high + 1e-6).all()


@pytest.mark.parametrize("kind", ["box", "cylinder", "ellipsoid", "frustum", "cone"])
def test_mesh_of_each_kind(kind):
    """Bounds of turned solids, and volumes: of the whole, and less that of a hole within."""
    turn = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()
    half = np.array([0.2, 0.1, 0.3])
    hole = box((0.01, 0.02, -0.01), (0.03, 0.02, 0.04), turn.T)
    make, whole = {
        "box": (box, 8),
        "cylinder": (cylinder, 2 * np.pi),
        "ellipsoid": (ellipsoid, 4 / 3 * np.pi),
        "frustum": (lambda *a, **k: frustum(*a, (0.5, 0.25), **k), 4),
        "cone": (lambda *a, **k: cone(*a, 0.5, **k), 2 * np.pi * 7 / 12),
    }[kind]
    solid = make((0.1, 0.2, 0.3), half, rotation=turn)
    mesh = part_mesh([solid], sections=256)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, solid.extent(), atol=1e-9)
    volume = whole * half.prod()
    assert mesh.volume == pytest.approx(volume, rel=0 if kind in ("box", "frustum") else 1e-3)
    cut = part_mesh([dataclasses.replace(solid, hole=hole.moved(solid.center))], sections=256)
    assert cut.is_watertight
    assert mesh.volume - cut.volume == pytest.approx(8 * hole.half.prod(), rel=1e-6)


def test_united_or_side_by_side():
    pair = [box((0, 0, 0), (1, 1, 1)), box((1, 0, 0), (1, 1, 1))]
    apart, united = part_mesh(pair), part_mesh(pair, united=True)
    assert apart.volume == pytest.approx(16) and united.volume == pytest.approx(12)
    assert apart.body_count == 2 and united.body_count == 1


def test_an_object_is_not_overwritten_by_accident(tmp_path):
    category = categories.get("laptop")
    first, second = draw_instances(category, 2, "test", 0)
    path = write_urdf(tmp_path, first, category, "first", sections=8)
    before = path.read_bytes()
    with pytest.raises(CaperError, match="exists"):
        write_urdf(tmp_path, second, category, "second", sections=8)
    assert path.read_bytes() == before
    write_urdf(tmp_path, second, category, "second", sections=8, overwrite=True)
    assert b'name="second"' in path.read_bytes()


def test_a_model_of_another_category_is_refused(tmp_path):
    (model,) = draw_instances(categories.get("laptop"), 1, "test", 0)
    with pytest.raises(CaperError, match="robotarm"):
        write_urdf(tmp_path, model, categories.get("robotarm"), "thing")
    assert not list(tmp_path.iterdir())


def test_a_part_cut_away_whole_is_refused():
    with pytest.raises(CaperError, match="no mesh"):
        part_mesh([box((0, 0, 0), (1, 1, 1), hole=box((0, 0, 0), (2, 2, 2)))])
