"""The HS-Encoder against its formulas in numpy (HS-Pose, CVPR 2023), and at its published sizes."""

from __future__ import annotations

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.tiny import HS, network, random_like, random_variables
from jax.flatten_util import ravel_pytree

from caper_jax import categories
from caper_jax.config import HSEncoderConfig, preset
from caper_jax.estimator import estimate
from caper_jax.models.encoders.hs import HSEncoder, OutlierRobust, neighborhoods
from caper_jax.models.parts import PartsNetwork
from caper_jax.models.root import RootNetwork


def neighbors(points, k):
    """[N, k] nearest others, by sorting."""
    distance = ((points[:, None] - points[None]) ** 2).sum(-1)
    np.fill_diagonal(distance, np.inf)
    return distance.argsort(-1, kind="stable")[:, :k]


def hs_layer(params, points, features, scope, around, supports):
    """One cloud: mean over the supports of max over neighbors of relu(d . W) f, then ORL, + STE.

    ``features`` is None in the surface layer, where f = 1 and the skip (STE) sees the points.
    """
    weights = params["directions"] / np.linalg.norm(params["directions"], axis=0)
    offset = points[scope] - points[:, None]
    direction = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    theta = np.maximum(direction @ weights, 0)
    channels = weights.shape[1] // supports
    center = 0.0
    if features is not None:
        dense = features @ params["support"]["kernel"] + params["support"]["bias"]
        center = dense[:, :channels]
        theta = theta * dense[:, channels:][scope]
    active = theta.max(1).reshape(len(points), supports, channels)
    result = center + active.mean(1)
    shared = np.tile(result[around].max(1).mean(0), (len(points), 1))
    linear = np.concatenate([params["robust"][name]["kernel"] for name in ("own", "shared")])
    result = result + np.concatenate([result, shared], -1) @ linear
    return result + (points if features is None else features) @ params["skip"]["kernel"]


def hs_encoder(variables, points, config):
    """One cloud in evaluation: level features, the rows nearest to each point, global feature."""
    params, statistics = variables["params"], variables["batch_stats"]

    def norm_relu(features, number):
        name = f"norm{number}"
        spread = np.sqrt(statistics[name]["var"] + 1e-5)
        features = (features - statistics[name]["mean"]) / spread
        return np.maximum(features * params[name]["scale"] + params[name]["bias"], 0)

    def layer(number, points, features, around):
        k = around.shape[1]
        in_features = config.feature_space and features is not None
        scope = neighbors(features, k) if in_features else around
        name = f"layer{number}"
        return hs_layer(params[name], points, features, scope, around, config.supports)

    def closest(some):
        return ((points[:, None] - some[None]) ** 2).sum(-1).argmin(-1)

    def pool(points, features, around):
        return points[::4], features[around[:, :4]].max(1)[::4]

    around = neighbors(points, 4)  # min(20, 64 / 8), here min(4, 8)
    f0 = np.maximum(layer(0, points, None, around), 0)
    f1 = norm_relu(layer(1, points, f0, around), 1)
    points1, pooled = pool(points, f1, around)
    around = neighbors(points1, 2)  # min(4, 16 / 8)
    f2 = norm_relu(layer(2, points1, pooled, around), 2)
    f3 = norm_relu(layer(3, points1, f2, around), 3)
    points2, pooled = pool(points1, f3, around)
    f4 = layer(4, points2, pooled, neighbors(points2, 1))
    levels = (np.concatenate([f0, f1], -1), np.concatenate([f2, f3], -1), f4)
    return levels, (closest(points1), closest(points2)), f4.max(0)


def shapes_of(module, count):
    streams = {name: jax.random.key(0) for name in ("params", "sample", "dropout")}
    return jax.eval_shape(lambda x: module.init(streams, x, train=False), jnp.zeros((2, count, 3)))


def test_the_robust_layer_starts_as_one_layer_on_feature_and_global_feature():
    around = np.zeros((1, 4, 2), np.int32)
    features = np.random.default_rng(0).normal(size=(1, 4, 128)).astype(np.float32)
    params = jax.jit(OutlierRobust().init)(jax.random.key(0), features, around)["params"]
    for name in ("own", "shared"):
        np.testing.assert_allclose(np.var(params[name]["kernel"]), 1 / 256, rtol=0.06)


