"""The estimator: consistent poses, exact symmetries, transformations of JAX, clear errors."""

from __future__ import annotations

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.tiny import network, random_like, random_variables
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax import estimator as module
from caper_jax.articulation.category import Joint
from caper_jax.cli import demo
from caper_jax.config import to_dict
from caper_jax.data.clouds import cloud_from_depth
from caper_jax.data.images import read_depth, read_intrinsics, read_mask
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator, estimate, load, shipped_weights
from caper_jax.geometry.frames import view_rotation
from caper_jax.models.files import flatten, write_model

BOX = categories.get("box")
# A door on a cabinet, and a drawer in a drawer: a deeper tree, and lengths beside angles.
CABINET = dataclasses.replace(
    BOX,
    name="cabinet",
    parts=("body", "door", "drawer"),
    joints=(Joint("revolute", 0, (0.0, 1.5)), Joint("prismatic", 1, (0.0, 0.1))),
    directions=("y", "z"),
    mean_size=((0.3, 0.3, 0.2), (0.3, 0.2, 0.02), (0.25, 0.05, 0.15)),
    mean_center=((0.0, 0.0, 0.0), (0.0, 0.0, 0.11), (0.0, 0.1, 0.0)),
    symmetries=(),
)


def clouds(batch, count=64, seed=0):
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-0.2, 0.2, (batch, 1, 3)) + [0, 0, 0.8]
    return (rng.uniform(-0.15, 0.15, (batch, count, 3)) + shift).astype(np.float32)


@pytest.fixture(scope="module")
def cabinet():
    config = network("fast", pool_first=True)
    return Estimator(CABINET, config, random_variables(CABINET, config))


def test_poses_follow_the_joints(cabinet):
    points = clouds(4)
    found = cabinet(points)
    pose = jax.tree.map(lambda values: np.asarray(values, np.float64), found.pose)
    identity = np.tile(np.eye(3), (4, 3, 1, 1))
    np.testing.assert_allclose(pose.rotation @ pose.rotation.swapaxes(-1, -2), identity, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(pose.rotation), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(pose.joint_axis, axis=-1), 1.0, atol=1e-5)
    assert (pose.size > 0).all()

    root = Rotation.from_matrix(pose.rotation[:, 0])
    turn = Rotation.from_rotvec(pose.joint_axis[:, 0] * pose.joint_state[:, :1])
    pivot = pose.joint_pivot[:, 0]
    door = root.apply(pivot - turn.apply(pivot)) + pose.translation[:, 0]
    np.testing.assert_allclose(pose.rotation[:, 1], (root * turn).as_matrix(), atol=1e-5)
    np.testing.assert_allclose(pose.translation[:, 1], door, atol=1e-5)
    slide = pose.joint_axis[:, 1] * pose.joint_state[:, 1:]
    np.testing.assert_allclose(pose.rotation[:, 2], pose.rotation[:, 1], atol=1e-5)
    np.testing.assert_allclose(pose.translation[:, 2], (root * turn).apply(slide) + door, atol=1e-5)

    np.testing.assert_array_equal(found.points, points)
    assert found.labels.shape == (4, 64) and found.labels.dtype == jnp.int32
    assert set(np.unique(found.labels)) <= {-1, 0, 1, 2}
    assert ((found.confidence > 0) & (found.confidence < 1)).all()
    assert not found.degenerate.any()


