"""Depth images, masks, label images and intrinsics: values read, and mistakes named."""

import json

import numpy as np
import pytest
from PIL import Image

from caper_jax.data.images import read_depth, read_intrinsics, read_json, read_labels, read_mask
from caper_jax.errors import CaperError


def save(path, array):
    if path.suffix == ".npy":
        np.save(path, array)
    else:
        Image.fromarray(array).save(path)
    return path


def test_integer_depth_is_millimeters(tmp_path):
    millimeters = np.array([[0, 1234], [65535 // 2, 700]], np.uint16)
    png = read_depth(save(tmp_path / "d.png", millimeters))
    assert png.dtype == np.float32 and png.shape == (2, 2)
    np.testing.assert_allclose(png, millimeters / 1000, rtol=1e-6)
    np.testing.assert_array_equal(png, read_depth(save(tmp_path / "d.npy", millimeters)))


def test_float_depth_is_meters_and_keeps_gaps(tmp_path):
    meters = np.array([[np.nan, 1.25], [np.inf, 0.5]], np.float64)
    np.testing.assert_array_equal(
        read_depth(save(tmp_path / "d.npy", meters)), meters.astype(np.float32)
    )
    tiff = read_depth(save(tmp_path / "d.tif", meters.astype(np.float32)))
    np.testing.assert_array_equal(tiff, meters.astype(np.float32))


def test_three_channel_depth_is_read_as_artimage_writes_it(tmp_path):
    millimeters = np.array([[0, 300], [4660, 1]], np.uint16)
    bgr = np.stack([np.zeros_like(millimeters), millimeters >> 8, millimeters & 255], -1)
    path = save(tmp_path / "d.png", bgr[..., ::-1].astype(np.uint8))
    np.testing.assert_allclose(read_depth(path), millimeters / 1000, rtol=1e-6)


@pytest.mark.parametrize("name", ["photo.jpg", "photo.png", "gray.png"])
def test_pictures_are_no_depth(tmp_path, name):
    colors = np.random.default_rng(0).integers(1, 200, (16, 16, 3)).astype(np.uint8)
    if name.startswith("gray"):
        colors[...] = colors[..., :1]
    path = tmp_path / name
    Image.fromarray(colors).save(path, "JPEG" if name.startswith("photo") else "PNG")
    with pytest.raises(CaperError, match=rf"{name}: looks like a picture, not depth"):
        read_depth(path)


def test_an_all_black_image_has_no_measurements(tmp_path):
    assert not read_depth(save(tmp_path / "d.png", np.zeros((4, 4, 3), np.uint8))).any()


def test_depth_scale_overrides_the_unit(tmp_path):
    path = save(tmp_path / "d.png", np.full((2, 2), 12000, np.uint16))
    np.testing.assert_allclose(read_depth(path, scale=1e-4), 1.2, rtol=1e-6)
    with pytest.raises(CaperError, match="depth scale must be a positive"):
        read_depth(path, scale=0)
    with pytest.raises(CaperError, match="depth scale 1 does not fit"):
        read_depth(path, scale=1)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("d.png", np.full((4, 4), 2, np.uint16), "seem to be whole meters"),
        ("d.png", np.full((4, 4), 60000, np.uint16), "finer or no depth at all"),
        ("d.npy", np.full((4, 4), 812.0), "seem to be millimeters: give the scale 0.001"),
        ("d.npy", np.full((4, 4), 1e-3), "floats are read as meters, these are not"),
        ("d.png", np.full((4, 4), 90, np.uint8), "uint8 image of shape"),
        ("d.npy", np.ones((4, 4, 2), np.float32), "holds no depth"),
    ],
)
def test_depth_in_another_unit_or_kind_is_named(tmp_path, name, array, message):
    with pytest.raises(CaperError, match=message):
        read_depth(save(tmp_path / name, array))


def test_missing_broken_and_pickled_files_are_named(tmp_path):
    with pytest.raises(CaperError, match=r"absent\.png: no such file"):
        read_depth(tmp_path / "absent.png")
    path = save(tmp_path / "d.png", np.full((64, 64), 900, np.uint16))
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(CaperError, match=r"d\.png: broken or truncated"):
        read_depth(path)
    path.write_text("no picture")
    with pytest.raises(CaperError, match=r"d\.png: not an image"):
        read_depth(path)
    np.save(tmp_path / "o.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(CaperError, match=r"o\.npy: broken"):
        read_depth(tmp_path / "o.npy")


@pytest.mark.parametrize("value", [1, 200, 255])
def test_mask_is_whatever_is_not_black(tmp_path, value):
    expected = np.zeros((4, 5), bool)
    expected[1:3, 2:] = True
    gray = np.where(expected, value, 0).astype(np.uint8)
    np.testing.assert_array_equal(read_mask(save(tmp_path / "gray.png", gray)), expected)
    color = np.zeros((4, 5, 3), np.uint8)
    color[..., 1] = gray
    np.testing.assert_array_equal(read_mask(save(tmp_path / "color.png", color)), expected)
    cutout = np.concatenate([np.full((4, 5, 3), 255, np.uint8), gray[..., None]], -1)
    np.testing.assert_array_equal(read_mask(save(tmp_path / "cutout.png", cutout)), expected)
    np.testing.assert_array_equal(read_mask(save(tmp_path / "mask.npy", expected)), expected)


@pytest.mark.parametrize("suffix", ["png", "gif"])
@pytest.mark.parametrize("white_first", [False, True])
def test_black_in_a_palette_is_a_color_not_a_number(tmp_path, suffix, white_first):
    """PIL's quantize puts the commonest color first, and that may be white."""
    expected = np.zeros((4, 5), bool)
    expected[1:3, 2:] = True
    image = Image.new("P", (5, 4))
    image.putdata((expected != white_first).ravel().tolist())
    image.putpalette([255] * 3 + [0] * 3 if white_first else [0] * 3 + [255] * 3)
    path = tmp_path / f"mask.{suffix}"
    image.save(path)
    np.testing.assert_array_equal(read_mask(path), expected)


def test_jpeg_masks_do_not_count_their_noise(tmp_path):
    expected = np.zeros((64, 64), bool)
    expected[17:40, 9:51] = True
    path = tmp_path / "mask.jpg"
    Image.fromarray(np.where(expected, 255, 0).astype(np.uint8)).save(path, quality=60)
    with Image.open(path) as image:
        assert (np.asarray(image)[~expected] > 0).any()
    np.testing.assert_array_equal(read_mask(path), expected)


def test_empty_mask_is_refused(tmp_path):
    with pytest.raises(CaperError, match=r"mask\.png: the mask is empty"):
        read_mask(save(tmp_path / "mask.png", np.zeros((4, 4), np.uint8)))


def test_labels_keep_their_numbers(tmp_path):
    labels = np.array([[0, 1, 7], [255, 3, 0]], np.uint8)
    palette = Image.fromarray(labels, "L").convert("P")
    palette.putdata(labels.ravel().tolist())
    palette.save(tmp_path / "palette.png")
    bgr = np.stack([labels, np.zeros_like(labels), np.zeros_like(labels)], -1)
    for path in (
        tmp_path / "palette.png",
        save(tmp_path / "gray.png", labels),
        save(tmp_path / "color.png", bgr[..., ::-1]),
        save(tmp_path / "labels.npy", labels.astype(np.int64)),
    ):
        found = read_labels(path)
        assert found.dtype == np.int32
        np.testing.assert_array_equal(found, labels)
    with pytest.raises(CaperError, match="must be"):
        read_labels(save(tmp_path / "float.npy", labels.astype(float)))


EXPECTED = np.array([[914.2, 0, 641.0], [0, 913.0, 364.1], [0, 0, 1]])


@pytest.mark.parametrize(
    "content",
    [
        {"width": 1280, "height": 720, "intrinsic_matrix": EXPECTED.T.ravel().tolist()},
        {"fx": 914.2, "fy": 913.0, "cx": 641.0, "cy": 364.1},
        {"K": EXPECTED.tolist()},
        {"camera_matrix": EXPECTED.ravel().tolist()},
    ],
)
def test_every_layout_of_intrinsics(tmp_path, content):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    np.testing.assert_array_equal(read_intrinsics(path, (720, 1280)), EXPECTED)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"intrinsic_matrix": EXPECTED.ravel().tolist()}, "transposed.*column by column"),
        ({"K": EXPECTED.T.tolist()}, "transposed.*row by row"),
        ({"K": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "last row of K must be 0 0 1"),
        ({"K": [[1, 2], [3, 4]]}, "K must be 9 numbers"),
        ({"K": [[1, 0], [3, 4, 5], 2]}, "K must be 9 numbers"),
        ({"K": [float("nan")] * 9}, r"K\.0 "),
        ({"K": (EXPECTED * [1, -1, 1]).tolist()}, "focal lengths must be positive"),
        ({"K": np.add(EXPECTED, [[0, 1, 0], [0, 0, 0], [0, 0, 0]]).tolist()}, "has skew"),
        ({"fx": 900, "cx": 3, "cy": 4}, "lacks fy"),
        ({"fx": "900", "fy": 900, "cx": 3, "cy": 4}, r"camera\.json: fx .*'900'"),
        ({"focal": 900}, "no camera matrix"),
        ([914.2, 913.0], r"camera\.json: "),
        (
            {"width": 640, "height": 480, "intrinsic_matrix": EXPECTED.T.ravel().tolist()},
            "made for 640 x 480 images, this one is 1280 x 720",
        ),
    ],
)
def test_wrong_intrinsics_are_named(tmp_path, content, message):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    with pytest.raises(CaperError, match=message):
        read_intrinsics(path, (720, 1280))


def test_broken_json_is_named_with_its_place(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text('{"fx": 1,\n "fy" 2}')
    for read in (read_intrinsics, read_json):
        with pytest.raises(CaperError, match=r"camera\.json: broken JSON .*line 2 column 7"):
            read(path)
    path.write_bytes(b"\xff\xfe\x00")
    for read in (read_intrinsics, read_json):
        with pytest.raises(CaperError, match=r"camera\.json: "):
            read(path)
    with pytest.raises(CaperError, match="no such file"):
        read_intrinsics(tmp_path / "absent.json")


@pytest.mark.parametrize("content", ["[" * 100_000, "1" * 5000])
def test_json_beyond_what_python_reads_is_named(tmp_path, content):
    path = tmp_path / "camera.json"
    path.write_text(content)
    with pytest.raises(CaperError, match=r"camera\.json: broken JSON"):
        read_json(path)


@pytest.mark.parametrize("read", [read_json, read_depth])
def test_a_name_that_no_file_can_have_is_named(tmp_path, read):
    with pytest.raises(CaperError, match=r"xxx\.npy: (cannot be read|no such file)"):
        read(tmp_path / f"{'x' * 5000}.npy")
