"""The CAPTRA reader on roots whose canonical poses are known."""

import os
import pickle

import numpy as np
import pytest
from _helpers import captra_roots
from _helpers.captra_roots import STORED, captra, write_frame, write_obj, write_object
from _helpers.roots import DRAWER, EYEGLASSES, LAPTOP, OBJECTS, motions, posed, render
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.data.readers import open_dataset
from caper_jax.data.readers.captra import CaptraDataset, read_model
from caper_jax.data.types import validate
from caper_jax.errors import CaperError

THINGS = {thing.category: thing for thing in (LAPTOP, DRAWER, EYEGLASSES)}


def changed(monkeypatch, name, **fields):
    monkeypatch.setitem(STORED, name, captra_roots.Stored(**{**vars(STORED[name]), **fields}))


def assert_known(root, thing):
    """Every frame has the truth, depth and labels that it was written with."""
    dataset = open_dataset("captra", root, thing.category)
    assert dataset.mask_source == "simulated segmentation"
    seen = []
    for index, name in enumerate(dataset.names):
        place, instance, track, number = name.split("/")
        frame = dataset[index]
        validate(frame, dataset.category)
        assert frame.instance == instance and track == "0"
        image = render(posed(thing, 20 * int(instance) + int(number)))
        for field, expected in vars(image.pose).items():
            found = getattr(frame.truth, field)
            np.testing.assert_allclose(found, expected, atol=1e-5, rtol=0, err_msg=field)
        np.testing.assert_array_equal(frame.mask, image.parts >= 0)
        # A float32 z-buffer resolves no more this far from the near plane.
        np.testing.assert_allclose(frame.depth, image.depth, atol=1e-4)
        parts = image.parts[image.parts >= 0]
        np.testing.assert_array_equal(frame.visible, np.bincount(parts, minlength=len(thing.size)))
        seen.append((place, number))
    assert seen == [(place, str(n)) for place in ("render", "render_seq") for n in (9, 10, 11)]


@pytest.mark.parametrize("name", THINGS)
def test_frames_come_back_with_the_truth_they_were_made_of(tmp_path, name):
    """Any order of the links, quarter turns, senses of joints; drawers and glasses: root last."""
    thing = THINGS[name]
    assert STORED[name].links[0] == (0 if name == "laptop" else len(thing.size) - 1)
    assert_known(captra(tmp_path, thing), thing)


@pytest.mark.parametrize(
    "fields",
    [
        {"root": 1},  # the base hangs on the lid
        {"states": (np.radians(-90),), "limits": ((-2.0, 0.0),)},  # modeled closed
        # No state that means something in the file is near the rest pose.
        {"states": (np.radians(37),), "limits": ((-0.5, 0.2),)},
    ],
)
def test_laptops_modeled_in_any_way(tmp_path, monkeypatch, fields):
    changed(monkeypatch, "laptop", **fields)
    assert_known(captra(tmp_path), LAPTOP)


def test_drawers_modeled_open(tmp_path, monkeypatch):
    changed(
        monkeypatch,
        "drawer",
        states=(0.2, 0.0, 0.3),
        limits=((-0.2, 0.3), (-0.5, 0.0), (-0.3, 0.2)),
    )
    assert_known(captra(tmp_path, DRAWER), DRAWER)


def test_eyeglasses_modeled_folded(tmp_path, monkeypatch):
    changed(
        monkeypatch,
        "eyeglasses",
        states=(np.radians(80), np.radians(75)),
        limits=((-np.radians(80), 0.1), (-0.1, np.radians(75))),
    )
    assert_known(captra(tmp_path, EYEGLASSES), EYEGLASSES)


