"""``caper evaluate`` from end to end: what it counts, writes and refuses."""

import dataclasses
import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.frames import random_frames
from scipy.spatial.transform import Rotation

from caper_jax import categories, cli
from caper_jax.config import GeneratorConfig, NetworkConfig
from caper_jax.data.clouds import sample_points
from caper_jax.data.hdf5 import Hdf5Dataset, write
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.evaluation import loading, protocol, report
from caper_jax.evaluation.metrics import PoseErrors
from caper_jax.evaluation.report import errors_by_opening
from caper_jax.geometry.raster_order import raster_order

BOX = categories.get("box")
FRAMES = 21
MEAN_POSE = {
    "rotation": Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix().tolist(),
    "offset": [0.0, 0.01, 0.02],
    "size": [[0.2, 0.05, 0.1]] * 2,
    "box_center": [[0.0, 0.0, 0.0]] * 2,
    "joint_axis": [[-1.0, 0.0, 0.0]],
    "joint_pivot": [[0.0, 0.01, -0.05]],
    "joint_state": [1.2],
}


class Known(Estimator):
    """An estimator that is a function of points, without weights."""

    def __init__(self, function):
        self.category, self.network, self.variables = BOX, NetworkConfig(), {}
        self.card, self.function = {}, function

    def __call__(self, points):
        found = self.function({}, points[None])
        one = jax.tree.map(lambda leaf: leaf[0], vars(found))
        return types.SimpleNamespace(**one)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "box_test.h5"
    write(path, category=BOX, split="test", **random_frames(FRAMES, 1500))
    return path


@pytest.fixture
def estimator(monkeypatch):
    """Stands for ``caper_jax.estimator``: its estimate is the identity, 1 m away, state 0."""

    def function(variables, points):
        pose = protocol.mean_predictor(BOX, MEAN_POSE, "card")((), points)
        return types.SimpleNamespace(pose=pose, plausible=jnp.ones(len(points), bool))

    model = Known(function)
    model.card = {"mean_pose": MEAN_POSE}
    monkeypatch.setattr("caper_jax.estimator.load", lambda *_, **__: model)
    return model


def run(path, out, *options):
    return cli.main(
        ["evaluate", "--category", "box", "--data", str(path), "--out", str(out), *options]
    )


def test_the_truth_scores_perfectly_from_file_to_report(path, tmp_path, capsys):
    assert run(path, tmp_path / "new" / "out", "--predictor", "truth") == 0
    metrics = json.loads((tmp_path / "new/out/metrics.json").read_text())
    assert list(metrics)[:9] == [
        *("category", "format", "split", "frames", "failures", "mask_source", "parts", "joints"),
        "seconds_per_frame",
    ]
    assert [metrics[key] for key in list(metrics)[:6]] == [
        *("box", "caper", "test", FRAMES, 0, "simulated")
    ]
    for tables in (metrics, metrics["up_to_symmetry"]):
        assert [part["name"] for part in tables["parts"]] == ["base", "lid"]
        for part in tables["parts"]:
            for statistic in ("mean", "median"):
                assert part["rotation_deg"][statistic] == part["translation_m"][statistic] == 0
                assert part["iou_full"][statistic] == part["iou_size"][statistic] == 1
        (joint,) = tables["joints"]
        assert (joint["type"], joint["state_unit"]) == ("revolute", "degrees")
        assert joint["axis_deg"]["mean"] == joint["pivot_m"]["mean"] == joint["state"]["mean"] == 0
    table = capsys.readouterr().out
    assert "21 frames, 0 failed" in table and "up to symmetry (" in table
    assert max(map(len, table.splitlines()[:-1])) <= 80


