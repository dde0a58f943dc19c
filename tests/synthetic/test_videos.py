"""Generated videos: how states and cameras move, what stays the same, and the files they make."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
import pytest
from _helpers.microwave import MICROWAVE
from _helpers.shapes import outside_part
from scipy.spatial.transform import Rotation

from caper_jax import categories, cli
from caper_jax.articulation.category import Viewpoint
from caper_jax.config import GeneratorConfig
from caper_jax.data.hdf5 import Hdf5Dataset
from caper_jax.data.types import pose_problems, validate
from caper_jax.errors import CaperError
from caper_jax.synthetic import videos
from caper_jax.synthetic.camera import camera_arc, camera_pose, draw_camera
from caper_jax.synthetic.images import render_clip
from caper_jax.synthetic.videos import MODES, VideoGenerator, video

LAPTOP = categories.get("laptop")
CONFIG = GeneratorConfig(instances=10, grid=40, num_points=256, noise=("none",))
VIDEOS, FRAMES = 6, 30


@pytest.fixture(scope="module")
def batches():
    """Mode -> (generator, Batch [V, T, ...]); one compiled program serves all modes."""
    found = {}
    settings = (MICROWAVE, CONFIG, FRAMES, VIDEOS)
    draw = jax.jit(lambda key, bank, motion: videos._batch(key, bank, motion, *settings))
    for mode in MODES:
        generator = VideoGenerator(MICROWAVE, CONFIG, mode, FRAMES)
        generator.draw = partial(draw, bank=generator.bank, motion=generator._motion)
        batch = generator.draw(jax.random.key(3))
        found[mode] = generator, jax.tree.map(np.asarray, batch)
    return found


def per_frame(pose):
    """Rotation [deg] and translation [m] of the root from frame to frame, each [V, T - 1]."""
    turns = np.einsum("vtij,vtkj->vtik", pose.rotation[:, 1:, 0], pose.rotation[:, :-1, 0])
    angle = Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude().reshape(turns.shape[:2])
    return np.degrees(angle), np.linalg.norm(np.diff(pose.translation[:, :, 0], axis=1), axis=-1)


def shares(generator, batch):
    """Joint states as shares of each instance's range, [V, T, J]."""
    limits = np.asarray(generator.bank.limits)[batch.instance]
    return (batch.pose.joint_state - limits[..., 0]) / (limits[..., 1] - limits[..., 0])


@pytest.mark.parametrize("mode", ["paper", "cam"])
def test_all_states_go_up_by_unequal_steps(batches, mode):
    state = shares(*batches[mode])
    assert state.shape == (VIDEOS, FRAMES, 1)
    steps = np.diff(state, axis=1)
    assert (steps > 0).all()
    assert state[:, 0].min() >= 0 and state[:, 0].max() <= 0.35 + 1e-6
    assert state[:, -1].min() >= 0.65 - 1e-6 and state[:, -1].max() <= 1 + 1e-6
    assert (steps.max(axis=1) / steps.min(axis=1)).min() > 1.5


def test_the_camera_of_the_paper_stands_still(batches):
    pose = batches["paper"][1].pose
    for array in (pose.rotation[:, :, 0], pose.translation[:, :, 0]):
        np.testing.assert_array_equal(array, np.broadcast_to(array[:, :1], array.shape))


def test_a_moving_camera_keeps_its_measure(batches):
    """0.3 to 1.3 deg per frame; the distance changes by up to 15 % over the clip."""
    pose = batches["cam"][1].pose
    degrees, meters = per_frame(pose)
    assert degrees.min() > 0.25 and degrees.max() < 1.5
    # A smooth arc: no frame moves much more than its neighbors.
    assert (degrees[:, 1:] / degrees[:, :-1]).max() < 1.1
    distance = np.linalg.norm(pose.translation[:, :, 0], axis=-1)
    change = distance[:, -1] / distance[:, 0]
    assert change.min() > 0.85 - 1e-3 and change.max() < 1 / 0.85 + 1e-3
    assert (np.abs(change - 1) > 0.03).all()
    assert 0.0005 < np.median(meters) < 0.01


def test_hard_videos_reverse_and_move_twice_as_fast(batches):
    generator, batch = batches["hard"]
    state = shares(generator, batch)[..., 0]
    top = state.argmax(axis=1)
    for row, turn in zip(state, top, strict=True):
        assert (np.diff(row[: turn + 1]) > 0).all() and (np.diff(row[turn:]) < 0).all()
    assert top.min() > 0.3 * FRAMES and top.max() < 0.7 * FRAMES
    assert state.min() >= 0 and state.max() <= 1
    np.testing.assert_allclose(state[:, 0], state[:, -1], atol=1e-5)
    # The same key draws the same arc, but for where its ranges turn it round.
    ratio = np.median(per_frame(batch.pose)[0] / per_frame(batches["cam"][1].pose)[0])
    assert ratio == pytest.approx(2.0, rel=0.1)


def test_nothing_but_the_noise_moves_in_still_videos(batches):
    generator, batch = batches["still"]
    for array in (batch.pose.rotation, batch.pose.translation, batch.pose.joint_state):
        np.testing.assert_array_equal(array, np.broadcast_to(array[:, :1], array.shape))
    state = shares(generator, batch)
    assert state.min() >= 0 and state.max() <= 1 and np.ptp(state[:, 0]) > 0.2
    assert (batch.points[:, 1:] == batch.points[:, :-1]).all(axis=-1).mean() < 0.01


