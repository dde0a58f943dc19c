"""URDF import: what is read, how links become parts, and what errors say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from _helpers.urdf_models import Robot, partnet_drawer, partnet_laptop, serial_arm

from caper_jax.articulation.urdf_rule import UrdfRule
from caper_jax.categories.drawer import DRAWER
from caper_jax.categories.eyeglasses import EYEGLASSES
from caper_jax.categories.laptop import LAPTOP
from caper_jax.categories.robotarm import ROBOTARM
from caper_jax.data.urdf import ImportOptions
from caper_jax.data.urdf.canonical import import_model, import_urdf
from caper_jax.data.urdf.load import find_models, read_urdf
from caper_jax.data.urdf.parts import map_parts
from caper_jax.errors import CaperError

PLATE, LID = ((0, 0, 0), (0.3, 0.2, 0.02)), ((0, 0, 0.1), (0.3, 0.02, 0.2))


def two_part(folder, root="body", child="lid"):
    """A plate and an upright lid on a hinge along x, in a file with z up and -y to the front."""
    robot = Robot(folder).link(root, PLATE).link(child, LID)
    robot.joint("hinge", "revolute", root, child, xyz=(0, 0.1, 0.01), limits=(-1.5, 1.0))
    return robot


# Reading


def test_meshes_are_found_scaled_and_placed(tmp_path):
    """package:// in the folders above with and without its name, STL, shapes, scale and origin."""
    folder = tmp_path / "our_robot" / "urdf"
    robot = Robot(folder)
    robot.link("a", ((0, 0, 0), (1, 2, 3)), origin="0 0 1", prefix="package://our_robot/urdf/")
    robot.link("b", ((0, 0, 0), (1, 1, 1)), prefix="package://elsewhere/urdf/", suffix=".stl")
    robot.joint("j", "fixed", "a", "b")
    text = robot.write().read_text()
    shapes = (
        '<visual><geometry><box size="1 2 4"/></geometry></visual>'
        '<visual><origin xyz="5 0 0"/><geometry><cylinder radius="1" length="3"/>'
        "</geometry></visual>"
        '<visual><origin xyz="9 0 0"/><geometry><sphere radius="2"/></geometry></visual>'
    )
    text = text.replace("</robot>", f'<link name="c">{shapes}</link></robot>')
    text = text.replace(
        "</robot>",
        '<joint name="k" type="fixed"><parent link="a"/><child link="c"/></joint></robot>',
    )
    (folder / "thing.urdf").write_text(text.replace('.stl"', '.stl" scale="2 1 0.5"'))
    links = read_urdf(folder / "thing.urdf").links
    np.testing.assert_allclose(links["a"].bounds(), [[-0.5, -1, -0.5], [0.5, 1, 2.5]])
    np.testing.assert_allclose(links["b"].bounds(), [[-1, -0.5, -0.25], [1, 0.5, 0.25]])
    np.testing.assert_allclose(links["c"].bounds(), [[-0.5, -2, -2], [11, 2, 2]], atol=2e-3)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".dae", ".glb", ".ply", ".off"])
def test_every_format_of_meshes(suffix, tmp_path):
    Robot(tmp_path).link("a", ((1, 2, 3), (0.1, 0.2, 0.3)), suffix=suffix).write()
    mesh = read_urdf(tmp_path / "thing.urdf").links["a"]
    expected = [[0.95, 1.9, 2.85], [1.05, 2.1, 3.15]]
    np.testing.assert_allclose(mesh.bounds(), expected, rtol=1e-6)
    assert mesh.moments()[0] == pytest.approx(2 * (0.02 + 0.03 + 0.06), rel=1e-5)


def test_collada_unit_is_applied(tmp_path):
    pytest.importorskip("collada")
    Robot(tmp_path).link("a", ((0, 0, 0), (10, 20, 30)), suffix=".dae").write()
    file = tmp_path / "meshes" / "a_0.dae"
    text = file.read_text()
    assert "<unit" not in text
    unit = '</created><unit name="centimeter" meter="0.01"/>'
    file.write_text(text.replace("</created>", unit))
    mesh = read_urdf(tmp_path / "thing.urdf").links["a"]
    np.testing.assert_allclose(np.ptp(mesh.bounds(), axis=0), [0.1, 0.2, 0.3], rtol=1e-6)