def test_errors_by_occlusion(tmp_path, estimator, capsys):
    """Table 8's bins, by the hidden share of the part itself; the bounds 0 and 1 are inside."""
    hidden = np.resize([0.0, 0.39, 0.4, 0.79, 0.8, 1.0], FRAMES)
    visibility = np.stack([1 - hidden, np.ones(FRAMES)], -1).astype(np.float32)
    path = tmp_path / "box.h5"
    frames = random_frames(FRAMES, 1500)
    write(path, category=BOX, split="test", visibility=visibility, **frames)
    assert run(path, tmp_path / "out") == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    saved = np.load(tmp_path / "out" / "predictions.npz")
    np.testing.assert_array_equal(saved["visibility"], visibility)
    distance = np.linalg.norm(saved["t"] - saved["truth_t"], axis=-1)
    places = np.resize([0, 0, 1, 1, 2, 2], FRAMES)
    for number, content in enumerate(metrics["by_occlusion"]):
        base, lid = content["parts"]
        chosen = places == number
        assert base["frames"] == chosen.sum()
        assert base["translation_m"]["mean"] == pytest.approx(distance[chosen, 0].mean(), rel=1e-4)
        assert lid["frames"] == (FRAMES if number == 0 else 0)
        assert ("translation_m" in lid) == (number == 0)
    assert "80-100 %" in capsys.readouterr().out


def test_errors_by_opening(path, tmp_path, estimator, capsys):
    assert run(path, tmp_path) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    saved = np.load(tmp_path / "predictions.npz")
    distance = np.linalg.norm(saved["t"] - saved["truth_t"], axis=-1)
    low, high = BOX.joints[0].limits
    places = np.digitize((saved["truth_joint_state"][:, 0] - low) / (high - low), [0.05, 0.25])
    assert set(places) >= {1, 2}
    for number, content in enumerate(metrics["by_opening"]):
        for part, meters in zip(content["parts"], distance[places == number].T, strict=True):
            assert part["frames"] == len(meters)
            if len(meters):
                assert part["translation_m"]["mean"] == pytest.approx(meters.mean(), rel=1e-4)
    assert "25-100 %" in capsys.readouterr().out


def test_the_joint_that_is_most_open_counts():
    """Bounds belong to the bin above them, and states beyond a limit count as the limit."""
    drawer = categories.get("drawer")
    low, high = drawer.joints[1].limits
    shares = np.array([-0.1, 0.0, 0.04, 0.05, 0.24, 0.25, 1.0, 1.1])
    states = np.zeros((len(shares), 3))
    states[:, 1] = low + shares * (high - low)
    values = np.arange(4.0 * len(shares)).reshape(-1, 4)
    errors = PoseErrors(**{f.name: values for f in dataclasses.fields(PoseErrors)})
    bins = errors_by_opening(errors, states, drawer)
    for content, rows in zip(bins, (values[:3], values[3:5], values[5:]), strict=True):
        assert [part["frames"] for part in content["parts"]] == [len(rows)] * 4
        means = [part["rotation_deg"]["mean"] for part in content["parts"]]
        np.testing.assert_allclose(means, rows.mean(0))


def test_glasses_open_as_their_states_fall_and_arms_not_at_all():
    glasses = categories.get("eyeglasses")
    errors = PoseErrors(**{f.name: np.zeros((1, 3)) for f in dataclasses.fields(PoseErrors)})
    folded = np.array([[joint.limits[1] for joint in glasses.joints]])
    bins = errors_by_opening(errors, folded, glasses)
    assert [content["parts"][0]["frames"] for content in bins] == [1, 0, 0]
    assert categories.get("robotarm").closed is None


