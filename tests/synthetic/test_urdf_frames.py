"""Frames of imported objects: against the generator's own caster, and through the command."""

from __future__ import annotations

import json
from functools import partial

import jax
import numpy as np
import pytest

pytest.importorskip("trimesh")
pytest.importorskip("embreex")
pytest.importorskip("yourdfpy")

from _helpers.shapes import outside_part
from _helpers.solid_meshes import mesh_object
from _helpers.urdf_models import partnet_drawer, partnet_laptop
from PIL import Image

from caper_jax import cli
from caper_jax.categories.laptop import LAPTOP
from caper_jax.data.readers import open_dataset
from caper_jax.data.types import validate
from caper_jax.data.urdf.canonical import ImportedObject, JointMap
from caper_jax.errors import CaperError
from caper_jax.geometry.meshes import Mesh
from caper_jax.synthetic.frames import draw_state_and_poses
from caper_jax.synthetic.instances import build_bank, draw_instances
from caper_jax.synthetic.ray_casting import cast
from caper_jax.synthetic.urdf_frames import PartCaster, render_frames

FRAMES, GRID, POINTS = 4, 40, 300


def generated(model, category, name="it"):
    """A generated object as if imported."""
    at_rest = mesh_object(model, category)
    boxes = np.array([mesh.bounds() for mesh in at_rest.parts])
    size, center = np.ptp(boxes, axis=1), boxes.mean(1)
    joints = tuple(
        JointMap(f"j{j}", joint.type, 1.0, 0.0, (low, high), (low, high))
        for j, (joint, (low, high)) in enumerate(zip(category.joints, model.limits, strict=True))
    )
    return ImportedObject(name, category, at_rest, size, center, joints, ())


@pytest.fixture(scope="module")
def rendered():
    """(models, clean frames) of two generated laptops rendered from their meshes."""
    models = draw_instances(LAPTOP, 2, "test", 5)
    items = [generated(model, LAPTOP) for model in models]
    batch = render_frames(items, FRAMES, noise="none", num_points=POINTS, grid=GRID, seed=3)
    return models, batch


