"""The commands in a row: generate, train, fine-tune, evaluate, estimate, on a tiny model."""

from __future__ import annotations

import json
import math
import shutil
import types
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from _helpers.frames import random_frames
from _helpers.tiny import network, random_variables

from caper_jax import categories, cli
from caper_jax.config import LoaderConfig, NetworkConfig, override, preset, to_dict
from caper_jax.data import hdf5
from caper_jax.errors import CaperError
from caper_jax.models.files import read_model, write_card, write_model
from caper_jax.training import train as run
from caper_jax.training.objective import Objective
from caper_jax.visualization.plots import training_curves

ROOT = Path(__file__).resolve().parents[2]
# A batch that no eight devices can share: compiling for one is faster.
TINY = ["--category", "box", "--config", str(ROOT / "configs" / "debug.toml")]
TINY += ["--training.batch-size", "3"]


@pytest.fixture(scope="module")
def whole_when_others_go_on():
    """Whether the model was complete, each time that processes would have waited for another."""
    return []


@pytest.fixture(scope="module")
def model(tmp_path_factory, whole_when_others_go_on):
    """A model directory trained for a few steps."""
    folder = tmp_path_factory.mktemp("run") / "box"
    agree = run.parallel.agree

    def waiting(values):
        card = folder / "model.json"
        whole_when_others_go_on.append(card.is_file() and "complete" in read_model(folder)[0])
        return agree(values)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run.parallel, "agree", waiting)
        assert cli.main(["train", *TINY, "--steps", "10", "--out", str(folder)]) == 0
    return folder


