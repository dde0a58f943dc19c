"""The project's HDF5 format: what comes back, how precisely, and what is refused."""

import dataclasses

import h5py
import numpy as np
import pytest
from _helpers.frames import random_frames

from caper_jax import categories
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.hdf5 import Hdf5Dataset, check_writable, write
from caper_jax.data.readers import open_dataset
from caper_jax.data.types import Frame, pose_shapes, validate
from caper_jax.errors import CaperError

BOX = categories.get("box")
FRAMES, POINTS = 5, 300


def write_box(path, **changes):
    arguments = {"category": BOX, "split": "test", **random_frames(FRAMES, POINTS), **changes}
    write(path, **arguments)
    return arguments


def test_everything_comes_back_to_a_hundredth_of_a_millimeter(tmp_path):
    path = tmp_path / "box_test.h5"
    written = write_box(path, attributes={"noise": "realsense", "seed": 7})
    dataset = open_dataset("caper", path, "box", "test")
    assert len(dataset) == FRAMES and dataset.category is BOX
    assert (dataset.format, dataset.split, dataset.mask_source) == ("caper", "test", "simulated")
    assert dataset.names == ["000000", "000001", "000002", "000003", "000004"]
    assert dataset.attributes["noise"] == "realsense" and dataset.attributes["seed"] == 7
    for i in range(FRAMES):
        frame = dataset[i]
        validate(frame, BOX)
        assert np.abs(frame.points - written["points"][i]).max() < 1e-5
        np.testing.assert_array_equal(frame.labels, written["labels"][i])
        np.testing.assert_array_equal(frame.visible, written["visible"][i])
        for key in pose_shapes(2):
            expected = getattr(written["pose"], key)[i]
            np.testing.assert_array_equal(getattr(frame.truth, key), expected)


def test_optional_fields_come_back_or_are_none(tmp_path):
    path = tmp_path / "box.h5"
    write_box(path)
    plain = Hdf5Dataset(path)
    assert plain.video is None and plain.frame is None and plain.instance is None
    assert plain.videos() == {} and plain[0].visibility is None
    visibility = np.linspace(0, 1, 2 * FRAMES).reshape(FRAMES, 2)
    video, frame = np.array([7, 2, 7, 2, 7]), np.array([3, 0, 1, 5, 2])
    write_box(
        path,
        visibility=visibility,
        video=video,
        frame=frame,
        instance=np.arange(FRAMES),
        overwrite=True,
    )
    dataset = Hdf5Dataset(path)
    np.testing.assert_array_equal(dataset.video, video)
    np.testing.assert_array_equal(dataset.frame, frame)
    np.testing.assert_array_equal(dataset.instance, np.arange(FRAMES))
    assert dataset.videos() == {"00002": [1, 3], "00007": [2, 4, 0]}  # in the order of time
    for i in range(FRAMES):
        validate(dataset[i], BOX)
        np.testing.assert_array_equal(dataset[i].visibility, visibility[i].astype(np.float32))


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "box.h5"
    with pytest.raises(TypeError):
        write_box(path, attributes={"seed": object()})
    assert list(tmp_path.iterdir()) == []
    write_box(path)
    before = path.read_bytes()
    with pytest.raises(CaperError, match="exists already"):
        write_box(path)
    assert path.read_bytes() == before
    write_box(path, split="train", overwrite=True)
    assert Hdf5Dataset(path).split == "train"


