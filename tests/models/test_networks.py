"""Heads, voting, changes of frame, the fast encoder, and what both networks must obey."""

from __future__ import annotations

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.networks import normal, variables_of
from _helpers.tiny import network, random_like
from scipy.spatial.transform import Rotation

from caper_jax.config import PRESETS, FastEncoderConfig, HeadConfig, preset
from caper_jax.errors import CaperError
from caper_jax.geometry.frames import canonicalize, rotate, view_rotation
from caper_jax.models.encoders.fast import FastEncoder, local_moments
from caper_jax.models.encoders.features import BlockDense, Features, Level
from caper_jax.models.heads import PointHead, PooledHead, unit_vectors
from caper_jax.models.parts import PartsNetwork, vote
from caper_jax.models.root import RootNetwork


def levels():
    """Features of 12 points: at the points, by nearest row, and by weights."""
    rng = np.random.default_rng(1)
    weights = rng.uniform(size=(2, 12, 4))
    weights /= weights.sum(-1, keepdims=True)
    return Features(
        points=normal(2, 12, 3, seed=1),
        levels=(
            Level(normal(2, 12, 3, seed=2)),
            Level(normal(2, 6, 5, seed=3), jnp.asarray(rng.integers(0, 6, (2, 12)))),
            Level(normal(2, 4, 7, seed=4), weights.astype(np.float32)),
        ),
        shared=normal(2, 6, seed=5),
    )


def concatenated(features):
    """[B, N, C] with every level brought to the points first, as the paper draws it."""
    fine, middle, coarse = features.levels
    rows = [middle.features[b][middle.upsample[b]] for b in range(2)]
    blended = [coarse.upsample[b] @ coarse.features[b] for b in range(2)]
    count = features.points.shape[1]
    shared = np.repeat(features.shared[:, None], count, axis=1)
    return [fine.features, np.stack(rows), np.stack(blended), features.points, shared]


@pytest.mark.parametrize("with_points", [True, False])
def test_block_dense_is_a_dense_layer_on_the_concatenation(with_points):
    features = levels()
    module = BlockDense(8, with_points)
    shapes = jax.eval_shape(module.init, jax.random.key(0), features)
    params = random_like(shapes)["params"]
    names = ["level0", "level1", "level2", *["points"] * with_points, "shared"]
    kernel = np.concatenate([params[name]["kernel"] for name in names])
    blocks = concatenated(features)
    blocks = blocks if with_points else [*blocks[:3], blocks[4]]
    dense = {"kernel": kernel, "bias": params["level0"]["bias"]}
    expected = nn.Dense(8).apply({"params": dense}, np.concatenate(blocks, -1))
    np.testing.assert_allclose(module.apply({"params": params}, features), expected, atol=1e-5)


@pytest.mark.parametrize("with_points", [True, False])
def test_blocks_start_as_one_layer_on_the_concatenation_would(with_points):
    """Every block's kernel, whatever its own width, has a variance of 1 / all inputs."""
    features = levels()
    blocks = concatenated(features)
    blocks = blocks if with_points else [*blocks[:3], blocks[4]]
    rows = np.concatenate(blocks, -1)
    module, dense = BlockDense(4096, with_points), nn.Dense(4096)
    params = jax.jit(module.init)(jax.random.key(0), features)
    for name, own in params["params"].items():
        spread = np.var(own["kernel"]) * rows.shape[-1]
        np.testing.assert_allclose(spread, 1.0, rtol=0.06, err_msg=name)
    whole = jax.jit(dense.init)(jax.random.key(1), rows)
    got, expected = module.apply(params, features), dense.apply(whole, rows)
    # Of each point, over the channels.
    np.testing.assert_allclose(np.var(got, -1), np.var(expected, -1), rtol=0.15)
    np.testing.assert_allclose(np.mean(got, -1), 0.0, atol=0.15)


def test_every_takes_every_other_point_of_all_levels():
    features = levels()
    half = features.every(2)
    for some, all_ in zip(concatenated(half), concatenated(features), strict=True):
        np.testing.assert_array_equal(some, all_[:, ::2])
    assert features.every(1) is features


@pytest.mark.parametrize("pool_first", [True, False])
def test_heads_shapes_and_dropout_in_training_only(pool_first):
    features = levels()
    config = HeadConfig((8, 6, 5), dropout=0.5, pool_first=pool_first)
    heads = (PooledHead(4, config), PointHead(7, config))
    variables = [variables_of(head, features) for head in heads]

    @jax.jit
    def train(key):
        rngs = {"dropout": key}
        return [
            head.apply(own, features, True, rngs=rngs, mutable=["batch_stats"])[0]
            for head, own in zip(heads, variables, strict=True)
        ]

    one, again, other = (train(jax.random.key(i)) for i in (1, 1, 2))
    for i, shape in enumerate([(2, 4), (2, 12, 7)]):
        assert one[i].shape == shape
        np.testing.assert_array_equal(one[i], again[i])
        assert not np.allclose(one[i], other[i])
    # No key in evaluation.
    plain = heads[1].apply(variables[1], features, train=False)
    assert plain.shape == (2, 12, 7)