def test_lengths_are_meters_whatever_the_network_unit(cabinet):
    """With twice the unit, a cloud of half the size is the same to the networks."""
    double = Estimator(
        dataclasses.replace(
            CABINET,
            unit=2 * CABINET.unit,
            mean_size=tuple(tuple(x / 2 for x in row) for row in CABINET.mean_size),
            mean_center=tuple(tuple(x / 2 for x in row) for row in CABINET.mean_center),
        ),
        cabinet.network,
        cabinet.variables,
    )
    one, half = cabinet(clouds(4)).pose, double(clouds(4) / 2).pose
    for name in ("translation", "size", "box_center", "joint_pivot"):
        np.testing.assert_allclose(
            2 * getattr(half, name), getattr(one, name), rtol=1e-4, atol=1e-5, err_msg=name
        )
    np.testing.assert_allclose(half.rotation, one.rotation, atol=1e-5)
    np.testing.assert_allclose(half.joint_axis, one.joint_axis, atol=1e-5)
    states = half.joint_state * np.array([1.0, 2.0])  # radians stay, meters halve
    np.testing.assert_allclose(states, one.joint_state, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("degrees", [90.0, 180.0, -37.0])
def test_a_camera_that_is_not_level_is_no_matter_where_it_is_named(cabinet, degrees):
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()  # x right, y down: clockwise
    rolled = Estimator(CABINET.rolled(degrees), cabinet.network, cabinet.variables)
    one, other = cabinet(clouds(4)), rolled((clouds(4) @ turn.T).astype(np.float32))
    np.testing.assert_allclose(other.pose.rotation, turn @ np.asarray(one.pose.rotation), atol=2e-4)
    np.testing.assert_allclose(
        other.pose.translation, np.asarray(one.pose.translation) @ turn.T, atol=1e-4
    )
    for name in ("size", "box_center", "joint_axis", "joint_pivot", "joint_state"):
        expected = getattr(one.pose, name)
        np.testing.assert_allclose(getattr(other.pose, name), expected, atol=2e-4, err_msg=name)
    with pytest.raises(CaperError, match="camera roll must be finite, in degrees, got nan"):
        CABINET.rolled(float("nan"))


def test_a_turn_of_the_camera_turns_the_poses_and_nothing_else(cabinet):
    """Wherever in the image the same view of an object stands, it is found the same."""
    points = clouds(4)
    view = np.asarray(view_rotation(jnp.asarray(points)))
    ahead = np.einsum("bij,bnj->bni", view, points)  # each cloud's mean on the optical axis
    toward = np.array([[0.3, -0.2, 1.0], [-0.5, 0.1, 1.0], [0.0, 0.6, 1.0], [0.1, 0.1, 1.0]])
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    around = np.cross([0.0, 0.0, 1.0], toward)  # the short way from the axis: without a roll
    angle = np.arcsin(np.linalg.norm(around, axis=-1, keepdims=True))
    around *= angle / np.linalg.norm(around, axis=-1, keepdims=True)
    camera = Rotation.from_rotvec(around).as_matrix()
    one, turned = cabinet(ahead), cabinet(np.einsum("bij,bnj->bni", camera, ahead))
    np.testing.assert_allclose(
        turned.pose.rotation, camera[:, None] @ np.asarray(one.pose.rotation), atol=2e-4
    )
    np.testing.assert_allclose(
        turned.pose.translation,
        np.einsum("bij,bkj->bki", camera, one.pose.translation),
        atol=1e-4,
    )
    for name in ("size", "box_center", "joint_axis", "joint_pivot", "joint_state"):
        np.testing.assert_allclose(
            getattr(turned.pose, name), getattr(one.pose, name), atol=2e-4, err_msg=name
        )


def test_any_number_of_points_without_recompiling(cabinet):
    batch = clouds(1, 64)
    whole = cabinet(batch)
    compiled = cabinet._jitted._cache_size()
    for count in (48, 63, 65, 1000):
        found = cabinet(clouds(1, count)[0])
        assert found.pose.rotation.shape == (3, 3, 3)
        assert found.points.shape == (64, 3) and found.labels.shape == (64,)
        assert found.confidence.shape == (2,) and found.degenerate.shape == ()
    assert cabinet._jitted._cache_size() == compiled
    single = cabinet(batch[0].tolist())  # lists will do
    jax.tree.map(lambda one, many: np.testing.assert_array_equal(one, many[0]), single, whole)


def test_the_order_of_the_points_does_not_matter(cabinet):
    """All of it: poses are the same, and each point keeps its part."""
    points = clouds(4)
    shuffle = np.random.default_rng(1).permutation(points.shape[1])
    one, other = cabinet(points), cabinet(points[:, shuffle])
    np.testing.assert_array_equal(other.points, points[:, shuffle])
    np.testing.assert_array_equal(other.labels, np.asarray(one.labels)[:, shuffle])
    assert len(np.unique(one.labels)) > 1
    close = partial(np.testing.assert_allclose, atol=1e-5)
    jax.tree.map(close, other.pose, one.pose)
    # A larger cloud is sampled the same, too.
    many = clouds(1, 1000)[0]
    mixed = np.random.default_rng(1).permutation(many)
    jax.tree.map(close, cabinet(mixed), cabinet(many))


def test_points_without_a_measurement_are_left_out(cabinet):
    cloud = clouds(1, 60)[0]
    holes = np.insert(cloud, [0, 10, 59], np.nan, axis=0)
    holes = np.insert(holes, [5, 40], 0.0, axis=0)
    holes = np.insert(holes, [20], np.inf, axis=0)
    one, other = cabinet(cloud), cabinet(holes)
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize(
    ("points", "named"),
    [
        (np.zeros((0, 3)), "only 0 of 0 points"),
        (np.zeros((0, 64, 3)), "points"),
        (clouds(1, 15)[0], "only 15 of 15 points"),
        (np.full((64, 3), np.nan), "only 0 of 64 points"),
        (clouds(2) * [[[1]], [[np.nan]]], r"only 0 of 64 points in points\[1\]"),
        (np.zeros((64, 4)), r"\(64, 4\)"),
        (np.zeros((1, 1, 64, 3)), r"\(1, 1, 64, 3\)"),
        (clouds(1)[0] * 1000, "millimeters"),
        (clouds(1)[0] * [1, -1, -1], "points"),
        ([clouds(1, 20)[0], clouds(1, 30)[0]], "points"),
        (np.full((64, 3), "1.0"), "points"),
    ],
)
def test_bad_clouds_are_named(cabinet, points, named):
    with pytest.raises(CaperError, match=named):
        cabinet(points)


@pytest.mark.parametrize("shape", [(3,), (15, 3), (2, 64, 2)])
def test_bad_clouds_are_named_inside_jit_too(cabinet, shape):
    with pytest.raises(CaperError, match="points"):
        jax.eval_shape(cabinet, jax.ShapeDtypeStruct(shape, jnp.float32))


def test_jit_and_vmap_of_the_estimator(cabinet):
    """Inside a transformation arrays go through as they are, and the result is the same."""
    points = clouds(3)
    expected = cabinet(points)
    close = partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4)
    jax.tree.map(close, jax.jit(jax.vmap(cabinet))(points), expected)
    shapes = jax.eval_shape(cabinet, jnp.zeros((2, 50, 3)))
    assert shapes.labels.shape == (2, 50)