def test_every_figure_can_be_computed_from_the_predictions(path, tmp_path, estimator):
    """SciPy and NumPy on predictions.npz and the dataset alone."""
    assert run(path, tmp_path) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["predictor"] == "model" and metrics["seconds_per_frame"] > 0
    saved = np.load(tmp_path / "predictions.npz", allow_pickle=False)
    dataset = Hdf5Dataset(path)
    assert saved["frame"].tolist() == list(dataset.names)
    assert not saved["failed"].any()
    for key, field in (("R", "rotation"), ("t", "translation"), ("joint_state", "joint_state")):
        truth = np.stack([getattr(dataset[i].truth, field) for i in range(FRAMES)])
        np.testing.assert_array_equal(saved[f"truth_{key}"], truth)
        assert saved[key].shape == truth.shape
    for k in range(2):
        relative = Rotation.from_matrix(saved["R"][:, k]).inv() * Rotation.from_matrix(
            saved["truth_R"][:, k]
        )
        degrees = np.degrees(relative.magnitude())
        distance = np.linalg.norm(saved["t"][:, k] - saved["truth_t"][:, k], axis=-1)
        sizes = saved["size"][:, k], saved["truth_size"][:, k]
        shared = np.minimum(*sizes).prod(-1)
        iou = shared / (sizes[0].prod(-1) + sizes[1].prod(-1) - shared)
        part = metrics["parts"][k]
        for name, values in (("rotation_deg", degrees), ("translation_m", distance)):
            assert part[name]["mean"] == pytest.approx(values.mean(), rel=1e-4)
            assert part[name]["median"] == pytest.approx(np.median(values), rel=1e-4)
        assert part["iou_size"]["mean"] == pytest.approx(iou.mean(), rel=1e-5)
        assert part["flipped"] == (degrees > 30).mean()
    axis, true_axis = saved["joint_axis"][:, 0], saved["truth_joint_axis"][:, 0]
    offset = saved["joint_pivot"][:, 0] - saved["truth_joint_pivot"][:, 0]
    joint = metrics["joints"][0]
    for name, values in (
        ("axis_deg", np.degrees(np.arccos((axis * true_axis).sum(-1)))),
        ("pivot_m", np.linalg.norm(np.cross(offset, true_axis), axis=-1)),
        ("state", np.degrees(np.abs(saved["joint_state"] - saved["truth_joint_state"]))),
    ):
        assert joint[name]["mean"] == pytest.approx(values.mean(), rel=1e-4)


def test_the_mean_stands_at_the_cloud_and_obeys_kinematics(path):
    dataset = Hdf5Dataset(path)
    frames = [dataset[i] for i in range(3)]
    points = np.stack([frame.points for frame in frames])
    pose = protocol.mean_predictor(BOX, MEAN_POSE, "card")(frames, points)
    root = np.array(MEAN_POSE["rotation"])
    expected = points.mean(1) + MEAN_POSE["offset"]
    np.testing.assert_allclose(pose.translation[:, 0], expected, atol=1e-6)
    lid = root @ Rotation.from_rotvec([-1.2, 0, 0]).as_matrix()
    np.testing.assert_allclose(pose.rotation[:, 1], np.tile(lid, (3, 1, 1)), atol=1e-6)
    hinge = np.array(MEAN_POSE["joint_pivot"][0])
    for k, rotation in enumerate((root, lid)):  # the hinge is where both parts have it
        found = rotation @ hinge + pose.translation[:, k]
        np.testing.assert_allclose(found, expected + root @ hinge, atol=1e-6)


def test_results_name_the_roll_that_the_model_was_told_of(path, tmp_path, estimator):
    for options, told in (((), False), (("--camera-roll", "-90"), True)):
        assert run(path, tmp_path, *options) == 0
        weights = json.loads((tmp_path / "metrics.json").read_text())["weights"]
        assert weights.endswith(", told of a camera roll of -90 deg") == told


def test_mean_predictor_runs_from_the_card(path, tmp_path, estimator, capsys):
    assert run(path, tmp_path, "--predictor", "mean", "--frames", "5") == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["frames"] == 5 and metrics["predictor"] == "mean"
    for broken, message in (
        (
            {k: v for k, v in MEAN_POSE.items() if k != "offset"},
            "mean_pose offset must be finite numbers (3,)",
        ),
        ({**MEAN_POSE, "size": [1, 2, 3]}, "mean_pose size must be finite numbers (2, 3)"),
    ):
        estimator.card = {"mean_pose": broken}
        assert run(path, tmp_path, "--predictor", "mean") == 2
        assert message in capsys.readouterr().err
    estimator.card = {}
    assert run(path, tmp_path, "--predictor", "mean") == 2
    assert "has no mean_pose" in capsys.readouterr().err