def test_scissors(tmp_path):
    """Two crossed halves, the root's handle longer; modeled 10 deg apart, standing upright."""
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij")).reshape(3, -1).T
    stand = Rotation.from_euler("xy", [90, 30], degrees=True)  # our y lies level in the file
    halves = []
    for side, reach in ((1, 0.7), (-1, 0.5)):
        blade = corners * (1.0, 0.02, 0.04) + (0.5, 0, 0)
        handle = corners * (reach, 0.03, 0.3) - (reach / 2, 0, -side * 0.1)
        turn = Rotation.from_euler("y", -side * 5, degrees=True)
        halves.append([stand.apply(turn.apply(box)) for box in (blade, handle)])
    axis = stand.apply((0, -1, 0))  # opens with minus the state
    links = []
    for number, boxes in ((1, halves[0]), (0, halves[1])):
        visuals = ""
        for index, box in enumerate(boxes):
            write_obj(tmp_path / f"{number}-{index}.obj", box)
            visuals += (
                f'<visual><geometry><mesh filename="{number}-{index}.obj"/></geometry></visual>'
            )
        links.append(f'<link name="link_{number}">{visuals}</link>')
    (tmp_path / "mobility.urdf").write_text(
        f'<robot><link name="base"/>{"".join(links)}<joint name="a" type="fixed"><parent '
        'link="base"/><child link="link_0"/></joint><joint name="b" type="revolute"><axis '
        f'xyz="{captra_roots.text(axis)}"/><parent link="link_0"/><child link="link_1"/>'
        '<limit lower="-1" upper="0.2"/></joint></robot>'
    )
    category = categories.get("scissors")
    model = read_model(tmp_path, category, category.datasets["captra"])
    assert model.links == (1, 0)
    np.testing.assert_allclose(model.axis, [[0, 1, 0]], atol=1e-9)
    # The tips' middles are 20 deg apart, half on either side of x; the root's at +z.
    for part, (boxes, side) in enumerate(zip(halves, (1, -1), strict=True)):
        turn, shift = model.to_file_rotation[part], model.to_file_shift[part]
        blade = (boxes[0].mean(0) - shift) @ turn - model.pivot[0]
        degrees = np.degrees(np.arctan2(blade[2], blade[0]))
        assert degrees == pytest.approx(side * 10, abs=0.1)


def test_splits_names_and_videos(tmp_path):
    captra(tmp_path)
    train, test = (open_dataset("captra", tmp_path, "laptop", s) for s in ("train", "test"))
    first, second = OBJECTS
    assert list(train.names) == [f"{first}/0/{n}" for n in (9, 10, 11)]
    assert list(test.names) == [f"{second}/0/{n}" for n in (9, 10, 11)]
    assert train.videos() == {} and test.videos() == {f"{second}/0": [0, 1, 2]}
    both = open_dataset("captra", tmp_path, "laptop")
    assert both.split == "all" and len(both) == 6
    assert both.videos() == {f"render_seq/{second}/0": [3, 4, 5]}


def test_the_official_split_goes_by_object(tmp_path):
    captra(tmp_path)
    official = categories.get("laptop").datasets["captra"].test_objects[0]
    write_object(tmp_path, LAPTOP, official)
    for place in ("render", "render_seq"):
        write_frame(tmp_path, LAPTOP, f"{place}/{{}}/{official}/0", 3, posed(LAPTOP, 1))

    def names(split):
        return list(CaptraDataset(tmp_path, "laptop", split, official_split=True).names)

    assert names("train") == [f"{OBJECTS[0]}/0/{n}" for n in (9, 10, 11)]
    assert names("test") == [f"{official}/0/3"]
    with pytest.raises(CaperError, match=r"train and test of .*laptop.*, not 'all'"):
        names(None)


class Malicious:
    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def test_pickles_that_would_run_something_are_refused_by_name(tmp_path):
    root = captra(tmp_path / "root")
    trace = tmp_path / "it_ran"
    bad = Malicious(f"touch {trace}")
    folder = root / f"render/laptop/{OBJECTS[0]}/0"
    dataset = CaptraDataset(root, "laptop", "train")
    (folder / "gt/9.pkl").write_bytes(pickle.dumps({"camera_pose": bad}))
    np.savez(folder / "cloud/10.npz", all_dict={"depth": np.zeros((2, 2)), "near": bad})
    for index, file in ((0, r"gt/9\.pkl"), (1, r"cloud/10\.npz, 'all_dict'")):
        with pytest.raises(CaperError, match=rf"{file}: the pickle asks for (posix|nt)\.system"):
            dataset[index]
    assert not trace.exists()


def rewrite_cloud(folder, **changes):
    path = folder / "cloud/9.npz"
    content = np.load(path, allow_pickle=True)["all_dict"].item() | changes
    np.savez(path, all_dict={k: v for k, v in content.items() if v is not None})


