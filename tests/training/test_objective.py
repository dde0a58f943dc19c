"""The objective: targets, symmetries, reference poses, rotation classes, gradients."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.objectives import BOX, CABINET, DEEP, THIN, frames
from _helpers.tiny import network, random_variables
from scipy.spatial.transform import Rotation

from caper_jax.articulation.symmetry import apply_symmetry
from caper_jax.config import LossConfig, LossWeights, RotationClassifierConfig
from caper_jax.geometry.frames import view_rotation
from caper_jax.lie import se3, so3
from caper_jax.models.parts import PartsOutput
from caper_jax.models.root import RootOutput
from caper_jax.models.rotation_classes import CUBE_ROTATIONS, HALF_TURNS
from caper_jax.training import memory
from caper_jax.training.objective import Objective, rotate_references, stage1_loss, stage2_loss

# A door on a cabinet, and a drawer that slides in it.
NO_ERROR = Rotation.identity()


class Oracle(Objective):
    """An objective whose networks answer what they are told to, in place of weights.

    ``params`` of either stage is (pose [B, ...], labels [B, N], view [B, 3, 3], error [3, 3] of the
    root in the viewing frame); the points that each stage is given come back as its state. Stage
    II's increment is that from the reference its points were canonicalized with (Eq 10).
    """

    def _reference_pose(self, *arguments):
        drawn = super()._reference_pose(*arguments)
        self._reference, _ = drawn
        return drawn

    def _increment(self, rotation, translation):
        """Twists [B, 6] from the reference to a root pose in the viewing frame."""
        back = jnp.swapaxes(self._reference[:, :3, :3], -1, -2)
        away = translation - self._reference[:, :3, 3]
        turn = jnp.einsum("bij,bjk->bik", back, rotation, precision="highest")
        shift = jnp.einsum("bij,bj->bi", back, away, precision="highest")
        return se3.log(se3.from_rt(turn, shift))

    def _apply(self, stage, params, model_state, points, key):
        pose, labels, view, error = params
        category, unit = self.category, self.category.unit
        if stage == "root":
            rotation = error @ view @ pose.rotation[:, 0]
            columns = ["xyz".index(name) for name in category.directions]
            output = RootOutput(
                directions=jnp.swapaxes(rotation, -1, -2)[:, columns],
                confidence=jnp.ones((len(view), 2)),
                translation=unit * (view * pose.translation[:, 0, None, :]).sum(-1),
            )
            return output, {"seen": points}
        stride = self.network.point_stride
        some = points[:, ::stride, None]
        axis, pivot = pose.joint_axis[:, None], unit * pose.joint_pivot[:, None]
        along = ((some - pivot) * axis).sum(-1, keepdims=True)
        offset = pivot + along * axis - some
        distance = jnp.linalg.norm(offset, axis=-1)
        voting = distance < 0.2 * distance.max(1, keepdims=True)
        slides = np.array(category.joint_types) == "prismatic"
        output = PartsOutput(
            increment=self._increment(
                view @ pose.rotation[:, 0],
                unit * (view * pose.translation[:, 0, None, :]).sum(-1),
            ),
            rotation_class=None,
            segmentation=100.0 * jax.nn.one_hot(labels[:, ::stride], category.num_parts),
            heatmap=jnp.where(voting, jnp.exp(-distance), 0.0),
            offset=offset,
            direction=jnp.broadcast_to(axis, offset.shape),
            state=pose.joint_state * np.where(slides, unit, 1.0),
            size=unit * (pose.size - np.array(category.mean_size)),
            center=unit * (pose.box_center - np.array(category.mean_center)),
        )
        return output, {"seen": points}

    def play(self, batch, pose, labels, error=NO_ERROR):
        """(total loss, points that stage II is given, metrics) when the networks answer so."""
        if not hasattr(self, "_jitted"):
            self._jitted = jax.jit(lambda params, batch: self(params, *self._rest(batch)))
        view = view_rotation(batch.points, self.category.viewpoint.camera_roll)
        params = (pose, jnp.asarray(labels), view, jnp.asarray(error.as_matrix(), jnp.float32))
        total, (state, metrics) = self._jitted({"root": params, "parts": params}, batch)
        return total, np.asarray(state["seen"]["parts"]), metrics

    @staticmethod
    def _rest(batch):
        return {"seen": {"root": 0.0, "parts": 0.0}}, batch, jax.random.key(0), 0.0


# Shared, so that each is compiled once.
BOXES = Oracle(
    BOX,
    network(point_stride=4),
    LossConfig(root_noise_deg=0.0, root_noise=0.0, predicted_root=0.0),
)
CABINETS = Oracle(CABINET, network(), LossConfig(LossWeights(heatmap=0.3, offset=0.7)))


def canonical_points(batch, pose, unit):
    """Points in the root's canonical frame, network units."""
    offset = np.asarray(batch.points) - np.asarray(pose.translation[:, :1])
    return unit * np.einsum("bji,bnj->bni", pose.rotation[:, 0], offset)