@pytest.mark.parametrize("feature_space", [True, False])
def test_encoder_follows_the_formulas(feature_space):
    config = dataclasses.replace(HS, feature_space=feature_space)
    module = HSEncoder(config)
    variables = random_like(shapes_of(module, 64))
    variables = jax.tree.map(lambda leaf: leaf.astype(np.float64), variables)
    points = np.random.default_rng(1).normal(size=(2, 64, 3))
    with jax.enable_x64(True):
        result = jax.jit(lambda v, x: module.apply(v, x, train=False))(variables, points)
    for b in range(2):
        levels, rows, shared = hs_encoder(variables, points[b], config)
        for level, expected in zip(result.levels, levels, strict=True):
            np.testing.assert_allclose(level.features[b], expected, atol=1e-10)
        np.testing.assert_allclose(result.shared[b], shared, atol=1e-10)
        assert result.levels[0].upsample is None
        for level, expected in zip(result.levels[1:], rows, strict=True):
            np.testing.assert_array_equal(level.upsample[b], expected)


def test_pooling_is_random_in_training_only():
    module = HSEncoder(HS)
    variables = random_like(shapes_of(module, 64))
    cloud = np.random.default_rng(1).normal(size=(64, 3)).astype(np.float32)
    points = np.stack([cloud, cloud])

    @jax.jit
    def train(key):
        return module.apply(variables, points, True, rngs={"sample": key}, mutable=["batch_stats"])

    (first, state), (again, _), (other, _) = (train(jax.random.key(i)) for i in (1, 1, 2))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    rows, other_rows = np.asarray(first.levels[1].upsample), np.asarray(other.levels[1].upsample)
    assert (rows != other_rows).any()  # another key, another subset
    assert (rows[0] != rows[1]).any()  # each cloud its own
    # 16 points without repetition: each is the nearest one to itself.
    assert all(len(set(row)) == 16 for row in (*rows, *other_rows))
    moved = jax.tree.map(
        lambda new, old: np.abs(new - old).max(), state, {"batch_stats": variables["batch_stats"]}
    )
    assert min(jax.tree.leaves(moved)) > 0  # running statistics are kept up in training
    # In evaluation the numpy encoder above has every fourth point, and no key is needed.


def test_published_sizes():
    """1024, 256 and 64 points with 128 + 128, 256 + 256 and 512 channels: 1280, and 512 global."""
    module = HSEncoder()
    variables = shapes_of(module, 1024)
    points = jax.ShapeDtypeStruct((2, 1024, 3), jnp.float32)
    result = jax.eval_shape(lambda v, x: module.apply(v, x, train=False), variables, points)
    assert [level.features.shape for level in result.levels] == [
        (2, 1024, 256),
        (2, 256, 512),
        (2, 64, 512),
    ]
    assert [level.upsample and level.upsample.shape for level in result.levels] == [
        None,
        (2, 1024),
        (2, 1024),
    ]
    assert result.shared.shape == (2, 512)
    without = HSEncoder(HSEncoderConfig(global_feature=False))
    shapes = jax.eval_shape(lambda v, x: without.apply(v, x, train=False), variables, points)
    assert shapes.shared is None