def test_vmap_over_models_equals_one_by_one(cabinet):
    points = clouds(2)
    models = [random_variables(CABINET, cabinet.network, seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *models)
    function = jax.jit(jax.vmap(cabinet.function, in_axes=(0, None)))
    together = function(stacked, points)
    for i, model in enumerate(models):
        alone = Estimator(CABINET, cabinet.network, model)
        alone._jitted = cabinet._jitted  # the same function, compiled once
        jax.tree.map(
            lambda many, one, i=i: np.testing.assert_allclose(many[i], one, rtol=1e-3, atol=1e-4),
            together,
            alone(points),
        )


@pytest.mark.parametrize("encoder", ["fast", "hs"])
def test_gradients_are_finite_differences(encoder):
    config = network(encoder, pool_first=encoder == "fast")
    variables = random_variables(BOX, config)
    with jax.enable_x64(True):
        variables = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), variables)
        points = jnp.asarray(clouds(1), jnp.float64)
        shapes = jax.eval_shape(partial(estimate, category=BOX, network=config), variables, points)
        rng = np.random.default_rng(1)
        weights = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), shapes.pose)

        def total(variables, points):
            pose = estimate(variables, points, BOX, config).pose
            terms = jax.tree.map(lambda w, values: (w * values).sum(), weights, pose)
            return sum(jax.tree.leaves(terms))

        differentiate = jax.jit(jax.value_and_grad(total, (0, 1)))
        arguments = variables, points
        _, gradients = differentiate(*arguments)
        finite = jax.tree.map(lambda leaf: np.isfinite(leaf).all(), gradients)
        assert all(jax.tree.leaves(finite))
        for which, step in ((0, 1e-6), (1, 1e-7)):
            toward = (
                random_like(arguments[which], seed=2)
                if which == 0
                else rng.normal(size=points.shape)
            )
            ends = []
            for sign in (1, -1):
                moved = list(arguments)
                moved[which] = jax.tree.map(
                    lambda x, d, s=sign * step: x + s * d, arguments[which], toward
                )
                ends.append(differentiate(*moved)[0])
            slope = jax.tree.map(lambda g, d: (g * d).sum(), gradients[which], toward)
            expected = (ends[0] - ends[1]) / (2 * step)
            np.testing.assert_allclose(sum(jax.tree.leaves(slope)), expected, rtol=1e-4)