def test_a_run_leaves_a_model_with_its_card(model):
    card, variables = read_model(model)
    assert card["category"] == "box" and card["steps"] == 10 and card["samples"] == 30
    assert card["run"]["network"]["num_points"] == 128
    assert set(variables["params"]) == {"root", "parts"}
    assert np.shape(card["mean_pose"]["rotation"]) == (3, 3)
    lines = [json.loads(line) for line in (model / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [5, 10]
    assert all(math.isfinite(line["loss"]) and line["skipped"] == 0 for line in lines)
    assert (model / "curves.png").stat().st_size > 10_000
    lines[0]["root_deg"] = None  # a line of skipped steps
    drawn = training_curves("title", lines).lines
    np.testing.assert_array_equal(drawn["root [deg]"], [[10], [lines[1]["root_deg"]]])
    np.testing.assert_array_equal(drawn["loss"], [[5, 10], [line["loss"] for line in lines]])


def test_a_file_feeds_a_run_that_resumes_where_it_was(tmp_path, capsys):
    """Ten steps in one go, and again from the fourth on, end with the same weights."""
    file = tmp_path / "box.h5"
    hdf5.write(file, category=categories.get("box"), split="train", **random_frames(7, 256))
    feed = ["train", *TINY, "--training.checkpoint-steps=4", "--data", str(file)]
    steps = ["--steps", "10", "--out"]
    assert cli.main([*feed, *steps, str(tmp_path / "one")]) == 0
    card, variables = read_model(tmp_path / "one")
    assert card["run"]["loader"]["root"] == str(file) and card["steps"] == 10

    for step in ("8", "10"):  # as if killed after step 4
        shutil.rmtree(tmp_path / "one" / "checkpoints" / step)
    (tmp_path / "one" / "weights.npz").unlink()
    assert cli.main([*feed, *steps, str(tmp_path / "one")]) == 0
    jax.tree.map(np.testing.assert_array_equal, read_model(tmp_path / "one")[1], variables)

    # Three passes over 7 frames are 7 batches of 3, and the same command ends there again.
    for _ in range(2):
        assert cli.main([*feed, "--epochs", "3", "--out", str(tmp_path / "epochs")]) == 0
    card = read_model(tmp_path / "epochs")[0]
    assert card["steps"] == 7 and card["run"]["training"]["epochs"] == 3.0
    assert cli.main([*feed, "--epochs", "3", *steps, str(tmp_path / "epochs")]) == 2
    assert "one of --minutes, --steps and --epochs" in capsys.readouterr().err

    capsys.readouterr()
    assert cli.main([*feed, "--split", "val", *steps, str(tmp_path / "three")]) == 2
    assert "holds split 'train', not 'val'" in capsys.readouterr().err
    assert cli.main(["train", *TINY, "--format", "caper", *steps, str(tmp_path / "four")]) == 2
    assert "--format goes with --data" in capsys.readouterr().err


def test_a_run_that_ended_leaves_its_model_as_it_is(model, monkeypatch):
    """What was fitted afterwards would be lost; only where the end was cut short is it repeated."""
    card = read_model(model)[0]
    assert card["complete"]
    mine = {**card, "calibration": {"mine": 1}}
    write_card(model, mine)
    again = ["train", *TINY, "--steps", "10", "--out", str(model)]
    assert cli.main(again) == 0
    assert read_model(model)[0] == mine
    write_card(model, {**mine, "complete": None})
    assert cli.main(again) == 0
    assert read_model(model)[0] == card


def test_other_processes_wait_until_the_model_is_whole(model, whole_when_others_go_on):
    """One that ended while the first still fits the refiner would take the run down."""
    *before, last = whole_when_others_go_on
    assert last and not any(before)


def test_settings_of_the_loader_stand_beside_data(tmp_path, monkeypatch, capsys):
    configs = []
    ended = types.SimpleNamespace(finished=False, state=types.SimpleNamespace(step=0))
    monkeypatch.setattr(run, "train", lambda config, *_: configs.append(config) or ended)
    file = tmp_path / "mine.toml"
    file.write_text('[loader]\nformat = "artimage"\nroot = "there"\nworkers = 7\n')
    begin = ["train", "--category", "box", "--out", str(tmp_path / "run")]
    data = ["--config", str(file), "--data", "here", "--loader.prefetch", "9"]
    assert cli.main([*begin, *data]) == 130
    assert configs[0].loader == LoaderConfig("artimage", "here", workers=7, prefetch=9)
    assert cli.main([*begin, *data, "--format", "caper", "--split", "val"]) == 130
    assert configs[1].loader == replace(configs[0].loader, format="caper", split="val")
    file.write_text("[loader]\nworkers = 7\n")
    assert cli.main([*begin, *data]) == 130
    assert configs[2].loader == replace(configs[0].loader, format="caper")
    assert cli.main([*begin, "--loader.workers", "7"]) == 2
    assert "--loader.* goes with --data" in capsys.readouterr().err


def test_another_configuration_in_the_same_folder_is_refused(model, capsys):
    arguments = ["train", *TINY, "--set", "loss.state_penalty=7", "--steps", "10"]
    assert cli.main([*arguments, "--out", str(model)]) == 2
    assert "state_penalty" in capsys.readouterr().err


def test_evaluate_and_estimate_take_the_model(model, tmp_path, capsys):
    file, results = tmp_path / "test.h5", tmp_path / "results"
    common = ["--category", "box", "--frames", "5", "--instances", "3"]
    arguments = ["--grid", "24", "--points", "256", "--noise", "none", "--out", str(file)]
    assert cli.main(["generate", *common, *arguments]) == 0
    assert cli.main(["generate", *common, *arguments]) == 2  # refuses to overwrite
    assert str(file) in capsys.readouterr().err

    evaluate = ["evaluate", "--category", "box", "--data", str(file), "--format", "caper"]
    evaluate += ["--weights", str(model), "--out", str(results)]
    assert cli.main(evaluate) == 0
    metrics = json.loads((results / "metrics.json").read_text())
    assert metrics["frames"] == 5 and metrics["failures"] == 0
    arrays = np.load(results / "predictions.npz")
    assert arrays["R"].shape == (5, 2, 3, 3)
    # The printed means can be recomputed from the file.
    cosine = (np.einsum("fkij,fkij->fk", arrays["R"], arrays["truth_R"]) - 1) / 2
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean(axis=0)
    reported = [part["rotation_deg"]["mean"] for part in metrics["parts"]]
    np.testing.assert_allclose(degrees, reported, rtol=1e-3)

    points = tmp_path / "cloud.npy"
    np.save(points, np.random.default_rng(0).normal((0, 0, 0.7), 0.1, (500, 3)))
    out = tmp_path / "pose.json"
    estimate = ["estimate", "--category", "box", "--points", str(points), "--json", str(out)]
    assert cli.main([*estimate, "--weights", str(model)]) == 0
    assert [part["name"] for part in json.loads(out.read_text())["parts"]] == ["base", "lid"]


def test_a_model_starts_another_run_and_is_averaged_with_it(model, tmp_path, capsys, monkeypatch):
    """Into a folder with the model of another run, complete and of as many steps."""
    for name in ("weights.npz", "model.json"):
        shutil.copy(model / name, tmp_path)
    averaged, trained = run.averaged, []
    monkeypatch.setattr(run, "averaged", lambda *given: trained.append(given) or averaged(*given))
    # The program of the first run: another seed would be compiled again.
    begin = ["train", *TINY, "--steps", "10", "--from", str(model)]
    assert cli.main([*begin, "--init-weight-average", "0.75", "--out", str(tmp_path)]) == 0
    card, mixed = read_model(tmp_path)
    assert card["complete"] != read_model(model)[0]["complete"]
    assert card["started_from"]["steps"] == 10 and card["steps"] == 10
    assert "run" not in card["started_from"]
    assert card["samples_in_all"] == 2 * card["samples"] == 60
    first = read_model(model)[1]
    ((start, whole, share),) = trained
    assert share == 0.75
    jax.tree.map(np.testing.assert_array_equal, start, first)
    expected = jax.tree.map(lambda a, b: 0.75 * a + 0.25 * b, first, whole)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=2e-3, atol=1e-4), mixed, expected)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), first, whole)
    assert max(jax.tree.leaves(moved)) > 0.01
    # Ten small steps from there, not from anywhere.
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), first["params"], whole["params"])
    assert 0 < max(jax.tree.leaves(moved)) < 0.1

    # What the first model lacked was random there: it is as trained.
    new = {"params": {"head": {"kernel": np.ones(3, np.float32)}}}
    jax.tree.map(np.testing.assert_array_equal, averaged(first, new, 0.75), new)

    no_start = ["train", *TINY, "--steps", "10", "--init-weight-average", "0.5"]
    assert cli.main([*no_start, "--out", str(tmp_path / "none")]) == 2
    assert (
        "init_weight_average = 0.5 needs a model of 'box' to start from" in capsys.readouterr().err
    )
    begin = ["train", *TINY, "--steps", "10", "--init-weight-average", "1.0"]
    assert cli.main([*begin, "--out", str(tmp_path / "none")]) == 2
    assert "init_weight_average must be below 1, got 1.0" in capsys.readouterr().err