def test_moments_of_a_box_are_exact(tmp_path):
    """Against the integral over the six faces of a 2 x 4 x 6 box, worked out by hand."""
    Robot(tmp_path).link("a", ((1, 0, 0), (2, 4, 6))).write()
    area, mean, second = read_urdf(tmp_path / "thing.urdf").links["a"].moments()
    faces = {"x": 2 * 24, "y": 2 * 12, "z": 2 * 8}
    assert area == pytest.approx(sum(faces.values()))
    np.testing.assert_allclose(mean, [1, 0, 0], atol=1e-12)
    # x^2 is 1 on the faces across x and 1/3 on average over the others, and so on.
    squares = [
        (faces["x"] + (faces["y"] + faces["z"]) / 3) / area,
        4 * (faces["y"] + (faces["x"] + faces["z"]) / 3) / area,
        9 * (faces["z"] + (faces["x"] + faces["y"]) / 3) / area,
    ]
    np.testing.assert_allclose(second, np.diag(squares), atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<robot name='r'>", "broken XML"),
        ("<sdf/>", "outermost element is <sdf>"),
        ("<robot name='r'/>", "describes no link"),
        ("<robot name='r'><link name='a'/></robot>", "no link has a geometry"),
        ("<robot name='r'><link name='a'/><link name='b'/></robot>", "no single tree"),
    ],
)
def test_broken_files_are_explained(content, message, tmp_path):
    path = tmp_path / "bad.urdf"
    path.write_text(content)
    with pytest.raises(CaperError, match=message):
        read_urdf(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("meshes/lid_0.obj", "meshes/gone.obj", "lid.*gone.obj' is not there"),
        ("meshes/lid_0.obj", "http://x/y.obj", "only files and package://"),
        ("meshes/lid_0.obj", "thing.urdf", "meshes are read from .obj"),
        ('child link="lid"', 'child link="lod"', "no link is called 'lod'"),
        ('axis xyz="1.0', 'axis xyz="0.0', "is no direction"),
        ('lower="-1.5"', 'lower="1.5"', "are no range"),
        ('lower="-1.5"', 'lower="low"', "lower limit must be a finite number, got 'low'"),
    ],
)
def test_broken_content_is_explained(old, new, message, tmp_path):
    path = two_part(tmp_path).write()
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(CaperError, match=message):
        read_urdf(path)


def test_what_is_not_geometry_is_left_unread(tmp_path):
    """Transmissions and the like are often incomplete; a hinge without limits turns for ever."""
    path = two_part(tmp_path).write()
    text = path.read_text().replace('type="revolute"', 'type="continuous"')
    text = text.replace("</robot>", "<transmission><joint/></transmission></robot>")
    path.write_text(text.replace('<robot name="thing">', "<robot>"))
    model = read_urdf(path)
    assert model.joints[0].limits == (-np.inf, np.inf)
    item = import_model(model, LAPTOP, ImportOptions())
    np.testing.assert_allclose(item.states, [LAPTOP.joints[0].limits])