def test_frames_are_those_of_the_generator(rendered):
    """Same keys: the same states and cameras; every point where the exact caster has it."""
    models, batch = rendered
    bank = build_bank(models)
    draw = jax.jit(partial(draw_state_and_poses, category=LAPTOP))
    trace = jax.jit(cast)
    for index in range(FRAMES):
        instance = jax.tree.map(lambda values, i=index: values[i % 2], bank)
        key = jax.random.split(jax.random.fold_in(jax.random.key(3), index), 8)[0]
        state, poses, _ = draw(key, instance)
        np.testing.assert_allclose(batch.pose.joint_state[index], state, atol=1e-6)
        np.testing.assert_allclose(batch.pose.rotation[index], poses[:, :3, :3], atol=1e-5)
        np.testing.assert_allclose(batch.pose.translation[index], poses[:, :3, 3], atol=1e-5)
        points = batch.points[index]
        rays = (points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
        depth, part = trace(instance.groups, poses, rays)
        assert (part == batch.labels[index]).mean() > 0.98
        error = np.abs(depth - points[:, 2])[np.asarray(part) == batch.labels[index]]
        assert np.median(error) < 2e-6
        assert (error < 1e-4).mean() > 0.98
    assert batch.instance.tolist() == [0, 1, 0, 1]
    assert batch.points.shape == (FRAMES, POINTS, 3) and batch.labels.min() >= 0


def test_visible_pixels_and_hidden_share(rendered):
    """Counts add up to the object's pixels; a part alone never shows fewer."""
    _, batch = rendered
    assert (batch.visible.sum(1) <= GRID * GRID).all()
    assert (batch.visible.sum(1) > 0.1 * GRID * GRID).all()
    assert ((batch.visibility >= 0) & (batch.visibility <= 1)).all()
    # Some laptop here hides a part of its own.
    assert batch.visibility.min() < 0.999


def test_same_seed_and_split_same_frames_and_noise_moves_them(rendered):
    models, clean = rendered
    items = [generated(model, LAPTOP) for model in models]
    options = {"num_points": POINTS, "grid": GRID, "seed": 3}
    again = render_frames(items, FRAMES, noise="none", **options)
    np.testing.assert_array_equal(again.points, clean.points)
    train = render_frames(items, FRAMES, noise="none", split="train", **options)
    assert not np.isclose(train.pose.joint_state, clean.pose.joint_state).any()
    noisy = render_frames(items, FRAMES, noise="kinect", **options)
    np.testing.assert_array_equal(noisy.pose.rotation, clean.pose.rotation)
    distance = np.linalg.norm(noisy.points[0, :, None] - clean.points[0], axis=-1).min(1)
    assert 2e-4 < np.median(distance) < 2e-2


def test_rays_meet_a_cube_where_they_should():
    """Reach, normals and misses of rays at a turned and shifted cube of side 2, by hand."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [0.5, 0, 5]
    caster = PartCaster([Mesh(corners, np.array(faces))])
    origins = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [-9, 0.3, 5.2]], float)
    directions = np.array([[0, 0, 1], [0.05, 0.1, 1], [1, 0, 1], [2, 0, 0]], float)
    reach, faces = caster.cast(pose[None], origins, directions)
    np.testing.assert_allclose(reach[0], [4, 4, np.inf, 4.25], rtol=1e-9)
    assert faces[0, 2] == -1
    normals = caster.normals(0, faces[0, [0, 1, 3]], pose)
    np.testing.assert_allclose(np.abs(normals), [[0, 0, 1], [0, 0, 1], [1, 0, 0]], atol=1e-12)


def run(*arguments):
    return cli.main(["generate", *map(str, arguments)])


def test_command_imports_a_folder_of_models(tmp_path, capsys):
    """Laptops of a set are taken, other classes passed over; the file reads back."""
    for name in ("11", "12"):
        partnet_laptop(tmp_path / "set" / name)
    partnet_drawer(tmp_path / "set" / "13")
    out = tmp_path / "laptops.h5"
    small = ("--frames", FRAMES, "--grid", GRID, "--points", POINTS)
    asked = ("--category", "laptop", "--urdf", tmp_path / "set", "--scale", 0.25, "--out", out)
    assert run(*asked, *small) == 0
    printed = capsys.readouterr()
    assert "imported: 2 of 3 objects" in printed.out
    assert "passed over" in printed.err and "'StorageFurniture'" in printed.err
    dataset = open_dataset("caper", out, "laptop")
    assert dataset.attributes["source"] == "urdf"
    assert list(dataset.names[:2]) == ["laptop_11_000000", "laptop_12_000001"]
    for index in range(FRAMES):
        frame = dataset[index]
        validate(frame, LAPTOP)
        # Noise of a Kinect at these distances.
        assert np.median(outside_part(frame.truth, frame.points, frame.labels)) < 0.01
    for name in ("11", "12"):
        with Image.open(tmp_path / "laptops_check" / f"{name}.png") as picture:
            assert picture.width > 1000 and len(picture.getcolors(1 << 24)) > 50
        text = (tmp_path / "laptops_check" / f"{name}.txt").read_text()
        assert "link_0 (screen)" in text and "up detected" in text
        report = json.loads((tmp_path / "laptops_check" / f"{name}.json").read_text())
        assert report["joints"]["lid"]["file_joint"] == "joint_0"


def test_nothing_usable_is_an_error(tmp_path, capsys):
    partnet_drawer(tmp_path / "set" / "1")
    partnet_drawer(tmp_path / "set" / "2")
    base = ("--category", "laptop", "--urdf", tmp_path / "set", "--out", tmp_path / "x.h5")
    assert run(*base) == 2
    assert "none of 2 objects could be used" in capsys.readouterr().err
    assert not (tmp_path / "x.h5").exists()


def test_unknown_noise_is_an_error(rendered):
    models, _ = rendered
    with pytest.raises(CaperError, match="unknown noise preset 'kinct'; did you mean 'kinect'"):
        render_frames([generated(models[0], LAPTOP)], 1, noise="kinct")