def test_a_run_from_a_model_has_its_network(model, tmp_path, monkeypatch):
    def configured(*options):
        configs = []
        ended = types.SimpleNamespace(finished=False, state=types.SimpleNamespace(step=0))
        monkeypatch.setattr(run, "train", lambda config, *_: configs.append(config) or ended)
        begin = ["train", "--category", "laptop", "--from", str(model), "--out", str(tmp_path)]
        assert cli.main([*begin, *options]) == 130
        return configs[0]

    whole = configured()
    sizes = read_model(model)[0]["run"]["network"]
    assert whole.category == "laptop" and to_dict(whole.network) == sizes
    assert whole.data.num_points == sizes["num_points"] == 128
    fast = preset("fast", "laptop")
    assert whole.loss == fast.loss and whole.training == fast.training
    wider = configured("--network.fast.width=24").network
    assert wider == replace(whole.network, fast=replace(whole.network.fast, width=24))
    assert configured("--preset", "paper") == preset("paper", "laptop")


@pytest.mark.parametrize(("encoder", "name"), [("hs", "paper"), ("one of my own", "fast")])
def test_a_run_from_a_model_is_of_the_preset_with_its_encoder(tmp_path, encoder, name):
    network = {"encoder": encoder, "refine_steps": 2}
    write_model(tmp_path, {}, {"run": {"network": network}})
    config = run.preset_of(tmp_path, "box")
    wanted = preset(name, "box")
    network = replace(
        NetworkConfig(encoder=encoder), refine_steps=2, num_points=wanted.data.num_points
    )
    assert config == replace(wanted, network=network)


def test_a_model_of_few_points_goes_on_with_more(tmp_path):
    """No weight depends on their number: most of a run may see a quarter of them."""
    few = network("hs", num_points=64)
    category = categories.get("box")
    card = {"category": "box", "run": {"network": to_dict(few)}}
    write_model(tmp_path, random_variables(category, few), card)
    more = ("network.num_points=256", "data.num_points=256")
    config = override(run.preset_of(tmp_path, "box"), *more)
    assert config.network == replace(few, num_points=256)
    assert config.loss == preset("paper").loss and config.training == preset("paper").training
    template = jax.eval_shape(Objective(category, config.network).init, jax.random.key(0))
    stored = read_model(tmp_path)[1]
    start = run.initial_variables(template, stored, tmp_path, same_category=True)
    jax.tree.map(np.testing.assert_array_equal, start, stored)