@pytest.fixture
def model(tmp_path):
    """A folder as training writes it."""
    config = network()
    card = {"category": "box", "run": {"network": to_dict(config)}}
    write_model(tmp_path / "model", random_variables(BOX, config), card)
    return tmp_path / "model"


def change_card(folder, **values):
    card = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps(card | values))


def test_load_gives_back_the_model(model):
    found = load("box", model)
    assert found.category is BOX and found.network == network()
    assert found.card["category"] == "box"
    wanted = flatten(random_variables(BOX, network()))
    for name, leaf in flatten(found.variables).items():
        assert leaf.dtype == jnp.float32
        np.testing.assert_allclose(leaf, wanted[name], rtol=2e-3, atol=1e-3, err_msg=name)
    assert load("box", str(model)).network == network()


def test_load_without_weights_takes_the_shipped_ones(model, monkeypatch):
    monkeypatch.setattr(module, "shipped_weights", lambda: model.parent)
    with pytest.raises(CaperError, match=r"no weights for 'box' ship .* for model\)"):
        load("box")
    model.rename(model.parent / "box")
    assert load("box").category is BOX


def test_load_names_what_is_missing(model, tmp_path):
    with pytest.raises(CaperError, match=r"category 'bxo'; did you mean 'box'"):
        load("bxo", model)
    with pytest.raises(CaperError, match=r"nowhere is not a model directory: it has no model.json"):
        load("box", tmp_path / "nowhere")
    with pytest.raises(CaperError, match=r"model holds a model of 'box', not 'laptop'"):
        load("laptop", model)
    (model / "weights.npz").unlink()
    with pytest.raises(CaperError, match=r"model is not a model directory: it has no weights.npz"):
        load("box", model)