@pytest.mark.parametrize(("points", "expected"), [(1024, (20, 20, 8)), (512, (20, 16, 4))])
def test_neighbors_shrink_with_the_cloud(monkeypatch, points, expected):
    """20 at full resolution, at most an eighth of the points after pooling: 20, 20, 8."""
    from caper_jax.models.encoders import hs as module

    asked = []

    def nearest(query, points, k, exclude_self=False):
        asked.append((query.shape[1], k))
        return jnp.zeros((*query.shape[:2], k), jnp.int32)

    monkeypatch.setattr(module, "nearest", nearest)
    shapes_of(HSEncoder(), points)
    assert set(asked) == set(zip((points, points // 4, points // 16), expected, strict=True))


def test_parameter_count_of_the_paper_preset():
    """About 9.5 M in stage I, 13.8 M in stage II, from the layer sizes alone."""

    def hs(before, channels, norm):
        own = 3 * 7 * channels + before * channels  # directions and STE
        own += (before + 1) * 8 * channels if before > 3 else 0  # center and 7 supports
        return own + 2 * channels * channels + 2 * channels * norm  # ORL, batch norm

    def dense(before, channels, norm):
        return (before + 1) * channels + 2 * channels * norm

    def head(outputs, extra=0, pooled=True):
        trunk = dense(1280 + 512 + extra, 1024, True) + dense(1024, 256, True)
        return trunk + (dense(256, 256, True) if pooled else 0) + dense(256, outputs, False)

    channels = (128, 128, 256, 256, 512)
    encoder = sum(
        hs(before, after, 0 < number < 4)
        for number, (before, after) in enumerate(zip((3, *channels), channels, strict=False))
    )
    box = categories.get("box")
    root = encoder + 2 * head(4) + head(3, extra=3)
    pointwise = head(2, 3, pooled=False) + head(7, 3, pooled=False)
    parts = encoder + pointwise + head(1) + head(12) + head(6)
    sizes = preset("paper").network
    modules = (RootNetwork(sizes), PartsNetwork(sizes, box.num_parts))
    for module, expected in zip(modules, (root, parts), strict=True):
        leaves = jax.tree.leaves(shapes_of(module, 1024)["params"])
        assert sum(math.prod(leaf.shape) for leaf in leaves) == expected
    assert 9e6 < root < 10e6
    assert 13e6 < parts < 14e6


def test_neighborhoods_serve_every_pose_of_the_cloud():
    # Multiples of 2^-9: all distances are exact, in either pose.
    cloud = np.random.default_rng(1).integers(-512, 512, (2, 64, 3)).astype(np.float32) / 512
    turn = np.float32([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
    space = jax.jit(lambda x: neighborhoods(x, HS))(cloud)
    moved = jax.jit(lambda x: neighborhoods(x, HS))(cloud @ turn + 2.0)
    jax.tree.map(np.testing.assert_array_equal, space, moved)
    assert [a.shape for a in space.around] == [(2, 64, 4), (2, 16, 2), (2, 4, 1)]
    module = HSEncoder(HS)
    apply = jax.jit(lambda v, x, space: module.apply(v, x, False, space))
    variables = random_like(shapes_of(module, 64))
    # Two programs, whose sums may round otherwise.
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5),
        apply(variables, cloud, space),
        apply(variables, cloud, None),
    )


def slopes(function, at, step=1e-8):
    """Slopes [M] of a function of a pytree along one direction, forward and by differences; and of
    a random sum of its values, forward and in reverse.

    The step is small: a set of neighbors that changes within it makes the function jump.
    """
    flat, unravel = ravel_pytree(at)
    along = np.random.default_rng(2).normal(size=flat.size)

    @jax.jit  # once, for the value at three places
    def differentiate(shift):
        def moved(shift):
            return function(unravel(flat + shift * along))

        value, pull = jax.vjp(moved, shift)
        weights = np.random.default_rng(3).normal(size=value.shape)
        forward = jax.jacfwd(moved)(shift)
        return value, forward, forward @ weights, pull(jnp.asarray(weights))[0]

    _, forward, summed, backward = differentiate(0.0)
    numerical = (differentiate(step)[0] - differentiate(-step)[0]) / (2 * step)
    return forward, numerical, summed, backward


def test_forward_mode_equals_reverse_mode_and_difference_quotients():
    """By all weights and points at once."""
    module = HSEncoder(HS)
    variables = random_like(shapes_of(module, 64))
    points = np.random.default_rng(1).normal(size=(2, 64, 3))

    def function(at):
        features = module.apply({**variables, "params": at["params"]}, at["points"], train=False)
        levels = [jnp.square(level.features).mean((1, 2)) for level in features.levels]
        return jnp.concatenate([*levels, features.shared.ravel()])

    with jax.enable_x64(True):
        at = {"params": variables["params"], "points": points}
        at = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), at)
        forward, numerical, summed, backward = slopes(function, at)
    assert np.abs(forward).min() > 1e-3
    np.testing.assert_allclose(summed, backward, rtol=1e-10)
    np.testing.assert_allclose(forward, numerical, rtol=1e-5, atol=1e-5)


def test_estimates_of_the_paper_network_are_differentiable_forward_and_backward():
    """Poses and joints by the points of a cloud, through both stages and the voting."""
    box = categories.get("box")
    sizes = network("hs", pool_first=True, refine_steps=0)
    variables = random_variables(box, sizes)
    points = np.random.default_rng(4).normal((0, 0, 0.8), 0.1, (1, 64, 3))

    def function(points):
        pose = estimate(variables, points, box, sizes).pose
        return ravel_pytree((pose.rotation, pose.translation, pose.joint_state, pose.size))[0]

    with jax.enable_x64(True):
        forward, numerical, summed, backward = slopes(function, jnp.asarray(points))
    assert np.abs(forward).max() > 0.1
    np.testing.assert_allclose(summed, backward, rtol=1e-8)
    np.testing.assert_allclose(forward, numerical, rtol=1e-4, atol=1e-4)
