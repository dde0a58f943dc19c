"""Objects of ArtImage: facing another way, other orders, deep trees, the transform of scissors."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.category import Category, Joint
from caper_jax.articulation.conversions import ArtImageConversion
from caper_jax.data.readers import artimage_models
from caper_jax.errors import CaperError


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
        datasets=categories.get(name).datasets if name in categories.names() else {},
    )


def read_model(folder, urdf_id, category):
    conversion = category.datasets.get("artimage", ArtImageConversion())
    return artimage_models.read_model(folder, str(urdf_id), category, conversion)


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