@pytest.mark.parametrize("objective", [BOXES, CABINETS], ids=["box", "cabinet"])
def test_the_truth_costs_nothing(objective):
    """In particular: every target is in the unit, frame and order in which it is predicted."""
    sizes = [THIN, DEEP, THIN] if objective is BOXES else [CABINET.mean_size] * 2
    batch = frames(objective.category, sizes)
    total, seen, metrics = objective.play(batch, batch.pose, batch.labels)
    if objective is BOXES:
        expected = canonical_points(batch, batch.pose, BOX.unit)
        np.testing.assert_allclose(seen, expected, atol=1e-5)
    assert metrics.pop("segmentation_accuracy") == pytest.approx(1.0)
    assert metrics.pop("root_deg") < 0.1
    for name, value in metrics.items():
        assert abs(value) < 2e-5, name
    assert total < 1e-3


def test_networks_learn_from_what_a_camera_that_is_not_level_would_see_level():
    rolled = Oracle(BOX.rolled(90.0), BOXES.network, BOXES.config)
    batch = frames(BOX, [THIN, DEEP])
    assert rolled.play(batch, batch.pose, batch.labels)[0] < 1e-3


def test_the_order_of_the_points_does_not_matter():
    """Networks learn from clouds in the order in which they will see them."""
    batch = frames(BOX, [THIN, DEEP, THIN])
    shuffle = np.random.default_rng(1).permutation(batch.points.shape[1])
    mixed = dataclasses.replace(
        batch, points=batch.points[:, shuffle], labels=batch.labels[:, shuffle]
    )
    assert not np.array_equal(mixed.labels, batch.labels)
    total, seen, metrics = BOXES.play(mixed, mixed.pose, batch.labels)
    np.testing.assert_allclose(seen, canonical_points(batch, batch.pose, BOX.unit), atol=1e-5)
    assert metrics["segmentation_accuracy"] == pytest.approx(1.0)
    assert total < 1e-3


def test_the_total_weighs_each_loss_as_the_paper_does():
    sizes = np.array([CABINET.mean_size] * 2)
    batch, wrong = frames(CABINET, sizes), frames(CABINET, 1.1 * sizes, seed=1)
    tilted = jnp.asarray(Rotation.from_euler("y", 0.3).apply([-1, 0, 0]), jnp.float32)
    pose = wrong.pose.replace(
        joint_axis=wrong.pose.joint_axis.at[:, 0].set(tilted),
        joint_pivot=wrong.pose.joint_pivot + 0.02,
        box_center=wrong.pose.box_center + 0.01,
    )
    weights = dataclasses.asdict(CABINETS.config.weights)
    total, _, metrics = CABINETS.play(batch, pose, 2 - jnp.maximum(batch.labels, 0))
    named = {name: metrics[name] for name in weights if name in metrics}
    assert set(weights) - {"rotation_class"} == set(named)  # there is no rotation classifier
    assert min(named.values()) > 1e-3
    expected = sum(weights[name] * value for name, value in named.items())
    np.testing.assert_allclose(total, expected, rtol=1e-5)
    # In network units, 4 per meter; angles are not lengths.
    size = 4 * np.abs(0.1 * sizes).mean()
    center = 4 * np.abs(np.asarray(batch.pose.box_center - pose.box_center)).mean()
    np.testing.assert_allclose(metrics["scale"], size + center, rtol=1e-4)
    off = np.abs(np.asarray(batch.pose.joint_state - pose.joint_state)).mean(0)
    np.testing.assert_allclose(metrics["state1_deg"], np.degrees(off[0]), rtol=1e-4)
    np.testing.assert_allclose(metrics["state2_unit"], 4 * off[1], rtol=1e-4)
    np.testing.assert_allclose(metrics["state"], (off[0] + 4 * off[1]) / 2, rtol=1e-4)


