"""Roots that the generator writes in public layouts are read back with the same truth."""

import json

import numpy as np
import pytest
from _helpers.shapes import boxes, outside_part
from PIL import Image as Picture
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.category import Joint
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.cli import generate
from caper_jax.data.readers import open_dataset
from caper_jax.data.types import validate
from caper_jax.errors import CaperError
from caper_jax.geometry.solids import surface_points
from caper_jax.synthetic.artimage_writer import LayoutWriter
from caper_jax.synthetic.images import Image
from caper_jax.synthetic.instances import draw_instances

SIZE, RENDERED = 64, 128
PM_VIDEOS = ["--layout", "pm-videos", "--videos", "2"]
CAMERA = np.array([[91.4, 0.0, 31.5], [0.0, 90.0, 32.5], [0.0, 0.0, 1.0]])
NAMES = [name for name in categories.names() if categories.get(name).shape is not None]


def posed(model, category, rng):
    """A random pose of the object, 3 diagonals away; SciPy does the kinematics."""
    low, high = boxes(model).transpose(1, 0, 2)
    diagonal = np.linalg.norm(high.max(0) - low.min(0))
    rotations, shifts = [Rotation.random(rng=rng)], [np.array([0.0, 0.0, 3 * diagonal])]
    states = rng.uniform(model.limits[:, 0], model.limits[:, 1])
    for j, (joint, state) in enumerate(zip(category.joints, states, strict=True)):
        parent, shift = rotations[joint.parent], shifts[joint.parent]
        if joint.type == "revolute":
            turn = Rotation.from_rotvec(state * model.axis[j])
            offset = model.pivot[j] - turn.apply(model.pivot[j])
        else:
            turn, offset = Rotation.identity(), state * model.axis[j]
        rotations.append(parent * turn)
        shifts.append(parent.apply(offset) + shift)
    return ArticulatedPose(
        rotation=np.stack([rotation.as_matrix() for rotation in rotations]),
        translation=np.stack(shifts),
        size=high - low,
        box_center=(low + high) / 2,
        joint_axis=model.axis,
        joint_pivot=model.pivot,
        joint_state=states,
    )


def seen(model, pose):
    """Depth and parts of points on the surfaces: the nearest in every pixel."""
    depth, parts = np.full((SIZE, SIZE), np.inf, np.float32), np.full((SIZE, SIZE), -1, np.int32)
    for k, solids in enumerate(model.parts):
        points = surface_points(solids, 2000, np.random.default_rng(k))
        points = points @ pose.rotation[k].T + pose.translation[k]
        pixels = points @ CAMERA.T
        u, v = np.rint(pixels[:, :2] / pixels[:, 2:]).astype(int).T
        inside = (points[:, 2] > 0.01) & (u >= 0) & (u < SIZE) & (v >= 0) & (v < SIZE)
        for u_, v_, z in zip(u[inside], v[inside], points[inside, 2], strict=True):
            if z < depth[v_, u_]:
                depth[v_, u_], parts[v_, u_] = z, k
    return Image(np.where(parts >= 0, depth, 0).astype(np.float32), parts, CAMERA, pose)


def assert_same(frame, image):
    for field, expected in vars(image.pose).items():
        found = getattr(frame.truth, field)
        np.testing.assert_allclose(found, expected, atol=1e-5, rtol=0, err_msg=field)
    np.testing.assert_array_equal(frame.mask, image.parts >= 0)
    np.testing.assert_allclose(frame.depth[frame.mask], image.depth[frame.mask], atol=5.1e-4)
    counts = np.bincount(image.parts[image.parts >= 0], minlength=len(image.pose.size))
    np.testing.assert_array_equal(frame.visible, counts)


@pytest.mark.parametrize("name", NAMES)
def test_every_category_reads_back(tmp_path, name):
    """Revolute and prismatic joints, several parts, deep trees; train and test in two runs."""
    category = categories.get(name)
    rng = np.random.default_rng(7)
    for split in ("train", "test"):
        models = draw_instances(category, 2, split, 3)
        images = [seen(model, posed(model, category, rng)) for model in models]
        writer = LayoutWriter(tmp_path, category, split, CAMERA, (SIZE, SIZE))
        for index, (model, image) in enumerate(zip(models, images, strict=True)):
            writer.add_object(100 * len(split) + index, model)
            writer.add_frame(100 * len(split) + index, image)
        writer.close()
        dataset = open_dataset("artimage", tmp_path, name, split)
        assert len(dataset) == 2
        for index, image in enumerate(images):
            frame = dataset[index]
            validate(frame, category)
            assert_same(frame, image)
    assert list(open_dataset("artimage", tmp_path, name).names) == [f"{i:06d}" for i in range(4)]


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(generate, "SIZE", RENDERED)
    monkeypatch.setattr(generate, "FOCAL", 182.8)