def test_unwritable_places_are_named_first(tmp_path):
    with pytest.raises(CaperError, match="is a folder"):
        check_writable(tmp_path)
    with pytest.raises(CaperError, match="does not exist"):
        check_writable(tmp_path / "absent" / "box.h5")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": np.zeros((FRAMES, POINTS, 2))}, r"points must be \[F, N, 3\]"),
        ({"points": np.full((FRAMES, POINTS, 3), np.nan)}, "points_mean has NaN"),
        (
            {"labels": np.full((FRAMES, POINTS), 2)},
            "labels must be from -1 to 1, got 2",
        ),
        ({"labels": np.zeros((FRAMES, POINTS - 1))}, r"labels has shape \(5, 299\)"),
        ({"visible": np.full((FRAMES, 2), -1)}, "visible must be at least 0"),
        ({"visibility": np.full((FRAMES, 2), 1.1)}, "visibility must be from 0 to 1"),
        ({"visibility": np.ones((FRAMES, 3))}, r"visibility has shape \(5, 3\)"),
        ({"visibility": np.full((FRAMES, 2), np.nan)}, "visibility has NaN"),
        ({"video": np.zeros(FRAMES)}, "video and frame must be given together"),
        ({"video": [0] * FRAMES, "frame": [0, 1, 2, 3, 3]}, "name a frame twice"),
        ({"video": [0] * FRAMES, "frame": [-1, 1, 2, 3, 4]}, "frame must be at least 0"),
        ({"names": ["a"] * FRAMES}, "name has duplicates"),
        ({"names": ["a"]}, "name is"),
    ],
)
def test_arrays_against_the_conventions_are_not_written(tmp_path, changes, message):
    with pytest.raises(CaperError, match=message):
        write_box(tmp_path / "box.h5", **changes)
    assert list(tmp_path.iterdir()) == []


def test_what_a_file_must_say_about_itself(tmp_path):
    path = tmp_path / "box.h5"
    write_box(path)
    with pytest.raises(CaperError, match="holds category 'box', not 'laptop'"):
        Hdf5Dataset(path, "laptop")
    with pytest.raises(CaperError, match="holds split 'test', not 'train'"):
        Hdf5Dataset(path, "box", "train")
    for key, value, message in (
        ("format_version", 99, "format_version .* 99"),
        ("category", "bxo", "unknown category 'bxo'; did you mean 'box'"),
    ):
        write_box(path, overwrite=True)
        with h5py.File(path, "r+") as file:
            file.attrs[key] = value
        with pytest.raises(CaperError, match=message):
            Hdf5Dataset(path)
    with h5py.File(path, "r+") as file:
        del file.attrs["units"]
    with pytest.raises(CaperError, match="units is missing"):
        Hdf5Dataset(path)


@pytest.mark.parametrize("field", ["points", "rotation", "name"])
def test_missing_and_misshapen_fields_are_named(tmp_path, field):
    path = tmp_path / "box.h5"
    write_box(path)
    with h5py.File(path, "r+") as file:
        shortened = file[field][:-1]
        del file[field]
        file[field] = shortened
    with pytest.raises(CaperError, match=field if field != "points" else "points_mean"):
        Hdf5Dataset(path)
    with h5py.File(path, "r+") as file:
        del file[field]
    with pytest.raises(CaperError, match=f"lacks the field {field!r}"):
        Hdf5Dataset(path)


def test_damaged_files_are_named(tmp_path):
    path = tmp_path / "box.h5"
    with pytest.raises(CaperError, match="no such file"):
        Hdf5Dataset(path)
    write_box(path)
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"not hdf5 at all" * 100):
        path.write_bytes(damaged)
        with pytest.raises(CaperError, match=r"box\.h5: truncated or not an HDF5 file"):
            Hdf5Dataset(path)


def test_text_in_another_encoding_is_named(tmp_path):
    path = tmp_path / "box.h5"
    write_box(path)
    with h5py.File(path, "r+") as file:
        file["name"][0] = "Büchse".encode("latin-1")
    with pytest.raises(CaperError, match=r"box\.h5: name is not UTF-8"):
        Hdf5Dataset(path)


@pytest.mark.parametrize("error", [RuntimeError, KeyError, TypeError])
def test_whatever_h5py_makes_of_damage_is_named(tmp_path, monkeypatch, error):
    write_box(tmp_path / "box.h5")

    def fail(*_):
        raise error("bad object header version number")

    monkeypatch.setattr(h5py.AttributeManager, "__iter__", fail)
    with pytest.raises(CaperError, match=r"box\.h5: corrupted .*bad object header"):
        Hdf5Dataset(tmp_path / "box.h5")