class Changed:
    """A dataset with some of its frames replaced."""

    def __init__(self, dataset, changes):
        self._dataset, self._changes = dataset, changes
        self.category, self.names = dataset.category, dataset.names
        self.format, self.split = dataset.format, dataset.split
        self.mask_source = dataset.mask_source

    def __len__(self):
        return len(self._dataset)

    def __getitem__(self, index):
        frame = self._dataset[index]
        return dataclasses.replace(frame, **self._changes.get(index, {}))


def test_the_worst_frames_are_named_and_drawn(path, tmp_path, monkeypatch, capsys):
    """Of an estimator that turns one frame by 90 deg, two by 60, and is right on the rest."""
    frames = Hdf5Dataset(path)
    turns = {frames[7].name: 90.0, frames[3].name: 60.0, frames[11].name: 60.0}
    known = [(loading.cloud_of(f, 1024), f) for f in (frames[i] for i in range(FRAMES))]

    clouds = jnp.stack([cloud for cloud, _ in known])
    truths = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[frame.truth for _, frame in known])
    angles = [[turns.get(frame.name, 0.0)] for _, frame in known]
    turned = jnp.asarray(Rotation.from_euler("x", angles, degrees=True).as_matrix(), jnp.float32)

    def function(variables, points):
        off = jnp.abs(points[:, None] - clouds).sum((-1, -2))
        index = off.argmin(1)
        pose = jax.tree.map(lambda leaf: leaf[index], truths)
        rotation = turned[index][:, None] @ pose.rotation
        labels = jnp.zeros(points.shape[:-1], jnp.int32)
        yes = jnp.ones(len(points), bool)
        return types.SimpleNamespace(
            pose=pose.replace(rotation=rotation),
            points=points,
            labels=labels,
            plausible=yes,
            reason=0 * index,
            size_ratio=1.0 * yes,
            hypotheses=None,
        )

    monkeypatch.setattr("caper_jax.estimator.load", lambda *_, **__: Known(function))
    assert run(path, tmp_path, "--worst", "2") == 0
    lines = capsys.readouterr().out.split("largest errors of rotation:")[1].splitlines()
    assert [line.split()[0] for line in lines[1:3]] == ["90.0", "60.0"]
    assert lines[1].endswith(frames[7].name) and lines[2].endswith(frames[3].name)
    assert "worst.png" in lines[-1] and (tmp_path / "worst.png").read_bytes()[:4] == b"\x89PNG"
    assert run(path, tmp_path, "--worst", "2", "--predictor", "truth") == 2
    assert "leave out --predictor" in capsys.readouterr().err


def test_frames_are_generated_as_it_goes(tmp_path, estimator, monkeypatch):
    """The same figures as from a file of ``caper generate``, up to how a file keeps points."""
    small = GeneratorConfig(instances=3, grid=24, num_points=300, measure_visibility=True)
    monkeypatch.setattr("caper_jax.reproduce.data.FRAME_DATA", small)
    out, file = tmp_path / "out", tmp_path / "box.h5"
    given = ["evaluate", "--category", "box", "--out", str(out)]
    assert cli.main([*given, "--generate", "9", "--seed", "4", "--noise", "gauss3mm"]) == 0
    one = json.loads((out / "metrics.json").read_text())
    assert (one["format"], one["split"], one["frames"]) == ("generated", "test", 9)
    drawn = ["--frames", "9", "--seed", "4", "--noise", "gauss3mm", "--instances", "3"]
    sizes = ["--points", "300", "--grid", "24"]
    assert cli.main(["generate", "--category", "box", "--out", str(file), *drawn, *sizes]) == 0
    assert cli.main([*given, "--data", str(file)]) == 0
    other = json.loads((out / "metrics.json").read_text())
    for a, b in zip(one["parts"], other["parts"], strict=True):
        assert a["rotation_deg"] == pytest.approx(b["rotation_deg"], rel=1e-5)
        assert a["translation_m"] == pytest.approx(b["translation_m"], rel=1e-3)
    assert one["by_occlusion"][0]["parts"][1]["frames"] > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "give either --data or --generate"),
        (["--generate", "5", "--data", "box.h5"], "give either --data or --generate"),
        (["--generate", "5", "--split", "val"], "--split goes with --data"),
        (["--data", "box.h5", "--seed", "3"], "--seed goes with --generate"),
        (["--generate", "0"], "--generate must be at least 1, got 0"),
    ],
)
def test_frames_come_from_one_place(tmp_path, capsys, options, message):
    assert cli.main(["evaluate", "--category", "box", "--out", str(tmp_path / "o"), *options]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "o").exists()