def test_kinematics_labels_and_instance_hold_in_every_frame(batches):
    for _, batch in batches.values():
        pose = batch.pose
        assert pose_problems(pose, MICROWAVE) == []
        assert outside_part(pose, batch.points, batch.labels).max() < 1e-4
        assert (batch.points[..., 2] > 0).all()
        for array in (pose.size, pose.joint_pivot, batch.instance):
            np.testing.assert_array_equal(array, np.broadcast_to(array[:, :1], array.shape))
        assert batch.instance.shape == (VIDEOS, FRAMES)


def test_frames_are_sampled_afresh_and_the_same_key_repeats_them(batches):
    generator, batch = batches["paper"]
    again = generator.draw(jax.random.key(3))
    np.testing.assert_array_equal(again.points, batch.points)
    other = generator.draw(jax.random.key(4))
    assert not np.array_equal(other.points, batch.points)
    # Root points of a static camera: other pixels in the next frame.
    first, second = batch.points[0, 0], batch.points[0, 1]
    assert (first == second).all(axis=-1).mean() < 0.01


def test_cameras_may_be_turned_about_their_axes():
    level, turned = Viewpoint(), Viewpoint(camera_roll=90.0)

    def poses(key):
        cameras = (
            draw_camera(key, view).replace(image_offset=np.zeros(2)) for view in (level, turned)
        )
        return [camera_pose(camera, level, 0.7) for camera in cameras]

    first, second = jax.jit(jax.vmap(poses))(jax.random.split(jax.random.key(0), 20))
    # x right, y down: a turn about z is clockwise in the image.
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(second[:, :3], turn @ first[:, :3], atol=1e-5)


def test_cameras_of_arcs_stay_in_their_ranges():
    ranges = {"azimuth": (-20.0, 60.0), "elevation": (30.0, 33.0), "distance": (2.0, 2.5)}
    view = Viewpoint(**ranges, camera_roll=40.0)

    def arc(key):
        draw, move = jax.random.split(key)
        cameras = camera_arc(move, draw_camera(draw, view), view, 20, 2.0)
        return cameras, jax.vmap(lambda camera: camera_pose(camera, view, 0.7))(cameras)

    cameras, poses = jax.jit(jax.vmap(arc))(jax.random.split(jax.random.key(0), 200))
    for values, (low, high) in (
        (np.degrees(cameras.azimuth), view.azimuth),
        (np.degrees(cameras.elevation), view.elevation),
        (np.degrees(cameras.roll), (25.0, 55.0)),
        (np.exp(cameras.log_distance), view.distance),
    ):
        assert values.min() > low - 1e-3 and values.max() < high + 1e-3
        steps = np.diff(values, axis=1)
        assert ((steps >= -1e-4).all(axis=1) | (steps <= 1e-4).all(axis=1)).all()
    eye = -np.einsum("btji,btj->bti", poses[..., :3, :3], poses[..., :3, 3])
    distance = np.linalg.norm(eye, axis=-1)
    np.testing.assert_allclose(distance, 0.7 * np.exp(cameras.log_distance), rtol=1e-5)
    np.testing.assert_allclose(eye[..., 1] / distance, np.sin(cameras.elevation), atol=1e-5)


def test_a_single_video_has_one_leading_axis(batches):
    """Only traced: the program is the one that ``VideoGenerator`` maps over its videos."""
    bank = batches["cam"][0].bank
    instance = jax.tree.map(lambda values: values[0], bank)
    shapes = jax.eval_shape(
        lambda key: video(key, instance, MICROWAVE, CONFIG, "hard", 200), jax.random.key(0)
    )
    assert shapes.points.shape == (200, CONFIG.num_points, 3)
    assert shapes.pose.rotation.shape == (200, 2, 3, 3)
    assert shapes.instance is None and shapes.visibility is None


def test_wrong_arguments_are_named():
    with pytest.raises(CaperError, match="video mode 'papr'; did you mean 'paper'"):
        VideoGenerator(LAPTOP, CONFIG, "papr")
    with pytest.raises(CaperError, match="at least 2 frames, got 1"):
        video(jax.random.key(0), None, LAPTOP, CONFIG, "cam", 1)
    with pytest.raises(CaperError, match="at least 2 frames, got 1"):
        render_clip(jax.random.key(0), None, LAPTOP, "none", np.eye(3), 64, 1, 0)


def test_generate_writes_videos_that_read_back(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(categories, "_REGISTRY", {"microwave": MICROWAVE})
    path = tmp_path / "videos.h5"
    arguments = ["generate", "--category", "microwave", "--videos", "3", "--mode", "cam"]
    arguments += ["--frames-per-video", "4", "--instances", "5", "--grid", "24", "--points", "64"]
    assert cli.main([*arguments, "--out", str(path)]) == 0
    assert "3 videos, 12 frames of 64 points" in capsys.readouterr().out
    dataset = Hdf5Dataset(path, "microwave", "test")
    assert len(dataset) == 12
    assert (dataset.names[0], dataset.names[-1]) == ("00000/000000", "00002/000003")
    assert dataset.videos() == {f"0000{v}": list(range(4 * v, 4 * v + 4)) for v in range(3)}
    assert dataset.attributes["mode"] == "cam"
    np.testing.assert_array_equal(dataset.instance, np.repeat(dataset.instance[::4], 4))
    for index in range(12):
        validate(dataset[index], MICROWAVE)
        assert dataset[index].visibility.max() > 0.3
    opening = [dataset[index].truth.joint_state[0] for index in dataset.videos()["00001"]]
    assert (np.diff(opening) > 0).all()