def test_objects_are_never_unpickled(tmp_path):
    path = tmp_path / "box.h5"
    write_box(path)
    with h5py.File(path, "r+") as file:
        del file["name"]
        file.create_dataset("name", data=["a"] * FRAMES, dtype=h5py.string_dtype())
    with pytest.raises(CaperError, match="field 'name' has type object"):
        Hdf5Dataset(path)


def test_unknown_format_names_the_nearest():
    with pytest.raises(CaperError, match="unknown format 'reartmx'; did you mean 'reartmix'"):
        open_dataset("reartmx", ".", "box")


def good_frame():
    arrays = random_frames(FRAMES, POINTS)
    truth = ArticulatedPose(**{k: getattr(arrays["pose"], k)[0] for k in pose_shapes(2)})
    labels = arrays["labels"][0].astype(np.int32)
    return Frame("f", arrays["points"][0], labels, truth, arrays["visible"][0])


def test_validate_names_every_problem_at_once():
    frame = good_frame()
    validate(frame, BOX)
    bad = dataclasses.replace(
        frame,
        points=frame.points.astype(np.float64),
        labels=np.full(POINTS, 5, np.int32),
        visible=np.array([1, -1]),
        truth=frame.truth.replace(size=-frame.truth.size, joint_axis=2 * frame.truth.joint_axis),
    )
    with pytest.raises(CaperError) as error:
        validate(bad, BOX)
    for phrase in (
        "frame 'f' of box",
        "points is float64",
        "labels must be from -1 to 1, got 5 at [0]",
        "visible must be at least 0, got -1 at [1]",
        "size must be positive at [0, 0]",
        "joint_axis is not a unit vector",
    ):
        assert phrase in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace(rotation=1.1 * t.rotation), "rotation is not orthonormal.*its scale"),
        (lambda t: t.replace(rotation=t.rotation * [1, 1, -1]), "rotation is a reflection"),
        (lambda t: t.replace(joint_state=-t.joint_state), "pose of part 'lid' is not the one"),
        (lambda t: t.replace(joint_state=np.degrees(t.joint_state)), "sign and unit"),
        (lambda t: t.replace(translation=1000 * t.translation), "millimeters"),
        (lambda t: t.replace(joint_pivot=t.joint_pivot + 0.02), "axis and pivot are in the root"),
        (lambda t: t.replace(size=t.size[:1]), r"size has shape \(1, 3\), expected \(2, 3\)"),
        (lambda t: t.replace(size=t.size.astype(int)), "size is int64, expected floating"),
        (lambda t: t.replace(joint_pivot=t.joint_pivot * np.nan), r"joint_pivot has NaN.*\[0, 0\]"),
    ],
)
def test_validate_understands_poses(change, message):
    frame = good_frame()
    with pytest.raises(CaperError, match=message):
        validate(dataclasses.replace(frame, truth=change(frame.truth)), BOX)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": np.zeros((0, 3), np.float32)}, r"points has shape \(0, 3\)"),
        ({"points": np.full((POINTS, 3), np.inf, np.float32)}, r"points has NaN.*at \[0, 0\]"),
        ({"points": np.full((POINTS, 3), 800, np.float32)}, "are they in millimeters"),
        ({"labels": np.zeros(3, np.int32)}, r"labels has shape \(3,\)"),
        ({"labels": np.zeros(POINTS)}, "labels is float64, expected int32"),
        ({"visible": np.zeros(3, int)}, r"visible has shape \(3,\)"),
        ({"visibility": np.ones(3)}, r"visibility has shape \(3,\)"),
        ({"visibility": np.array([0.5, np.nan])}, r"visibility has NaN.* at \[1\]"),
    ],
)
def test_validate_understands_clouds(changes, message):
    with pytest.raises(CaperError, match=message):
        validate(dataclasses.replace(good_frame(), **changes), BOX)