@pytest.mark.parametrize("name", ["eyeglasses", "robotarm"])
def test_tables_of_long_names_fit_a_terminal_and_say_what_is_flipped(name):
    category = categories.get(name)
    turn = np.full((4, category.num_parts), 12.3)
    turn[0] = 123.4
    others, joints = np.full_like(turn, 0.3), np.full((4, category.num_joints), 0.3)
    tables = report.error_tables(PoseErrors(turn, *[others] * 4, *[joints] * 3), category)
    lines = report.format_tables(tables)
    assert max(map(len, lines)) <= 80
    said = " ".join(lines[category.num_parts + 1 : lines.index("")])
    assert said == "flipped (over 30 deg): " + ", ".join(
        f"{part} 25.0 %" for part in category.parts
    )


def test_frames_that_fail_are_counted_not_dropped(path, tmp_path):
    dataset = Changed(Hdf5Dataset(path), {4: {"points": np.zeros((3, 3), np.float32)}})
    calls = []

    def predictor(frames, points):
        calls.append(points.shape)
        for cloud in points:  # the estimator refuses a batch with a cloud that it cannot use
            sample_points(cloud)
        pose = protocol.truth_predictor(frames, points)
        rotation = pose.rotation.copy()
        rotation[[frame.name == "000020" for frame in frames]] = np.nan
        return pose.replace(rotation=rotation)

    evaluation = protocol.evaluate(dataset, predictor)
    assert set(calls) == {(protocol.BATCH_SIZE, protocol.NUM_POINTS, 3)}
    assert np.flatnonzero(evaluation.failed).tolist() == [4, 20]
    result = report.summarize(evaluation, dataset, "model", "here")
    assert (result["frames"], result["failures"]) == (FRAMES, 2)
    assert result["parts"][0]["rotation_deg"]["mean"] == pytest.approx(2 * 180 / FRAMES)
    assert result["parts"][0]["flipped"] == 2 / FRAMES
    assert result["parts"][0]["iou_full"]["mean"] == pytest.approx((FRAMES - 2) / FRAMES)
    assert result["parts"][1]["rotation_deg"]["median"] == 0
    report.write_report(tmp_path, evaluation, result)
    saved = np.load(tmp_path / "predictions.npz")
    assert np.isnan(saved["joint_state"][[4, 20]]).all()
    assert not np.isnan(saved["joint_state"]).all(-1)[[0, 19]].any()
    assert not np.isnan(saved["truth_R"]).any()


def test_frames_without_good_truth_are_refused(path):
    dataset = Hdf5Dataset(path)
    truth = dataset[2].truth
    for change, message in (
        ({"truth": None}, "frame '000002' has no ground truth"),
        ({"truth": truth.replace(size=-truth.size)}, "ground truth of frame '000002': size must"),
    ):
        with pytest.raises(CaperError, match=message):
            protocol.evaluate(Changed(dataset, {2: change}), protocol.truth_predictor)


