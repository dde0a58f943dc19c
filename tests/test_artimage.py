"""The ArtImage reader against ground truth that another program computed from the same files."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.category import Category, Joint
from caper_jax.data import open_dataset
from caper_jax.data.artimage import TEST_OBJECTS, ArtImageDataset
from caper_jax.data.artimage_models import read_model
from caper_jax.data.schema import validate
from caper_jax.errors import CaperError

SAMPLES = ("laptop", "drawer", "dishwasher")


@pytest.fixture(scope="module")
def root(shared_data):
    return shared_data / "artimage_sample"


@pytest.fixture(scope="module", params=SAMPLES)
def name(request):
    if request.param not in categories.names():
        pytest.skip(f"no category {request.param}")
    return request.param


@pytest.fixture(scope="module")
def dataset(root, name):
    return open_dataset("artimage", root, name)


@pytest.fixture(scope="module")
def frames(dataset):
    return [dataset[i] for i in range(len(dataset))]


@pytest.fixture(scope="module")
def truth(root, name):
    with np.load(root / "truth.npz") as file:
        return {
            key.partition("/")[2]: file[key] for key in file.files if key.startswith(f"{name}/")
        }


def test_every_annotation_is_a_frame(root, name, dataset, truth):
    assert (dataset.split, dataset.mask_source) == ("all", "annotated part masks")
    assert list(dataset.names) == truth["name"].tolist()
    for split in ("train", "test"):
        listed = open_dataset("artimage", root, name, split)
        assert list(listed.names) == truth["name"][truth["split"] == split].tolist()
        official = open_dataset("artimage", root, name, split, official_split=True)
        assert list(official.names) == list(listed.names)


@pytest.mark.parametrize(
    ("field", "key", "tolerance"),
    [
        ("rotation", "R", 1e-5),
        ("translation", "t", 1e-5),
        ("size", "size", 1e-4),
        ("box_center", "box_centre", 1e-4),
        ("joint_axis", "joint_axis", 1e-5),
        ("joint_pivot", "joint_pivot", 1e-5),
        ("joint_state", "joint_state", 1e-5),
    ],
)
def test_ground_truth_agrees_with_an_independent_program(frames, truth, field, key, tolerance):
    expected = truth[key]
    if truth["joint_type"] == "revolute":
        # The file's axis is the one about which the child turns by minus the state.
        expected = {"joint_axis": -expected, "joint_state": np.radians(expected)}.get(key, expected)
    found = np.stack([getattr(frame.truth, field) for frame in frames])
    np.testing.assert_allclose(found, expected, atol=tolerance, rtol=0)


def test_visible_pixels_are_those_of_the_masks(frames, truth):
    np.testing.assert_array_equal([frame.visible for frame in frames], truth["pixels"])


def test_frames_keep_the_conventions(dataset, frames):
    for frame in frames:
        validate(frame, dataset.category)
        assert frame.points.shape == (1024, 3)
        assert frame.visible.sum() == frame.mask.sum()


def test_points_lie_in_the_boxes_of_their_parts(frames):
    """Labels, depth, intrinsics and poses belong together (mm depth of objects of 1 m)."""
    for frame in frames:
        pose = frame.truth
        rotation, shift = pose.rotation[frame.labels], pose.translation[frame.labels]
        local = np.einsum("nji,nj->ni", rotation, frame.points - shift)
        excess = np.abs(local - pose.box_center[frame.labels]) - pose.size[frame.labels] / 2
        assert np.mean(np.linalg.norm(np.maximum(excess, 0), axis=-1) < 0.01) > 0.99


def test_positive_states_open(name, frames):
    """Laptop: the lid leans back; dishwasher: the door sinks; drawer: it comes out of the front."""
    pose = frames[0].truth
    middle = pose.box_center[1:] - pose.joint_pivot
    if name == "drawer":
        assert (pose.joint_axis[:, 2] > 0.99).all()
        assert (np.diff(pose.box_center[1:, 1]) > 0).all()
    else:
        motion = np.cross(pose.joint_axis, middle)[0]
        assert motion[2] < 0 if name == "laptop" else motion[1] < 0


def test_frames_can_be_read_from_several_threads(root, frames, name):
    dataset = ArtImageDataset(root, name)
    with ThreadPoolExecutor(4) as pool:
        parallel = list(pool.map(dataset.__getitem__, range(len(dataset))))
    for one, other in zip(parallel, frames, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.truth.rotation, other.truth.rotation)


# Roots of one frame, changed.


def copy_root(root, folder, edit=None, name="laptop"):
    """A root of frame 000000, whose annotation ``edit`` may change."""
    home = folder / name
    shutil.copytree(root / name / "urdf", home / "urdf")
    shutil.copy(root / "camera_intrinsic.json", folder)
    for kind in ("annotations", "depth", "category_mask"):
        (home / "train" / kind).mkdir(parents=True)
    for kind in ("depth", "category_mask"):
        shutil.copy(root / name / "train" / kind / "000000.png", home / "train" / kind)
    annotation = json.loads((root / name / "train/annotations/000000.json").read_text())
    if edit is not None:
        edit(annotation)
    (home / "train/annotations/000000.json").write_text(json.dumps(annotation))
    (home / "train.txt").write_text("000000.json\n")
    return folder


@pytest.fixture(scope="module")
def first(root):
    return ArtImageDataset(root, "laptop")[0]


def links(annotation):
    return annotation["instances"][0]["links"]


def assert_same_truth(found, expected, tolerance=1e-5):
    for field in vars(expected):
        np.testing.assert_allclose(
            getattr(found, field), getattr(expected, field), atol=tolerance, rtol=0, err_msg=field
        )


def test_links_may_come_in_any_order_and_without_state(root, first, tmp_path):
    def edit(annotation):
        links(annotation).reverse()
        links(annotation)[0].pop("state")

    assert_same_truth(
        ArtImageDataset(copy_root(root, tmp_path, edit), "laptop")[0].truth, first.truth
    )


def test_depth_in_three_channels(root, first, tmp_path):
    copy_root(root, tmp_path)
    path = tmp_path / "laptop/train/depth/000000.png"
    depth = np.asarray(Image.open(path))
    colour = np.stack([depth % 256, depth // 256, np.zeros_like(depth)], axis=-1)  # R, G, B
    Image.fromarray(colour.astype(np.uint8)).save(path)
    np.testing.assert_array_equal(ArtImageDataset(tmp_path, "laptop")[0].depth, first.depth)


def test_an_image_without_depth_has_no_points(root, tmp_path):
    copy_root(root, tmp_path)
    path = tmp_path / "laptop/train/depth/000000.png"
    Image.fromarray(np.zeros((640, 640), np.uint16)).save(path)
    assert ArtImageDataset(tmp_path, "laptop")[0].points.shape == (0, 3)


def test_the_official_split_goes_by_object_and_list(root, tmp_path):
    copy_root(root, tmp_path)
    copied = ArtImageDataset(tmp_path, "laptop", "train", official_split=True)
    assert list(copied.names) == ["000000"]
    path = tmp_path / "laptop/train/annotations/000000.json"
    text = path.read_text()
    path.write_text(text.replace('"urdf_id": 913329', f'"urdf_id": {TEST_OBJECTS["laptop"][0]}'))
    assert path.read_text() != text
    with pytest.raises(CaperError, match="split 'train' holds no frame"):
        ArtImageDataset(tmp_path, "laptop", "train", official_split=True)
    # There is no test.txt: the objects alone decide.
    assert len(ArtImageDataset(tmp_path, "laptop", "test", official_split=True)) == 1
    with pytest.raises(CaperError, match="official split of artimage has train and test of"):
        ArtImageDataset(tmp_path, "laptop", official_split=True)
    with pytest.raises(CaperError, match="'reartmix' has no official split"):
        open_dataset("reartmix", tmp_path, "box", "test", official_split=True)


def set_transformation(value):
    def edit(annotation):
        links(annotation)[1]["transformation"] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda a: a["instances"][0].update(urdf_id=77), "no object 77"),
        (lambda a: links(a).pop(), "a link lacks 1"),
        (lambda a: links(a)[0].pop("transformation"), "lacks 'transformation'"),
        (lambda a: links(a)[0].pop("link_category_id"), "lacks 'link_category_id'"),
        (set_transformation(np.diag([1, 1, -1, 1]).tolist()), "determinant -1"),
        (set_transformation(np.diag([2, 2, 2, 1]).tolist()), "must carry no scale"),
        (set_transformation([[1, 2], [3]]), "must be 4x4"),
        (lambda a: links(a)[1].update(state=0.1297), "state of link 1 is 0.1297, but .* 7.432 deg"),
        (lambda a: links(a)[1].update(state="open"), "state of link 1 must be a number"),
        (lambda a: a.update(depth_path="depth/000009.png"), r"000009\.png: no such file"),
        (lambda a: a.update(depth_path=3), "depth_path must be text"),
        (lambda a: a.update(width=320), "640 x 640, but .* width 320"),
        (lambda a: a["instances"].append(a["instances"][0]), "2 instances, expected exactly one"),
        (lambda a: a.pop("height"), "it lacks 'height'"),
        (lambda a: a["instances"][0].pop("links"), "the instance lacks 'links'"),
    ],
)
def test_bad_annotations_are_named(root, tmp_path, edit, message):
    dataset = ArtImageDataset(copy_root(root, tmp_path, edit), "laptop")
    with pytest.raises(CaperError, match=message):
        dataset[0]


URDF = "913329/mobility_for_unity_align.urdf"


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (URDF, "revolute", "prismatic", r"joints .* are .*prismatic.*laptop has"),
        (URDF, 'axis xyz="0 1 0"', 'axis xyz="0 1"', "expected three numbers, got '0 1'"),
        (URDF, 'axis xyz="0 1 0"', 'axis xyz="0 0 0"', "axis must not be zero"),
        (URDF, 'axis xyz="0 1 0"', 'axis xyz="0 0 1"', "axis of joint 1 lies across"),
        (URDF, "<axis", "<axes", "lacks <axis xyz"),
        (URDF, "</robot>", "", "broken XML"),
        (URDF, 'name="joint_1"', 'name="hinge"', "must tell which link it moves"),
        ("rest_state.json", '"state": -0.6', '"angle": -0.6', "913329, part 1: needs a number"),
        ("rest_state.json", "-0.600276771", '"shut"', "913329, part 1: needs a number"),
        ("913329/part_point_sample/1.xyz", "0", "zero", r"1\.xyz: lines must hold three numbers"),
    ],
)
def test_bad_models_are_named(root, tmp_path, file, old, new, message):
    path = copy_root(root, tmp_path) / "laptop/urdf" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(CaperError, match=message):
        ArtImageDataset(tmp_path, "laptop")[0]


def test_missing_files_are_named(root, tmp_path):
    copy_root(root, tmp_path)
    (tmp_path / "laptop/urdf/913329/part_point_sample/0.xyz").write_text("\n")
    with pytest.raises(CaperError, match=r"0\.xyz: holds no points"):
        ArtImageDataset(tmp_path, "laptop")[0]
    (tmp_path / "laptop/urdf/913329/part_point_sample/0.xyz").unlink()
    with pytest.raises(CaperError, match=r"0\.xyz: no such file"):
        ArtImageDataset(tmp_path, "laptop")[0]
    (tmp_path / "laptop/train.txt").write_text("000000.json 000007.json 000008.json")
    with pytest.raises(CaperError, match=r"train\.txt: names '000007\.json'.*2 such lines"):
        ArtImageDataset(tmp_path, "laptop", "train")
    with pytest.raises(CaperError, match=r"no split 'val' \(no val\.txt\); it has all, train"):
        ArtImageDataset(tmp_path, "laptop", "val")
    with pytest.raises(CaperError, match=r"lacks box/train/\); it holds laptop"):
        ArtImageDataset(tmp_path, "box")
    (tmp_path / "camera_intrinsic.json").unlink()
    with pytest.raises(CaperError, match=r"camera_intrinsic\.json: no such file"):
        ArtImageDataset(tmp_path, "laptop")


# Models: facing another way, other orders, deep trees, the extra transform of scissors.


def write_object(folder, urdf_id, joints, points, rest_states, base=("0 0 0", "0 0 0")):
    """joints: (child, type, parent, origin, axis, limits) in the axes of the URDF."""
    home = folder / str(urdf_id)
    (home / "part_point_sample").mkdir(parents=True)
    for k, cloud in enumerate(points):
        np.savetxt(home / f"part_point_sample/{k}.xyz", cloud, "%.9f")
    for file, (xyz, rpy) in (
        ("mobility_for_unity_align.urdf", base),
        ("mobility_for_unity.urdf", ("0.1 0.2 0.3", "0.3 -0.2 0.1")),
    ):
        lines = [
            f'<joint name="joint_0" type="fixed"><origin xyz="{xyz}" rpy="{rpy}"/>'
            '<parent link="base"/><child link="0"/></joint>'
        ]
        lines += [
            f'<joint name="joint_{child}" type="{kind}"><origin xyz="{text(origin)}"/>'
            f'<axis xyz="{text(axis)}"/><parent link="{parent}"/><child link="{child}"/>'
            f'<limit lower="{limits[0]}" upper="{limits[1]}"/></joint>'
            for child, kind, parent, origin, axis, limits in joints
        ]
        (home / file).write_text(f"<robot>{''.join(lines)}</robot>")
    content = {str(urdf_id): {str(k): {"state": s} for k, s in rest_states.items()}}
    (folder / "rest_state.json").write_text(json.dumps(content))


def text(vector):
    return " ".join(str(float(value)) for value in vector)


def urdf_axes(vector):
    """Coordinates of the points -> those of the URDF."""
    return np.asarray(vector, float)[[2, 0, 1]]


def category_of(name, types, parents):
    parts = len(types) + 1
    return Category(
        name=name,
        parts=tuple(f"part {k}" for k in range(parts)),
        joints=tuple(
            Joint(kind, parent, (-1.0, 2.0)) for kind, parent in zip(types, parents, strict=True)
        ),
        directions=("x", "z"),
        directions_reason="test",
        unit=1.0,
        mean_size=((1.0,) * 3,) * parts,
        mean_center=((0.0,) * 3,) * parts,
    )


def cuboid(center, size):
    signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    return np.array(center) + signs * np.array(size) / 2


def to_file(model, k, points):
    """Our rest frame -> the raw frame of part k."""
    return points @ model.to_file_rotation[k].T + model.to_file_shift[k]


def test_rest_transforms_compose_along_a_deep_tree(tmp_path):
    """A chain of three; rest poses and joints against SciPy."""
    rng = np.random.default_rng(3)
    points = [rng.normal(size=(50, 3)) for _ in range(4)]
    kinds, parents = ("revolute", "prismatic", "revolute"), (0, 1, 2)
    pivots, axes = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    states = (30.0, 0.4, -50.0)
    joints = [
        # Origins count from the parent's joint, but for joints on the root.
        (
            j + 1,
            kinds[j],
            str(parents[j]),
            urdf_axes(pivots[j] - (pivots[j - 1] if j else 0)),
            urdf_axes(2 * axes[j]),
            (-1, 1),
        )
        for j in range(3)
    ]
    write_object(tmp_path, 5, joints, points, dict(enumerate(states, start=1)))
    model = read_model(tmp_path, 5, category_of("chain", kinds, parents))

    poses = [np.eye(4)]
    for j in range(3):
        motion = np.eye(4)
        if kinds[j] == "revolute":
            turn = Rotation.from_rotvec(-np.radians(states[j]) * axes[j])
            motion[:3, :3] = turn.as_matrix()
            motion[:3, 3] = pivots[j] - turn.apply(pivots[j])
        else:
            motion[:3, 3] = states[j] * axes[j]
        poses.append(poses[-1] @ motion)
    rest = [cloud @ pose[:3, :3].T + pose[:3, 3] for cloud, pose in zip(points, poses, strict=True)]
    everything = np.concatenate(rest)
    origin = (everything.min(0) + everything.max(0)) / 2
    for k in range(4):
        np.testing.assert_allclose(to_file(model, k, rest[k] - origin), points[k], atol=1e-8)
        np.testing.assert_allclose(model.size[k], np.ptp(rest[k], axis=0), atol=1e-8)
    signs = np.array([-1, 1, -1])
    for j in range(3):
        parent = poses[parents[j]]
        np.testing.assert_allclose(model.axis[j], signs[j] * parent[:3, :3] @ axes[j], atol=1e-9)
        pivot = parent[:3, :3] @ pivots[j] + parent[:3, 3] - origin
        np.testing.assert_allclose(model.pivot[j], pivot, atol=1e-9)


def test_an_object_without_rest_states_is_at_rest(tmp_path):
    joint = (1, "revolute", "base", (0, 0, 0), urdf_axes((1, 0, 0)), (0, 1))
    write_object(tmp_path, 5, [joint], [cuboid((0, 0, 0), (1, 1, 1))] * 2, {})
    (tmp_path / "rest_state.json").write_text("{}")
    model = read_model(tmp_path, 5, category_of("pair", ("revolute",), (0,)))
    np.testing.assert_allclose(model.to_file_rotation, [np.eye(3)] * 2)


@pytest.mark.parametrize("quarters", range(4))
def test_drawers_facing_any_side_numbered_in_any_order(tmp_path, quarters):
    """Out of the front is z, the lowest drawer comes first, positive opens."""
    turn = Rotation.from_rotvec([0, quarters * np.pi / 2, 0]).as_matrix()
    ours = [cuboid((0, 0, -0.05), (1.0, 1.4, 0.9))]
    ours += [cuboid((0, y, 0.04), (0.9, 0.3, 0.92)) for y in (-0.45, 0.0, 0.45)]
    order = [0, 3, 1, 2]  # link k of the file is our part order[k]
    points = [ours[part] @ turn.T for part in order]
    joints = [
        # The second slides against its axis: its states are negative.
        (k, "prismatic", "0", urdf_axes((0, 0, 0)), urdf_axes(sense * turn[:, 2]), limits)
        for k, sense, limits in ((1, 1, (0, 0.5)), (2, -1, (-0.5, 0)), (3, 1, (0, 0.5)))
    ]
    write_object(tmp_path, 5, joints, points, {1: 0.0, 2: 0.0, 3: 0.0})
    model = read_model(tmp_path, 5, category_of("drawer", ("prismatic",) * 3, (0, 0, 0)))
    assert model.links == (0, 2, 3, 1)
    np.testing.assert_array_equal(model.signs, [-1, 1, 1])
    np.testing.assert_allclose(model.axis, [[0, 0, 1]] * 3, atol=1e-12)
    whole = np.concatenate(ours)
    origin = (whole.min(0) + whole.max(0)) / 2
    for part in range(4):
        np.testing.assert_allclose(
            to_file(model, part, ours[part] - origin), points[order.index(part)], atol=1e-8
        )


@pytest.mark.parametrize("quarters", range(4))
def test_eyeglasses_facing_any_side(tmp_path, quarters):
    """Lenses to z, the temple at -x first, positive folds inwards."""
    turn = Rotation.from_rotvec([0, quarters * np.pi / 2, 0]).as_matrix()
    ours = [cuboid((0, 0, 0.7), (1.4, 0.5, 0.1))]
    ours += [cuboid((x, 0, 0), (0.05, 0.1, 1.3)) for x in (-0.7, 0.7)]
    points = [ours[part] @ turn.T for part in (0, 2, 1)]
    joints = [
        (k, "revolute", "0", urdf_axes(turn @ (x, 0, 0.65)), urdf_axes((0, 1, 0)), (0, 1.5))
        for k, x in ((1, 0.7), (2, -0.7))
    ]
    write_object(tmp_path, 5, joints, points, {1: 0.0, 2: 0.0})
    model = read_model(tmp_path, 5, category_of("eyeglasses", ("revolute",) * 2, (0, 0)))
    assert model.links == (0, 2, 1)
    np.testing.assert_allclose(model.axis, [[0, -1, 0], [0, 1, 0]], atol=1e-12)
    # Folding moves the end of the temple at -x towards +x, and the other one to meet it.
    motion = np.cross(model.axis, model.center[1:] - model.pivot)
    assert motion[0, 0] > 0 > motion[1, 0]


def test_objects_that_face_no_side_are_refused(tmp_path):
    points = [cuboid((0, 0, 0), (1, 1, 1)), cuboid((0, 0.8, 0.01), (1, 0.1, 1))]
    joint = (1, "revolute", "0", (0, 0, 0), urdf_axes((1, 0, 0)), (0, 1))
    write_object(tmp_path, 5, [joint], points, {1: 0.0})
    with pytest.raises(CaperError, match="cannot tell the front of this laptop"):
        read_model(tmp_path, 5, categories.get("laptop"))


def scissors(opening):
    """Blades along +x, crossed at the origin, with wide handles behind; turned about y."""
    blade = np.concatenate(
        [cuboid((0.5, 0, 0), (1.0, 0.02, 0.05)), cuboid((-0.6, 0, 0.2), (0.4, 0.04, 0.3))]
    )
    parts = []
    for side in (1, -1):
        turn = Rotation.from_rotvec([0, -side * np.radians(opening / 2), 0])
        parts.append(turn.apply(blade * (1, 1, -side)))
    return parts


@pytest.mark.parametrize(("quarters", "sense"), [(0, 1), (1, 1), (2, -1), (3, -1)])
def test_scissors_are_moved_by_their_base_joints_and_turned(tmp_path, quarters, sense):
    """The extra transform against SciPy's from_euler, as public loaders call it."""
    category = category_of("scissors", ("revolute",), (0,))
    turn = Rotation.from_euler("YX", [quarters * 90, 90 * (quarters % 2)], degrees=True).as_matrix()
    change = np.eye(4)
    aligned, raw = np.array([0.4, 0.1, -0.2]), np.array([0.3, -0.2, 0.1])
    difference = [-(aligned - raw)[0], (aligned - raw)[2], -(aligned - raw)[1]]
    change[:3, :3] = Rotation.from_euler("ZXY", difference).as_matrix()
    shift = np.array([0.5, 0.3, 0.7]) - [0.1, 0.2, 0.3]
    change[:3, 3] = [-shift[0], shift[2], -shift[1]]

    ours = scissors(20)
    whole = np.concatenate(ours)
    origin = (whole.min(0) + whole.max(0)) / 2
    inverse = np.linalg.inv(change)
    points = [(part @ turn.T) @ inverse[:3, :3].T + inverse[:3, 3] for part in ours]
    # Part 1 lies at -z: it opens about +y, and the files turn it by minus the state.
    axis = inverse[:3, :3] @ turn @ (0, sense, 0)
    joint = (1, "revolute", "0", urdf_axes(inverse[:3, 3]), urdf_axes(axis), (0, 1))
    base = ("0.5 0.3 0.7", text(aligned))
    write_object(tmp_path, 5, [joint], points, {1: 0.0}, base)
    model = read_model(tmp_path, 5, category)
    np.testing.assert_allclose(model.axis, [[0, 1, 0]], atol=1e-9)
    assert model.signs == -sense
    for k in range(2):
        np.testing.assert_allclose(to_file(model, k, (ours[k] - origin)), points[k], atol=1e-7)
    np.testing.assert_allclose(model.pivot, [-origin], atol=1e-9)