def test_pooled_heads_see_a_set():
    """The order of the points does not matter to a pooled head."""
    features = levels()
    order = np.random.default_rng(3).permutation(12)
    fine, middle, coarse = features.levels
    shuffled = Features(
        features.points[:, order],
        (
            Level(fine.features[:, order]),
            Level(middle.features, middle.upsample[:, order]),
            Level(coarse.features, coarse.upsample[:, order]),
        ),
        features.shared,
    )
    head = PooledHead(4, HeadConfig((8, 6, 5)), with_points=True)
    apply = jax.jit(partial(head.apply, variables_of(head, features), train=False))
    np.testing.assert_allclose(apply(features), apply(shuffled), atol=1e-5)


def test_unit_vectors_at_zero():
    value, slope = jax.jvp(unit_vectors, (jnp.zeros((1, 3)),), (jnp.ones((1, 3)),))
    assert (np.asarray(value) == 0).all() and np.isfinite(slope).all()
    raw = normal(20, 3)
    length = np.linalg.norm(raw, axis=-1, keepdims=True)
    np.testing.assert_allclose(unit_vectors(raw), raw / length, atol=1e-6)


def exact_votes():
    """Points, and offsets from each to its foot on two lines: (points, offset, axis, pivot)."""
    rng = np.random.default_rng(0)
    points, pivot = rng.normal(size=(3, 50, 3)), rng.normal(size=(3, 2, 3)) + 2.0
    axis = rng.normal(size=(3, 2, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    away = points[:, :, None] - pivot[:, None]
    feet = pivot[:, None] + (away * axis[:, None]).sum(-1, keepdims=True) * axis[:, None]
    return points, feet - points[:, :, None], axis, pivot


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_exact_votes_give_the_exact_line(scale):
    """With the printed 1/N a heatmap of mean 0.1 would put the pivot at a tenth of its place."""
    points, offset, axis, pivot = exact_votes()
    heatmap = scale * np.random.default_rng(1).uniform(size=(3, 50, 2))
    votes = np.repeat(axis[:, None], 50, axis=1)
    found_axis, found_pivot = vote(*map(jnp.asarray, (points, heatmap, offset, 0.3 * votes)))
    np.testing.assert_allclose(found_axis, axis, atol=1e-5)
    distance = np.linalg.norm(np.cross(found_pivot - pivot, axis), axis=-1)
    assert distance.max() < 1e-5


def test_only_points_with_heat_vote():
    points, offset, axis, pivot = exact_votes()
    heatmap = np.zeros((3, 50, 2))
    heatmap[:, :5] = 0.7
    offset[:, 5:] += 10.0
    votes = np.repeat(axis[:, None], 50, axis=1)
    votes[:, 5:] *= -1.0
    found_axis, found_pivot = vote(*map(jnp.asarray, (points, heatmap, offset, votes)))
    np.testing.assert_allclose(found_axis, axis, atol=1e-5)
    assert np.linalg.norm(np.cross(found_pivot - pivot, axis), axis=-1).max() < 1e-5


def test_votes_without_heat_stay_finite():
    points, offset, axis, _ = exact_votes()
    votes = np.repeat(axis[:, None], 50, axis=1)

    def total(heatmap, offset, votes):
        found_axis, pivot = vote(jnp.asarray(points), heatmap, offset, votes)
        return found_axis.sum() + pivot.sum()

    # All points weigh the same.
    found = vote(jnp.asarray(points), np.zeros((3, 50, 2)), offset, votes)
    np.testing.assert_allclose(found[1], (points[:, :, None] + offset).mean(1), rtol=1e-4)

    arguments = map(jnp.asarray, (np.zeros((3, 50, 2)), offset, votes))
    value, gradients = jax.jit(jax.value_and_grad(total, (0, 1, 2)))(*arguments)
    assert np.isfinite(value)
    assert all(np.isfinite(gradient).all() for gradient in gradients)


def test_view_rotation_turns_the_mean_onto_the_axis_the_short_way():
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(20, 1, 3)) * [1, 1, 0.3] + [0, 0, 1.2]
    points = (mean + 0.1 * rng.normal(size=(20, 30, 3))).astype(np.float32)
    view = np.asarray(view_rotation(jnp.asarray(points)))
    np.testing.assert_allclose(
        view @ view.swapaxes(-1, -2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-6
    )
    np.testing.assert_allclose(np.linalg.det(view), 1.0, atol=1e-6)
    mean = points.mean(1)
    length = np.linalg.norm(mean, axis=-1)
    along = np.einsum("bij,bj->bi", view, mean)
    np.testing.assert_allclose(along, length[:, None] * [[0, 0, 1]], atol=1e-6)
    # The shortest such rotation turns by the angle between ray and axis, and not about the axis.
    turn = Rotation.from_matrix(view).as_rotvec()
    np.testing.assert_allclose(
        np.linalg.norm(turn, axis=-1), np.arccos(mean[:, 2] / length), atol=1e-5
    )
    np.testing.assert_allclose(turn[:, 2], 0.0, atol=1e-5)


def test_view_rotation_of_clouds_around_and_behind_the_camera():
    means = [(0, 0, 0), (0, 0, -1), (0.3, 0.2, -0.5), (1, 0, 0), (0, 0, 1)]
    points = np.tile(np.float32(means)[:, None], (1, 4, 1))
    weights = np.arange(9.0).reshape(3, 3)

    def total(points):
        view = view_rotation(points)
        return (view * weights).sum(), view

    gradient, view = jax.jit(jax.grad(total, has_aux=True))(points)
    assert np.isfinite(gradient).all()
    np.testing.assert_array_equal(view, np.tile(np.eye(3), (5, 1, 1)))


def test_canonicalize_inverts_the_pose():
    rotation = Rotation.random(3, rng=np.random.default_rng(0)).as_matrix().astype(np.float32)
    canonical, translation = normal(3, 10, 3), normal(3, 3, seed=1)
    camera = np.einsum("bij,bnj->bni", rotation, canonical) + translation[:, None]
    result = canonicalize(*map(jnp.asarray, (camera, rotation, translation)))
    np.testing.assert_allclose(result, canonical, atol=1e-6)
    np.testing.assert_allclose(
        rotate(jnp.asarray(rotation), jnp.asarray(result)) + translation[:, None], camera, atol=1e-6
    )


def test_local_moments_are_weighted_means_and_covariances():
    points, centers = normal(2, 40, 3).astype(np.float64), normal(2, 5, 3, seed=1)
    scale = np.array([0.5, 0.8])
    with jax.enable_x64(True):
        result = np.asarray(local_moments(*map(jnp.asarray, (centers, points, scale))))
        unit = 7.0 * np.ones(2)  # network units per meter, say
        scaled = local_moments(*map(jnp.asarray, (7 * centers, 7 * points, unit * scale)))
    for b in range(2):
        for m in range(5):
            away = points[b] - centers[b, m]
            weight = np.exp(-(away**2).sum(-1) / (2 * scale[b] ** 2))
            mean = np.average(points[b], axis=0, weights=weight)
            covariance = np.cov(points[b].T, aweights=weight, bias=True)
            trace = np.trace(covariance)
            rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
            expected = [
                *(3 * covariance[rows, columns] / trace),
                *((mean - centers[b, m]) / scale[b]),
                np.sqrt(trace) / scale[b],
                10 * weight.sum() / 40,
            ]
            np.testing.assert_allclose(result[b, m], expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(scaled, result, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("count", [90, 100, 127, 128])
def test_centers_are_spread_over_every_cloud(count):
    """On a line no center is nearest to more than its share of the points."""
    config = FastEncoderConfig(eval_centers=64, scales=(0.002,), width=4, blocks=1, last=4)
    module = FastEncoder(config)
    points = jnp.arange(count * 1.0)[None, :, None] * jnp.array([1.0, 0.0, 0.0])
    output = module.apply(variables_of(module, points), points, train=False)
    shares = np.bincount(np.asarray(output.levels[0].upsample)[0].argmax(-1), minlength=64)
    assert shares.min() >= 1 and shares.max() <= 2


def test_fast_encoder_interpolates_its_centers():
    config = FastEncoderConfig(centers=8, eval_centers=16, scales=(0.1,), width=4, blocks=1, last=4)
    module = FastEncoder(config)
    for count, train, centers in (
        *((64, True, 8), (64, False, 16)),
        (10, False, 10),  # fewer points than centers: all of them
    ):
        points = normal(2, count, 3)
        shapes = jax.eval_shape(
            lambda x, train=train: module.init_with_output(jax.random.key(0), x, train)[0], points
        )
        assert shapes.levels[0].features.shape == (2, centers, 4)
        assert shapes.levels[0].upsample.shape == (2, count, centers)
        assert shapes.shared.shape == (2, 4)
    apply = jax.jit(partial(module.apply, variables_of(module, points), train=False))
    weights = np.asarray(apply(10 * points).levels[0].upsample)
    np.testing.assert_allclose(weights.sum(-1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(weights.argmax(-1), np.tile(np.arange(10), (2, 1)))


def test_centers_without_scan_order_are_at_fixed_random_places():
    sizes = {"eval_centers": 16, "scales": (0.3,), "width": 4, "blocks": 1, "last": 4}
    scan = FastEncoder(FastEncoderConfig(**sizes))
    anywhere = FastEncoder(FastEncoderConfig(center_order="random", **sizes))
    points = normal(1, 64, 3)
    weights = random_like(variables_of(scan, points))
    places = np.random.default_rng(0).permutation(64)
    shuffled = np.empty((1, 64, 3), np.float32)
    # A cloud in which every fourth point is the next of those places.
    shuffled[:, ::4] = np.asarray(points)[:, places[:16]]
    rest = np.asarray(points)[:, places[16:]].reshape(1, 16, 3, 3)
    for number in range(3):
        shuffled[:, number + 1 :: 4] = rest[:, :, number]
    one = anywhere.apply(weights, points, train=False).levels[0].features
    other = scan.apply(weights, jnp.asarray(shuffled), train=False).levels[0].features
    np.testing.assert_allclose(one, other, atol=1e-4)
    assert np.abs(one - scan.apply(weights, points, train=False).levels[0].features).max() > 0.01


@pytest.fixture(scope="module", params=["fast", "hs"])
def root_network(request):
    """points -> output of stage I in evaluation, with random weights."""
    module = RootNetwork(network(request.param))
    variables = variables_of(module, jnp.zeros((2, 64, 3)))
    return jax.jit(partial(module.apply, variables, train=False))


def test_root_network_moves_with_the_cloud(root_network):
    """A shift of the cloud is a shift of the translation, and nothing else."""
    # Multiples of 2^-10, so that 64 of them have an exact mean, also after the shift.
    points = np.random.default_rng(0).integers(-512, 512, (2, 64, 3)).astype(np.float32) / 1024
    shift = np.float32([1.0, -2.0, 3.0])
    one, moved = root_network(points), root_network(points + shift)
    np.testing.assert_allclose(moved.directions, one.directions, atol=1e-6)
    np.testing.assert_allclose(moved.confidence, one.confidence, atol=1e-6)
    np.testing.assert_allclose(moved.translation, one.translation + shift, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(one.directions, axis=-1), 1.0, atol=1e-5)
    assert ((one.confidence > 0) & (one.confidence < 1)).all()


def test_clouds_of_a_batch_do_not_mix_in_evaluation(root_network):
    points = normal(2, 64, 3)
    one, swapped = root_network(points), root_network(points[::-1])
    assert not np.allclose(one.translation, swapped.translation)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b[::-1], rtol=1e-5, atol=1e-5), one, swapped
    )


def test_degenerate_clouds_have_finite_outputs(root_network):
    line = np.linspace(0, 1, 64, dtype=np.float32)[:, None] * np.float32([[1, 2, 3]])
    same = np.tile(np.float32([0.1, 0.2, 1.0]), (64, 1))
    output = root_network(np.stack([line, same]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(output))


def test_stage_two_outputs():
    config = network("fast", pool_first=True, point_stride=4)
    module = PartsNetwork(config, num_parts=3)
    points = jax.ShapeDtypeStruct((2, 64, 3), jnp.float32)
    streams = {name: jax.random.key(0) for name in ("params", "sample", "dropout")}
    expected = {
        "increment": (2, 6),
        "segmentation": (2, 64, 3),
        "heatmap": (2, 64, 2),
        "offset": (2, 64, 2, 3),
        "direction": (2, 64, 2, 3),
        "state": (2, 2),
        "size": (2, 3, 3),
        "center": (2, 3, 3),
    }
    for train, count in ((False, 64), (True, 16)):
        output, _ = jax.eval_shape(
            lambda x, train=train: module.init_with_output(streams, x, train), points
        )
        shapes = {name: leaf.shape for name, leaf in vars(output).items() if leaf is not None}
        assert shapes == {
            name: (2, count, *shape[2:]) if shape[1] == 64 else shape
            for name, shape in expected.items()
        }


def test_presets():
    assert set(PRESETS) == {"paper", "fast", "ablation"}
    assert preset("paper").network.encoder == "hs"
    with pytest.raises(CaperError, match=r"preset 'fats'; did you mean 'fast'"):
        preset("fats")