def test_load_names_damaged_files(model):
    whole = (model / "weights.npz").read_bytes()
    for damage in (whole[: len(whole) // 2], b"", whole[:200] + b"\0" * 200 + whole[400:]):
        (model / "weights.npz").write_bytes(damage)
        with pytest.raises(CaperError, match=r"weights.npz"):
            load("box", model)
    (model / "weights.npz").write_bytes(whole)
    (model / "model.json").write_text('{"category": "box", ')
    with pytest.raises(CaperError, match=r"model.json is not valid JSON"):
        load("box", model)


def test_load_names_cards_that_do_not_fit(model):
    sizes = to_dict(network())
    for run, message in (
        ({}, r"model.json.* lacks run.network"),
        (None, r"model.json.* lacks run.network"),
        ({"network": sizes | {"enccoder": "hs"}}, r"model.json: .*enccoder.*encoder"),
        ({"network": sizes | {"num_points": 0}}, r"model.json"),
        # The weights of one more layer, of other widths, of another encoder.
        (
            {"network": sizes | {"fast": sizes["fast"] | {"blocks": 2}}},
            r"weights.npz does not fit the network in model.json: \S+/encoder/\S+ is absent there",
        ),
        (
            {"network": sizes | {"fast": sizes["fast"] | {"width": 4}}},
            r"weights.npz does not fit .*encoder/BatchNorm_0/mean is \(8,\) there, \(4,\)",
        ),
        ({"network": sizes | {"encoder": "hs"}}, r"weights.npz does not fit"),
    ):
        change_card(model, run=run)
        with pytest.raises(CaperError, match=message):
            load("box", model)


def test_weights_that_no_layer_takes_are_an_error(model):
    """Such weights belong to another network, though this one could run without them."""
    variables = random_variables(BOX, network())
    variables["params"]["root"]["encoder"]["Dense_9"] = {"kernel": np.ones((2, 2), np.float32)}
    write_model(model, variables, json.loads((model / "model.json").read_text()))
    with pytest.raises(CaperError, match=r"Dense_9/kernel is \(2, 2\) there, absent in"):
        load("box", model)


# The models that ship


@pytest.fixture(scope="module")
def laptop():
    return load("laptop")


@pytest.fixture(scope="module")
def plates():
    """[2, 1024, 3]: two plates at right angles, 0.9 m away, with a little noise."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-0.15, 0.15, (2, 1024, 2))
    up = np.arange(1024) % 2 == 0
    x, y = flat[..., 0], np.where(up, -np.abs(flat[..., 1]), 0.0)
    z = np.where(up, 0.15, flat[..., 1])
    cloud = np.stack([x, y + 0.6 * z + 0.1, z + 0.9], -1) + rng.normal(0, 1e-3, (2, 1024, 3))
    return cloud.astype(np.float32)


def test_gradients_of_the_shipped_model(laptop, plates):
    direction = np.random.default_rng(1).normal(size=(1, 1024, 3))
    with jax.enable_x64(True):
        variables = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), laptop.variables)
        cloud = plates[:1].astype(np.float64)

        @jax.jit
        def value(points):
            return laptop.function(variables, points).pose.translation[:, 1].sum()

        slope = float((jax.grad(value)(cloud) * direction).sum())
        step = 1e-7  # small: maxima over points have kinks close by
        ahead, behind = value(cloud + step * direction), value(cloud - step * direction)
        numeric = float(ahead - behind) / (2 * step)
    assert slope == pytest.approx(numeric, rel=1e-3)
    assert abs(slope) > 0.01


@pytest.mark.parametrize("name", ["box", "laptop", "eyeglasses"])
def test_shipped_models_find_the_demo_objects(name, laptop):
    """Unseen instances, rendered with a sensor's noise, as ``caper demo`` shows them.

    box_2 is open by 9 deg only, and its front may be taken for its back: then it is turned by
    180 deg about its vertical, and all else must be right.
    """
    estimator = laptop if name == "laptop" else load(name)
    exchanged = np.diag([-1.0, 1.0, -1.0])
    folders = sorted(demo.demo_folder().glob(f"{name}_*"))
    assert len(folders) == 3
    for folder in folders:
        depth, mask = read_depth(folder / "depth.png"), read_mask(folder / "mask.png")
        cloud = cloud_from_depth(depth, mask, read_intrinsics(folder / "intrinsics.json"))
        pose = jax.tree.map(np.asarray, estimator(cloud.points).pose)
        truth = json.loads((folder / "truth.json").read_text())
        for found, wanted in zip(pose.rotation, truth["rotation"], strict=True):
            turns = [np.eye(3), exchanged] if folder.name == "box_2" else [np.eye(3)]
            off = [Rotation.from_matrix(found.T @ wanted @ turn).magnitude() for turn in turns]
            assert np.degrees(min(off)) < 15, folder.name
        assert np.linalg.norm(pose.translation - truth["translation"], axis=-1).max() < 0.03
        np.testing.assert_allclose(np.degrees(pose.joint_state), truth["joint_state"], atol=10)


def test_every_category_ships_a_model_with_its_card():
    """At most 30 MB together, each saying what it is and how sure it may be."""
    folders = [shipped_weights() / name for name in categories.names()]
    assert sum((folder / "weights.npz").stat().st_size for folder in folders) < 30e6
    for folder in folders:
        card = json.loads((folder / "model.json").read_text())
        assert card["category"] == folder.name
        assert {"run", "steps", "training_seconds_in_all", "hardware", "commit"} <= card.keys()
        assert card["metrics"] and card["calibration"]["frames"] >= 2000


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_with_64_bit_jax_an_estimate_is_of_the_type_of_its_points(dtype):
    box = load("box")
    with jax.enable_x64(True):
        found = jax.eval_shape(
            lambda points: estimate(box.variables, points, BOX, box.network, box.calibration),
            jax.ShapeDtypeStruct((2, 256, 3), dtype),
        )
    kinds = {leaf.dtype for leaf in jax.tree.leaves(found) if leaf.dtype.kind == "f"}
    assert kinds == {np.dtype(dtype)}


def test_points_of_half_precision_are_computed_with_in_float32():
    config = network("fast", pool_first=True)
    variables = random_variables(BOX, config)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (1, 64, 3)) + [0.0, 0.0, 0.7]
    short = jnp.asarray(points, jnp.bfloat16)
    estimated = jax.jit(lambda cloud: estimate(variables, cloud, BOX, config).pose)
    found, expected = estimated(short), estimated(short.astype(jnp.float32))
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), found, expected)