def test_all_categories_one_after_the_other(model, tmp_path, monkeypatch):
    shutil.copytree(model, tmp_path / "models")
    shutil.copytree(model, tmp_path / "models" / "drawer")
    called = []

    def train(config, directory, initial):
        called.append((config.category, config.training.minutes, directory, initial))
        finished = config.category != "laptop"
        return types.SimpleNamespace(finished=finished, state=types.SimpleNamespace(step=7))

    monkeypatch.setattr(run, "train", train)
    arguments = ["train", "--category", "all", "--from", str(tmp_path / "models")]
    assert cli.main([*arguments, "--minutes", "2", "--out", str(tmp_path)]) == 130
    names = categories.names()
    assert [call[0] for call in called] == list(names[: names.index("laptop") + 1])
    for name, minutes, directory, initial in called:
        own = tmp_path / "models" / "drawer" if name == "drawer" else tmp_path / "models"
        assert (minutes, directory, initial) == (2, tmp_path / name, own)


def test_a_model_of_another_category_gives_its_encoders():
    def variables(outputs, width, fill):
        sizes = {"encoder": (3, width), "state": (width, 4), "size": (4, outputs)}
        layers = {name: np.full(shape, fill, np.float32) for name, shape in sizes.items()}
        return {"params": {"parts": {name: {"kernel": k} for name, k in layers.items()}}}

    begin, stored = variables(6, 5, 0.0), variables(3, 5, 1.0)
    start = run.initial_variables(begin, stored, "there", same_category=False)
    parts = start["params"]["parts"]
    np.testing.assert_array_equal(parts["encoder"]["kernel"], 1.0)
    np.testing.assert_array_equal(parts["state"]["kernel"], np.zeros((5, 4)))
    np.testing.assert_array_equal(parts["size"]["kernel"], np.zeros((4, 6)))
    for other, same in ((variables(6, 7, 1.0), False), (stored, True)):
        with pytest.raises(CaperError, match="there: its weights are of another network"):
            run.initial_variables(begin, other, "there", same_category=same)


@pytest.mark.parametrize(
    ("setting", "parts"),
    [
        (["--calibration-frames=100"], ["calibration_frames", "2560", "100"]),
        (["--network.refiner.frames=500"], ["network.refiner.frames", "1024", "500"]),
        (["--network.fast.width=0"], ["network.fast.width", "at least 1", "0"]),
        (["--network.fast.scales", "0.1,0.0"], ["network.fast.scales.1", "0.001"]),
        (["--network.fast.scales=[]"], ["network.fast.scales"]),
        (["--network.rotation-classifier.margin=nan"], ["network.rotation_classifier.margin"]),
        (["--network.point-heads.dropout", "1.0"], ["network.point_heads.dropout", "below 1"]),
        (["--network.point-stride=200"], ["network.point_stride", "network.num_points = 128"]),
        (["--set", "loss.weights.twist=-1"], ["loss.weights.twist", "at least 0", "-1"]),
        (["--training.lerning-rate=1"], ["lerning_rate", "did you mean 'training.learning_rate'"]),
        (["--trainin.seed=1"], ["'trainin'", "did you mean 'training'"]),
        (["--training.seed"], ["--training.seed needs a value"]),
        (["--set", "category=drawer"], ["'category'", "network"]),
        (["--minutes=1"], ["--minutes, --steps and --epochs"]),
    ],
)
def test_what_cannot_be_done_is_said_before_a_run_begins(setting, parts, tmp_path, capsys):
    arguments = ["train", *TINY, "--network.refiner.width", "16", *setting]
    assert cli.main([*arguments, "--steps", "1", "--out", str(tmp_path / "run")]) == 2
    message = capsys.readouterr().err
    assert all(part in message for part in parts) and message.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_configuration_of_another_category_is_refused(tmp_path, capsys):
    file = tmp_path / "other.toml"
    file.write_text('category = "drawer"\n')
    arguments = ["train", "--category", "box", "--config", str(file), "--out", str(tmp_path)]
    assert cli.main(arguments) == 2
    assert "drawer" in capsys.readouterr().err


def test_calibrate_counts_frames_before_it_changes_a_model(model, capsys):
    before = {path.name: path.read_bytes() for path in model.iterdir() if path.is_file()}
    arguments = ["calibrate", "--category", "box", "--weights", str(model)]
    assert cli.main([*arguments, "--refiner", "--refiner-frames", "1024", "--frames", "100"]) == 2
    assert "320" in capsys.readouterr().err
    assert before == {path.name: path.read_bytes() for path in model.iterdir() if path.is_file()}


def test_unknown_key_names_the_nearest(tmp_path, capsys):
    file = tmp_path / "wrong.toml"
    file.write_text("[training]\nlerning_rate = 1e-3\n")
    arguments = ["train", "--category", "box", "--config", str(file), "--steps", "1"]
    assert cli.main([*arguments, "--out", str(tmp_path / "run")]) == 2
    message = capsys.readouterr().err
    assert "learning_rate" in message and str(file) in message and message.count("\n") == 1