def test_clouds_are_spread_over_all_points(path):
    dataset = Hdf5Dataset(path)
    seen = []

    def predictor(frames, points):
        seen.append(points)
        return protocol.truth_predictor(frames, points)

    evaluation = protocol.evaluate(dataset, predictor, frames=2, batch_size=2, num_points=500)
    points = dataset[1].points
    np.testing.assert_array_equal(seen[0][1], points[raster_order(points)][1::3])
    assert evaluation.names == ["000000", "000001"]
    assert jax.tree.leaves(evaluation.estimate)[0].shape[0] == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--format", "artimages"], "unknown format 'artimages'"),
        (["--category", "bxo"], "unknown category 'bxo'; did you mean 'box'"),
        (["--split", "train"], "holds split 'test', not 'train'"),
        (["--data", "absent.h5"], "absent.h5: no such file"),
        (["--frames", "0"], "--frames must be at least 1, got 0"),
        (["--predictor", "best"], "invalid choice"),
    ],
)
def test_mistakes_are_one_line_and_code_2(path, tmp_path, capsys, options, message):
    assert run(path, tmp_path / "out", "--predictor", "truth", *options) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.out == ""
    assert captured.err.splitlines()[-1].startswith("caper evaluate: error: ")
    assert not (tmp_path / "out").exists()


def test_output_problems_are_found_before_any_work(path, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "caper_jax.data.readers.open_dataset", lambda *_: pytest.fail("began to work")
    )
    assert run(path, path, "--predictor", "truth") == 2
    assert "is a file; give a folder" in capsys.readouterr().err
    assert run(path, path / "below", "--predictor", "truth") == 2
    assert "is a file; give a folder" in capsys.readouterr().err


def test_reartmix_truth_scores_perfectly(shared_data, tmp_path, capsys):
    assert (
        cli.main(
            ["evaluate", "--category", "box", "--format", "reartmix", "--predictor", "truth"]
            + ["--data", str(shared_data / "reartmix_box"), "--out", str(tmp_path), "--frames", "8"]
        )
        == 0
    )
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["mask_source"] == "annotated polygons" and metrics["failures"] == 0
    assert metrics["parts"][1]["rotation_deg"]["mean"] == 0
    assert metrics["parts"][1]["iou_full"]["mean"] == 1


def test_errors_stand_with_and_without_what_is_implausible(path, tmp_path):
    """Every third frame is turned by 90 deg, and the predictor doubts it."""
    dataset, shown = Hdf5Dataset(path), []

    def predict(frames, points):
        number = len(shown) + np.arange(len(frames))
        shown.extend(frames)
        pose = protocol.truth_predictor(frames, points)
        angle = np.where(number % 3 == 0, 90.0, 0.0)
        turn = Rotation.from_euler("x", angle[:, None], degrees=True)
        rotation = pose.rotation @ turn.as_matrix()[:, None]
        return types.SimpleNamespace(
            pose=dataclasses.replace(pose, rotation=rotation), plausible=number % 3 != 0
        )

    compiled = iter([lambda *_: None])
    evaluation = protocol.evaluate(
        dataset, lambda *given: next(compiled, predict)(*given), batch_size=7
    )
    result = report.summarize(evaluation, dataset, "model", None)
    assert result["implausible"] == pytest.approx(1 / 3)
    for part, other in zip(result["parts"], result["plausible_only"]["parts"], strict=True):
        assert part["rotation_deg"]["mean"] == pytest.approx(30.0, abs=0.01)
        assert other["rotation_deg"]["mean"] == pytest.approx(0.0, abs=0.01)
    text = report.format_report(result)
    assert "33.3 % of frames; errors with and without them" in text
    assert max(map(len, text.splitlines())) <= 80
    report.write_report(tmp_path, evaluation, result)
    with np.load(tmp_path / report.PREDICTIONS_FILE) as stored:
        np.testing.assert_array_equal(stored["plausible"], np.arange(FRAMES) % 3 != 0)