def test_ambiguous_objects_are_scored_under_the_symmetry_they_are_predicted_in():
    batch = frames(BOX, [THIN, DEEP, THIN])
    (symmetry,) = BOX.symmetries
    second = apply_symmetry(batch.pose, symmetry, BOX)
    labels = np.asarray(batch.labels)
    exchanged = np.where(labels < 0, -1, 1 - labels)
    # Labels follow the symmetry, sample by sample.
    mixed = np.where(np.array([[1], [0], [1]], bool), exchanged, labels)
    _, seen, metrics = BOXES.play(batch, second, mixed)
    one, other = (canonical_points(batch, pose, BOX.unit) for pose in (batch.pose, second))
    np.testing.assert_allclose(seen[[0, 2]], other[[0, 2]], atol=1e-5)
    assert metrics["segmentation_accuracy"] == pytest.approx(1.0)
    assert metrics["segmentation"] < 1e-5
    # A deep box has none: the other pose is a mistake, and costs what it costs.
    np.testing.assert_allclose(seen[1], one[1], atol=1e-5)
    assert metrics["root_deg"] == pytest.approx(180.0 / 3, abs=0.1)
    expected = per_sample_rotation(batch, second)[1] / 3
    assert metrics["rotation"] == pytest.approx(expected, rel=1e-4)


def per_sample_rotation(batch, predicted):
    """Eq 17 in numpy: of the x and z axes, in the viewing frame."""
    view = np.asarray(view_rotation(batch.points))
    off = view @ np.asarray(predicted.rotation[:, 0] - batch.pose.rotation[:, 0])
    return np.abs(off[..., [0, 2]]).mean(1).sum(-1)


def aligned(points, reference):
    """Rotation vectors [B, 3] and shifts that take reference to points, and the largest rest."""
    means = points.mean(1, keepdims=True), reference.mean(1, keepdims=True)
    cross = np.einsum("bni,bnj->bij", points - means[0], reference - means[1])
    u, _, v = np.linalg.svd(cross)
    turn = u @ v
    assert (np.linalg.det(turn) > 0).all()  # a rotation fits best, not a reflection
    shift = means[0][:, 0] - np.einsum("bij,bj->bi", turn, means[1][:, 0])
    moved = np.einsum("bij,bnj->bni", turn, reference) + shift[:, None]
    return Rotation.from_matrix(turn).as_rotvec(), shift, np.abs(moved - points).max()


def test_stage_two_sees_noisy_roots_and_predicted_ones_that_are_nearly_right():
    batch = frames(BOX, [DEEP] * 300)
    config = LossConfig(
        root_noise_deg=4.0, root_noise=0.05, root_noise_spread=1.0, predicted_root=0.5
    )
    oracle = Oracle(BOX, network(), config)
    truth = canonical_points(batch, batch.pose, BOX.unit)

    def seen(degrees):
        """Errors of the roots, in degrees and network units, when stage I is ``degrees`` off."""
        error = Rotation.from_rotvec([0, 0, np.radians(degrees)])
        points = oracle.play(batch, batch.pose, batch.labels, error)[1]
        turn, shift, rest = aligned(points, truth)
        assert rest < 1e-4  # whatever the root, a rigid motion
        return np.degrees(turn), shift

    # Too far off: none of the predictions is used.
    turn, shift = seen(40.0)
    np.testing.assert_allclose(turn.std(0), 4.0, rtol=0.15)
    np.testing.assert_allclose(turn.mean(0), 0.0, atol=0.8)
    np.testing.assert_allclose(shift.std(0), 0.05, rtol=0.15)

    turn, shift = seen(10.0)
    angle = np.linalg.norm(turn, axis=-1)
    predicted = np.linalg.norm(shift, axis=-1) < 1e-4  # its translation is the true one
    assert predicted.mean() == pytest.approx(0.5, abs=0.1)
    np.testing.assert_allclose(angle[predicted], 10.0, atol=0.1)
    np.testing.assert_allclose(turn[~predicted].std(0), 4.0, rtol=0.2)