def run(out, *arguments):
    common = ["--category", "laptop", "--noise", "none", "--seed", "5", "--out", str(out)]
    assert generate.run(generate.parse([*common, *arguments])) == 0


def assert_whole(frame):
    """The object is in the image, in its boxes, and off its edges."""
    assert frame.mask.any()
    for edge in (frame.mask[0], frame.mask[-1], frame.mask[:, 0], frame.mask[:, -1]):
        assert not edge.any()
    assert outside_part(frame.truth, frame.points, frame.labels).max() < 0.002


def test_rendered_images_as_of_artimage(tmp_path, small):
    # The same two instances as below: one compiled program serves both tests.
    run(tmp_path, "--layout", "artimage", "--frames", "5", "--instances", "2")
    dataset = open_dataset("artimage", tmp_path, "laptop", "test")
    assert len(dataset) == 5
    for index in range(5):
        frame = dataset[index]
        validate(frame, dataset.category)
        assert_whole(frame)
        assert (frame.depth[~frame.mask] == 0).all()
    with Picture.open(tmp_path / "laptop/train/color/000000.jpg") as color:
        assert color.size == (RENDERED, RENDERED)
    with pytest.raises(CaperError, match=r"test\.txt: lists frames already"):
        run(tmp_path, "--layout", "artimage", "--frames", "1")


def test_rendered_videos_as_of_pm_videos(tmp_path, small):
    run(tmp_path, *PM_VIDEOS, "--frames-per-video", "5")
    dataset = open_dataset("pm-videos", tmp_path, "laptop", "test")
    assert dataset.videos() == {"00000": list(range(5)), "00001": list(range(5, 10))}
    low, high = np.radians([-70, 60])
    for indices in dataset.videos().values():
        frames = [dataset[index] for index in indices]
        for frame in frames:
            validate(frame, dataset.category)
            assert_whole(frame)
        states = np.array([frame.truth.joint_state[0] for frame in frames])
        assert (np.diff(states) > 0).all() and np.ptp(states) > 0.5 * (high - low)
        for frame in frames:  # the camera stands still
            np.testing.assert_allclose(frame.truth.rotation[0], frames[0].truth.rotation[0])
        assert {dataset.moving_part(index) for index in indices} == {1}


def test_a_root_has_one_camera_and_every_object_once(tmp_path):
    category = categories.get("box")
    model = draw_instances(category, 1, "train", 0)[0]
    writer = LayoutWriter(tmp_path, category, "train", CAMERA, (SIZE, SIZE))
    writer.add_object(7, model)
    with pytest.raises(CaperError, match="holds an object 7 already"):
        writer.add_object(7, model)
    writer.close()
    with pytest.raises(CaperError, match=r"camera_intrinsic\.json: another camera"):
        LayoutWriter(tmp_path, category, "test", 2 * CAMERA, (SIZE, SIZE))
    assert json.loads((tmp_path / "box/urdf/rest_state.json").read_text()) == {
        "7": {"1": {"state": 0.0}}
    }


def test_objects_of_a_run_that_was_cut_off_are_not_mixed_in(tmp_path):
    category = categories.get("box")
    first, second = draw_instances(category, 2, "train", 0)
    LayoutWriter(tmp_path, category, "train", CAMERA, (SIZE, SIZE)).add_object(7, first)
    points = next(tmp_path.glob("box/urdf/7/*/0.xyz")).read_bytes()
    writer = LayoutWriter(tmp_path, category, "train", CAMERA, (SIZE, SIZE))
    with pytest.raises(CaperError, match=r"holds an object 7 already; choose .* delete"):
        writer.add_object(7, second)
    assert next(tmp_path.glob("box/urdf/7/*/0.xyz")).read_bytes() == points


def test_the_stored_joints_have_the_public_sign(tmp_path):
    """The axis of a revolute joint is written reversed, that of a prismatic one as it is."""
    laptop = categories.get("laptop")
    assert laptop.joints[0] == Joint("revolute", 0, laptop.joints[0].limits)
    model = draw_instances(laptop, 1, "train", 0)[0]
    writer = LayoutWriter(tmp_path, laptop, "train", CAMERA, (SIZE, SIZE))
    writer.add_object(7, model)
    text = (tmp_path / "laptop/urdf/7/mobility_for_unity_align.urdf").read_text()
    np.testing.assert_array_equal(model.axis, [[-1, 0, 0]])
    assert '<axis xyz="0 1 0"/>' in text  # (z, x, y) of +x