def test_corrupted_mesh_is_named(tmp_path):
    path = two_part(tmp_path).write()
    (tmp_path / "meshes" / "lid_0.obj").write_text("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(CaperError, match=r"lid_0.obj"):
        read_urdf(path)


def test_models_of_a_folder(tmp_path):
    laptop, drawer = partnet_laptop(tmp_path / "set" / "2"), partnet_drawer(tmp_path / "set" / "1")
    (tmp_path / "set" / "notes").mkdir()
    assert find_models(tmp_path / "set") == [drawer, laptop]
    assert find_models(tmp_path / "set" / "2") == find_models(laptop) == [laptop]
    with pytest.raises(CaperError, match="no such file or folder"):
        find_models(tmp_path / "none")
    with pytest.raises(CaperError, match=r"holds no .urdf file"):
        find_models(tmp_path / "set" / "notes")
    for name in ("a.urdf", "b.urdf"):
        (tmp_path / "set" / "notes" / name).touch()
    with pytest.raises(CaperError, match="holds 2 URDF files"):
        find_models(tmp_path / "set" / "notes")


# Parts


def test_root_is_the_named_link_and_the_joint_turns_round(tmp_path):
    """The same object with either part as the file's root."""
    plain = import_urdf(two_part(tmp_path / "a").write(), LAPTOP)
    # The plate hangs on the lid here; the lid's frame is the hinge's.
    robot = Robot(tmp_path / "b").link("screen", LID).link("plate", ((0, -0.1, -0.01), PLATE[1]))
    robot.joint("hinge", "revolute", "screen", "plate", limits=(-1.0, 1.5))
    for options in (ImportOptions(), ImportOptions(parts=("plate", "screen"))):
        turned = import_urdf(robot.write(), LAPTOP, options)
        for field in ("axis", "pivot", "limits"):
            np.testing.assert_allclose(
                getattr(turned.at_rest, field), getattr(plain.at_rest, field), atol=1e-9
            )
        np.testing.assert_allclose(turned.size, plain.size, atol=1e-9)
        np.testing.assert_allclose(turned.box_center, plain.box_center, atol=1e-9)


def test_empty_root_and_small_pieces(tmp_path):
    """Both parts hinged to an empty link: the larger is the root; a button is merged."""
    robot = (
        Robot(tmp_path)
        .link("base")
        .link("plate", PLATE)
        .link("lid", ((0, 0, 0.08), (0.2, 0.02, 0.16)))
    )
    robot.link("button", ((0, 0, 0), (0.01, 0.01, 0.01)))
    robot.joint("j0", "revolute", "base", "plate", axis=(0, 0, 1), limits=(-1, 1))
    robot.joint("j1", "revolute", "base", "lid", xyz=(0, 0.1, 0.01), limits=(-1.5, 1.0))
    robot.joint("j2", "revolute", "plate", "button", xyz=(0.1, 0, 0.01), limits=(0, 0.3))
    tree = map_parts(read_urdf(robot.write()), LAPTOP)
    assert [set(links) for links in tree.links] == [{"base", "plate", "button"}, {"lid"}]
    assert tree.joints[0].joint.name == "j1"
    assert tree.locked == {"j0": 0.0, "j2": 0.0}


def test_joints_with_nothing_between_them(tmp_path):
    """A slide and a turn in a row, as of PartNet-Mobility's screws: the wanted type stays."""
    robot = Robot(tmp_path).link("body", PLATE).link("helper").link("lid", LID)
    robot.joint("slide", "prismatic", "body", "helper", limits=(0, 0.1))
    robot.joint("turn", "revolute", "helper", "lid", xyz=(0, 0.1, 0.01), limits=(-1.5, 1.0))
    tree = map_parts(read_urdf(robot.write()), LAPTOP)
    assert [part.joint.name for part in tree.joints] == ["turn"]
    assert tree.locked == {"slide": 0.0}


def test_what_does_not_map_is_explained(tmp_path):
    laptop = read_urdf(two_part(tmp_path / "a").write())
    with pytest.raises(CaperError, match=r"needs 2 revolute joint.s. on the root, but it has 1"):
        map_parts(laptop, EYEGLASSES)
    with pytest.raises(CaperError, match=r"needs 3 prismatic .*it has 0 prismatic"):
        map_parts(laptop, DRAWER)
    with pytest.raises(CaperError, match=r"6 revolute joint.s. in a chain, .*chain has 1 of them"):
        map_parts(laptop, ROBOTARM)
    with pytest.raises(CaperError, match=r"revolute joints follow one another: joint1 .*joint2"):
        map_parts(read_urdf(serial_arm(tmp_path / "c")), LAPTOP)
    robot = two_part(tmp_path / "b").link("other", LID)
    robot.joint("second", "revolute", "body", "other", xyz=(0, -0.1, 0.01), limits=(0, 1))
    double = read_urdf(robot.write())
    with pytest.raises(CaperError, match=r"2 revolute joints fit alike: hinge .*--parts"):
        map_parts(double, LAPTOP)
    tree = map_parts(double, LAPTOP, ("body", "other"))
    assert tree.links == (("body", "lid"), ("other",))


def test_named_links_are_checked(tmp_path):
    model = read_urdf(serial_arm(tmp_path))
    names = [f"link{k}" for k in range(7)]
    with pytest.raises(CaperError, match="names 6 links, robotarm has 7 parts"):
        map_parts(model, ROBOTARM, names[:6])
    with pytest.raises(CaperError, match="unknown link 'lnk3'; did you mean 'link3'"):
        map_parts(model, ROBOTARM, [*names[:3], "lnk3", *names[4:]])
    with pytest.raises(CaperError, match="no revolute joint lies between 'link0' and 'world'"):
        map_parts(model, ROBOTARM, ["link0", "world", *names[2:]])
    # Merged from the other end: the first joint is locked instead of the last.
    tree = map_parts(model, ROBOTARM, [f"link{k}" for k in range(1, 8)], {"joint1": 0.5})
    assert tree.links[0] == ("world", "link0", "link1")
    assert tree.locked == {"joint1": 0.5, "finger1_joint": 0.01}


# What the user says


def test_given_frame_rest_and_scale(tmp_path):
    """Options go before what is detected; a lid given as closed at -90 deg is at rest there."""
    path = two_part(tmp_path).write()
    item = import_urdf(path, LAPTOP)
    np.testing.assert_allclose(item.size, [(0.3, 0.02, 0.2), (0.3, 0.2, 0.02)], atol=1e-9)
    np.testing.assert_allclose(item.at_rest.axis, [[-1, 0, 0]], atol=1e-12)
    model = read_urdf(path)
    scaled = import_model(model, LAPTOP, ImportOptions(scale=0.5))
    np.testing.assert_allclose(scaled.size, item.size / 2)
    np.testing.assert_allclose(scaled.at_rest.pivot, item.at_rest.pivot / 2)
    np.testing.assert_allclose(scaled.at_rest.limits, item.at_rest.limits)
    mean = import_model(model, LAPTOP, ImportOptions(scale=None))
    low = np.array(LAPTOP.mean_center) - np.array(LAPTOP.mean_size) / 2
    high = np.array(LAPTOP.mean_center) + np.array(LAPTOP.mean_size) / 2
    whole = np.ptp(mean.at_rest.bounds(), axis=0)
    assert np.linalg.norm(whole) == pytest.approx(np.linalg.norm(high.max(0) - low.min(0)))
    for rest in ({"": 10.0}, {"hinge": 10.0}, {"lid": 10.0}):
        leaning = import_model(model, LAPTOP, ImportOptions(rest=rest))
        shift = leaning.at_rest.limits - item.at_rest.limits
        # A positive state closes the lid in the file, and opens it here.
        np.testing.assert_allclose(np.degrees(shift), [[10, 10]], atol=1e-9)
    given = ImportOptions(up=np.array([0, 0, 2.0]), front=np.array([0, -1.0, 0]))
    same = import_model(model, LAPTOP, given)
    np.testing.assert_allclose(same.box_center, item.box_center, atol=1e-12)
    with pytest.raises(CaperError, match="give both --up and --front"):
        import_model(model, LAPTOP, ImportOptions(up=np.array([0, -1.0, 0])))
    with pytest.raises(CaperError, match="axis of hinge lies across"):
        import_model(
            model, LAPTOP, ImportOptions(up=np.array([0, 0, 1.0]), front=np.array([1.0, 0, 0]))
        )
    with pytest.raises(CaperError, match="--rest: unknown joint 'hing'; did you mean 'hinge'"):
        import_model(model, LAPTOP, ImportOptions(rest={"hing": 0.0}))
    with pytest.raises(CaperError, match=r"turns from .*wrong rest"):
        import_model(model, LAPTOP, ImportOptions(rest={"hinge": 160.0}))


def test_oblique_models_keep_their_hinge(tmp_path):
    """Turned by 30 deg about the vertical: x runs along the hinge, not along the file's axes."""
    straight = import_urdf(two_part(tmp_path / "a").write(), LAPTOP)
    robot = two_part(tmp_path / "b").link("world")
    robot.joint("turn", "fixed", "world", "body", rpy="0 0 0.5235987755982988")
    turned = import_urdf(robot.write(), LAPTOP)
    for field in ("axis", "pivot"):
        np.testing.assert_allclose(
            getattr(turned.at_rest, field), getattr(straight.at_rest, field), atol=1e-9
        )
    assert "30 deg off the file's axes" in turned.notes[-2]


def test_categories_without_a_rule_take_the_usual_frame(tmp_path):
    """One's own category: at rest at 0, z up, x to the front, the sense of the file."""
    category = dataclasses.replace(LAPTOP, name="hatch", urdf_rule=UrdfRule())
    item = import_urdf(two_part(tmp_path).write(), category)
    np.testing.assert_allclose(item.at_rest.axis, [[0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(item.at_rest.limits, [[-1.5, 1.0]])
    np.testing.assert_allclose(item.size, [(0.2, 0.02, 0.3), (0.02, 0.2, 0.3)], atol=1e-9)


def test_another_class_of_partnet_is_refused(tmp_path):
    with pytest.raises(CaperError, match="PartNet-Mobility calls it 'Laptop'"):
        import_urdf(partnet_laptop(tmp_path), DRAWER)