def test_the_noise_of_the_roots_is_small_and_large():
    """Its logarithm is spread evenly over ``root_noise_spread`` either way."""
    count, spread = 4000, 4.0
    config = LossConfig(root_noise=0.05, root_noise_spread=spread, predicted_root=0.0)
    pose = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], count, 0), frames(BOX, [DEEP]).pose)
    prediction = pose.rotation[:, 0], jnp.zeros((count, 3))
    objective = Objective(BOX, network(), config)
    reference, _ = objective._reference_pose(jax.random.key(0), *prediction, pose)
    shift = np.asarray(reference[:, :3, 3] - pose.translation[:, 0])
    # The mean square of a factor exp(U(-log 4, log 4)).
    square = (spread**2 - spread**-2) / (4 * np.log(spread))
    np.testing.assert_allclose(shift.std(0), 0.05 * np.sqrt(square), rtol=0.1)
    length = np.linalg.norm(shift, axis=-1)
    assert np.median(length) < 0.05 * np.sqrt(3) < 0.5 * np.quantile(length, 0.95)


@pytest.fixture(scope="module", params=["fast", "hs"])
def trained(request):
    """Losses, first gradients and first metrics of 80 steps on one batch; one cloud is a point."""
    batch = frames(BOX, [THIN, DEEP, THIN, DEEP])
    batch = batch.replace(points=batch.points.at[3].set(jnp.asarray([0.1, 0.0, 0.8])))
    # Heads of either kind, each with one encoder.
    objective = Objective(BOX, network(request.param, request.param == "hs", point_stride=2))
    variables = random_variables(BOX, objective.network)
    params, state = variables["params"], {"batch_stats": variables["batch_stats"]}

    @jax.jit
    def differentiate(params):
        gradient = memory.value_and_grad(objective)
        return gradient(params, state, batch, jax.random.key(1), 0.0)

    values, first = [], None
    for _ in range(80):
        (value, aux), gradients = differentiate(params)
        values.append(float(value))
        first = first or (gradients, aux)
        # Steps by the sign of the gradient, in numpy: an optimizer would double the compilation.
        params = jax.tree.map(lambda p, g: p - 0.004 * np.sign(g), params, gradients)
    return state, np.array(values), *first


def test_every_weight_learns(trained):
    _, _, gradients, _ = trained
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradients):
        name = jax.tree_util.keystr(path)
        assert np.isfinite(leaf).all(), name
        # The bias before a batch norm has no effect, so no gradient; everything else has one.
        if path[-1].key != "bias":
            assert np.abs(leaf).max() > 1e-7, name


def test_training_on_one_batch_lowers_the_loss(trained):
    state, values, _, (new_state, metrics) = trained
    assert np.isfinite(values).all()
    assert values[-5:].max() < 0.25 * values[0]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((new_state, metrics)))
    # The running statistics of both stages move, in their old structure.
    moved = jax.tree.map(lambda new, old: np.abs(new - old).max(), new_state, state)
    assert set(moved["batch_stats"]) == {"root", "parts"}
    assert min(jax.tree.leaves(moved)) > 0


def test_init_has_both_stages():
    shapes = jax.eval_shape(Objective(BOX, network()).init, jax.random.key(0))
    assert set(shapes) == {"params", "batch_stats"}
    assert all(set(collection) == {"root", "parts"} for collection in shapes.values())


# References that are off by a cube rotation

CLASSIFIER = network(pool_first=True, rotation_classifier=RotationClassifierConfig(8))


def truth_of(objective, batch):
    """The truth in the networks' frame, when the camera looks along it."""
    return objective._truth(batch.pose, jnp.broadcast_to(jnp.eye(3), (len(batch.points), 3, 3)))


def test_references_are_rotated_on_purpose_and_say_so():
    config = LossConfig(root_noise_deg=1.0, predicted_root=0.0)
    objective = Objective(BOX, CLASSIFIER, config)
    truth = truth_of(objective, frames(BOX, [DEEP] * 200))
    key, prediction = jax.random.key(0), (truth.rotation[:, 0], truth.translation[:, 0])
    reference, off_by = objective._reference_pose(key, *prediction, truth)
    assert not np.asarray(off_by).any()
    reference, off_by = rotate_references(key, reference, off_by, 0.4)
    off_by = np.asarray(off_by)
    assert 0.3 < (off_by > 0).mean() < 0.5
    assert 0.4 < np.isin(off_by[off_by > 0], HALF_TURNS).mean() < 0.8
    corrected = np.asarray(reference)[:, :3, :3] @ CUBE_ROTATIONS[off_by]
    off = so3.geodesic_distance(jnp.asarray(corrected), truth.rotation[:, 0])
    assert np.degrees(off).max() < 30  # the noise alone