def rewrite_truth(folder, **changes):
    path = folder / "gt/9.pkl"
    path.write_bytes(pickle.dumps(pickle.loads(path.read_bytes()) | changes))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda f: rewrite_cloud(f, near=None), r"9\.npz: all_dict: near is missing"),
        (lambda f: rewrite_cloud(f, near=60.0), r"9\.npz: .* 0 < near < far, got 60 and"),
        (lambda f: rewrite_cloud(f, depth=np.full((72, 96), 2.0)), r"9\.npz: depth .* from 0 to 1"),
        (lambda f: rewrite_cloud(f, depth=np.zeros(7)), r"9\.npz: depth has shape \(7,\)"),
        (lambda f: rewrite_cloud(f, seg=np.zeros((2, 2))), r"seg has shape \(2, 2\)"),
        (lambda f: rewrite_cloud(f, camera_matrix=-np.eye(3)), r"9\.npz: camera_matrix"),
        (lambda f: np.savez(f / "cloud/9.npz", other=1), "lacks 'all_dict', it holds other"),
        (lambda f: (f / "cloud/9.npz").write_bytes(b"PK"), r"9\.npz"),
        (lambda f: rewrite_truth(f, link_pose={0: ((0, 0, 0), (1, 0, 0, 0))}), r"9\.pkl: .* 1"),
        (lambda f: rewrite_truth(f, camera_pose=((0, 0, 0), (2, 0, 0, 0))), r"9\.pkl: camera_pose"),
        (lambda f: rewrite_truth(f, camera_pose=7), r"9\.pkl: camera_pose"),
        (lambda f: (f / "gt/9.pkl").unlink(), r"9\.pkl: no such file"),
    ],
)
def test_bad_frames_are_named(tmp_path, edit, message):
    captra(tmp_path)
    edit(tmp_path / f"render/laptop/{OBJECTS[0]}/0")
    with pytest.raises(CaperError, match=message):
        CaptraDataset(tmp_path, "laptop", "train")[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="revolute"', 'type="prismatic"', r"joints \(link: type, parent\) are .*prismatic"),
        ('<child link="link_1"/>', '<child link="link_4"/>', r"joints .* 4: .*link_0 to link_1"),
        ("part-1.obj", "part-9.obj", r"part-9\.obj"),
        ('<link name="link_1">', '<link name="link_2">', "no link_1 with a mesh"),
        ("</robot>", "", "broken XML"),
    ],
)
def test_bad_objects_are_named(tmp_path, old, new, message):
    captra(tmp_path)
    path = tmp_path / f"urdf/laptop/{OBJECTS[0]}/mobility.urdf"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(CaperError, match=message):
        CaptraDataset(tmp_path, "laptop", "train")[0]


def test_meshes_without_faces_are_named(tmp_path):
    captra(tmp_path)
    path = tmp_path / f"urdf/laptop/{OBJECTS[0]}/textured_objs/part-1.obj"
    for content, message in (
        ("v 0 0 0\n", "link_1: a mesh has no faces"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", r"part-1\.obj"),
    ):
        path.write_text(content)
        with pytest.raises(CaperError, match=message):
            CaptraDataset(tmp_path, "laptop", "train")[0]


def test_roots_it_does_not_have(tmp_path):
    captra(tmp_path)
    with pytest.raises(CaperError, match="unknown CAPTRA category 'box'"):
        CaptraDataset(tmp_path, "box")
    with pytest.raises(CaperError, match=r"lacks urdf/drawers/"):
        CaptraDataset(tmp_path, "drawer")
    with pytest.raises(CaperError, match="unknown split of CAPTRA 'val'"):
        CaptraDataset(tmp_path, "laptop", "val")
    (tmp_path / "render_seq").rename(tmp_path / "elsewhere")
    with pytest.raises(CaperError, match="split 'test' holds no frame of 'laptop'"):
        CaptraDataset(tmp_path, "laptop", "test")


def test_motions_of_the_tests_are_those_of_the_conventions():
    """A positive state opens: the lid leans back, drawers come out, temples fold inwards."""
    lid = motions(LAPTOP, [0.5])[1] @ [0, 0.5, -0.4, 1]
    assert lid[2] < -0.5
    assert motions(DRAWER, [0.1] * 3)[2][2, 3] == pytest.approx(0.1)
    temples = motions(EYEGLASSES, [0.3, 0.3])[1:]
    left, right = temples[0] @ [-0.65, 0, -1, 1], temples[1] @ [0.65, 0, -1, 1]
    assert left[0] > -0.65 and right[0] < 0.65