def test_predictions_that_are_off_by_a_half_turn_are_references_with_their_class():
    objective = Objective(BOX, CLASSIFIER, LossConfig(predicted_root=1.0))
    truth = truth_of(objective, frames(BOX, [DEEP] * 100))
    half = np.diag([-1.0, 1.0, -1.0]).astype(np.float32)  # about y
    prediction = truth.rotation[:, 0] @ half, truth.translation[:, 0]
    reference, off_by = objective._reference_pose(jax.random.key(0), *prediction, truth)
    np.testing.assert_array_equal(CUBE_ROTATIONS[np.asarray(off_by)], np.tile(half, (100, 1, 1)))
    np.testing.assert_allclose(reference[:, :3, :3], prediction[0], atol=1e-6)


def outputs_and_targets(objective, batch, off_by):
    """Stage II's truth, as output and as target; its outputs are off by a little."""
    truth = truth_of(objective, batch)
    root = se3.from_rt(truth.rotation[:, 0], truth.translation[:, 0])
    targets = objective._parts_targets(batch.points, batch.labels, truth, root)
    count, parts = len(batch.points), objective.category.num_parts
    outputs = PartsOutput(
        increment=targets.increment + 0.1,
        rotation_class=jnp.zeros((count, 24)) if off_by is not None else None,
        segmentation=jnp.zeros((*batch.labels.shape, parts)),
        heatmap=jnp.ones((*batch.labels.shape, parts - 1)),
        offset=truth.joint_pivot[:, None] - batch.points[:, :, None],
        direction=jnp.broadcast_to(-truth.joint_axis[:, None], (*batch.labels.shape, parts - 1, 3)),
        state=truth.joint_state + 0.5,
        size=truth.size + 0.1,
        center=truth.box_center,
    )
    if off_by is not None:
        targets = targets.replace(rotation_class=jnp.asarray(off_by))
    return outputs, targets


def test_of_rotated_references_only_the_rotation_and_the_increment_are_learned():
    """And what is logged of everything else is of the other samples."""
    objective = Objective(CABINET, CLASSIFIER)
    batch = frames(CABINET, np.array([CABINET.mean_size] * 3))
    outputs, targets = outputs_and_targets(objective, batch, [0, 7, 0])
    terms = stage2_loss(outputs, targets, objective.config)
    weights = dataclasses.asdict(objective.config.weights)
    for name, value in terms.items():
        alone = name in ("rotation_class", "twist", "total")
        assert (value[1] > 0) == alone and value[0] >= 0, name
    expected = sum(weights[name] * terms[name] for name in terms.keys() - {"total"})
    np.testing.assert_allclose(terms["total"], expected, rtol=1e-6)
    metrics = objective._parts_metrics(outputs, targets, terms)
    np.testing.assert_allclose(metrics["state1_deg"], np.degrees(0.5), rtol=1e-5)
    np.testing.assert_allclose(metrics["scale"], 0.1, rtol=1e-5)
    nothing = targets.replace(rotation_class=jnp.full(3, 7))
    terms = stage2_loss(outputs, nothing, objective.config)
    metrics = objective._parts_metrics(outputs, nothing, terms)
    assert metrics["state"] == metrics["state1_deg"] == 0


def test_joints_without_votes_find_back_from_the_opposite_axis():
    """The loss of a unit vector has no slope there."""
    objective = Objective(BOX, network(pool_first=True, joints="direct"))
    batch = frames(BOX, [DEEP, DEEP])
    outputs, targets = outputs_and_targets(objective, batch, None)

    def loss(direction):
        terms = stage2_loss(outputs.replace(direction=direction), targets, objective.config)
        assert "heatmap" not in terms and "offset" not in terms
        return terms["direction"].sum()

    slope = jax.grad(loss)(outputs.direction).sum(1)
    assert (np.asarray((slope * targets.joint_axis).sum(-1)) < -0.1).all()


@pytest.mark.parametrize("change", [{"rotation": "quaternion"}, {"vertical_correction": False}])
def test_ablations_of_stage_one_learn_no_confidence(change):
    objective = Objective(BOX, network(**change))
    targets = objective._root_targets(truth_of(objective, frames(BOX, [THIN, THIN])))
    outputs = RootOutput(targets.directions, jnp.ones((2, 2)), targets.translation)
    assert set(stage1_loss(outputs, targets, objective.config)) == {
        "rotation",
        "translation",
        "total",
    }
