"""Exported models: equal to the package, run without it, described by their manifest."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest
from _helpers.tiny import network, random_variables

from caper_jax import categories, cli
from caper_jax.config import to_dict
from caper_jax.data.clouds import sample_points
from caper_jax.errors import CaperError
from caper_jax.estimator import Estimator
from caper_jax.export import MODEL_FILE, export_estimator, flat
from caper_jax.models.files import write_model

# What the runner may not need: finding any of these fails as if it were not installed.
WITHOUT_THE_PACKAGE = """
import runpy, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("caper_jax", "flax", "optax", "orbax"):
            raise ModuleNotFoundError(f"refused: {name}")
sys.meta_path.insert(0, Refuse())
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
assert not {"caper_jax", "flax"} & set(sys.modules)
"""


def estimator_of(name, encoder="fast"):
    category, config = categories.get(name), network(encoder, pool_first=True)
    parts, joints = category.num_parts, category.num_joints
    calibration = {
        "rotation": np.full((parts, 13), 0.1),
        "translation": np.full((parts, 13), 0.05),
        "state": np.full((joints, 13), 0.02),
        "low": np.full(12, -8.0),
        "high": np.full(12, 2.0),
    }
    card = {
        "category": name,
        "steps": 7,
        "run": {"network": to_dict(config)},
        "calibration": {key: value.tolist() for key, value in calibration.items()},
    }
    return Estimator(category, config, random_variables(category, config), card)


def clouds(batch, count=64, seed=0):
    rng = np.random.default_rng(seed)
    middle = [0.1, -0.1, 0.8] + rng.uniform(-0.2, 0.2, (batch, 1, 3))
    return (rng.uniform(-0.15, 0.15, (batch, count, 3)) + middle).astype(np.float32)


def assert_same(found, prediction, **tolerances):
    expected = flat(prediction)
    assert set(found) == set(expected)
    for name, value in expected.items():
        assert found[name].dtype == value.dtype, name
        np.testing.assert_allclose(found[name], value, err_msg=name, **tolerances)


@pytest.fixture(scope="module")
def drawer(tmp_path_factory):
    """An estimator whose joints slide, and the folder that it is exported to."""
    folder = tmp_path_factory.mktemp("export") / "drawer"
    estimator = estimator_of("drawer")
    export_estimator(estimator, folder)
    return estimator, folder


def test_a_process_without_the_package_finds_the_same(drawer, tmp_path):
    estimator, folder = drawer
    moved = shutil.copytree(folder, tmp_path / "elsewhere")
    both = clouds(2, 150)  # one after the other: the model takes one at a time
    both[:, 3], both[:, 7] = np.nan, 0.0
    np.save(tmp_path / "cloud.npy", both)
    files = [str(moved / "run.py"), str(tmp_path / "cloud.npy"), str(tmp_path / "poses.npz")]
    quick = {**os.environ, "XLA_FLAGS": "--xla_backend_optimization_level=0"}
    done = subprocess.run(
        [sys.executable, "-I", "-W", "error", "-c", WITHOUT_THE_PACKAGE, *files],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=quick,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    function = jax.jit(estimator.function)
    alone = [function(estimator.variables, sample_points(c, 64).points[None]) for c in both]
    expected = jax.tree.map(lambda *rows: np.concatenate(rows), *alone)
    with np.load(tmp_path / "poses.npz") as found:
        assert_same(found, expected, rtol=0, atol=1e-4)


def test_the_manifest_says_what_goes_in_and_comes_out(drawer):
    estimator, folder = drawer
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["category"] == "drawer" and manifest["platforms"] == ["cpu", "cuda"]
    assert manifest["card"] == {"steps": 7}
    assert manifest["inputs"]["points"]["shape"] == [1, 64, 3]
    points = clouds(1)
    expected = jax.eval_shape(
        lambda given: flat(estimator.function(estimator.variables, given)), points
    )
    assert set(manifest["outputs"]) == set(expected)
    for name, entry in manifest["outputs"].items():
        value = expected[name]
        assert (entry["shape"], entry["dtype"]) == (list(value.shape), value.dtype.name), name
        assert entry["meaning"].count(",", 0, entry["meaning"].index("]")) == value.ndim - 1, name
    assert manifest["outputs"]["joint_state"]["unit"] == ["meters"] * 3
    frames = {name: entry["frame"] for name, entry in manifest["outputs"].items()}
    assert set(frames.values()) - {""} == set(manifest["frames"])
    assert (frames["joint_axis"], frames["joint_axis_camera"]) == ("root_rest", "camera")
    assert [part["name"] for part in manifest["parts"]] == list(estimator.category.parts)
    assert [(j["parent"], j["child"], j["type"]) for j in manifest["joints"]] == [
        ("body", f"drawer{i}", "prismatic") for i in (1, 2, 3)
    ]


def test_the_weights_are_inside(drawer):
    estimator, folder = drawer
    weights = sum(leaf.nbytes for leaf in jax.tree.leaves(estimator.variables))
    assert (folder / MODEL_FILE).stat().st_size > weights
    assert sorted(path.name for path in folder.iterdir()) == [
        "manifest.json",
        "model.jax_export",
        "run.py",
    ]


def test_fixed_and_open_batches(tmp_path):
    estimator = estimator_of("laptop")
    points = clouds(2)
    expected = jax.jit(estimator.function)(estimator.variables, points)

    def exported(folder, batch):
        manifest = export_estimator(estimator, tmp_path / folder, ("cpu", "tpu"), batch)
        assert manifest["inputs"]["points"]["shape"] == [batch or "batch", 64, 3]
        assert manifest["outputs"]["rotation"]["shape"] == [batch or "batch", 2, 3, 3]
        return jax.jit(runpy.run_path(str(tmp_path / folder / "run.py"))["estimate"])

    assert_same(exported("two", 2)(points), expected, rtol=0, atol=1e-5)
    estimate = exported("any", None)
    # A program of its own: equal up to rounding, which the networks amplify.
    for size in (1, 2):
        first = jax.tree.map(lambda values, size=size: values[:size], expected)
        assert_same(estimate(points[:size]), first, rtol=0, atol=1e-4)


def test_the_encoder_of_the_paper_on_every_platform(tmp_path):
    plain = estimator_of("scissors", "hs")
    scaled = Estimator(plain.category.scaled(2.0), plain.network, plain.variables)
    manifest = export_estimator(scaled, tmp_path, ("tpu", "rocm", "cuda", "cpu", "cpu"), None)
    assert manifest["platforms"] == ["tpu", "rocm", "cuda", "cpu"]
    assert "rotation_std" not in manifest["outputs"]  # of a model that is not calibrated


def test_the_runner_is_short_and_refuses_clouds_of_few_points(drawer):
    _, folder = drawer
    code = [line for line in (folder / "run.py").read_text().splitlines() if line.strip()]
    assert len(code) <= 42  # eight of them are its docstring
    runner = runpy.run_path(str(folder / "run.py"))
    with pytest.raises(AssertionError, match="only 47 usable points"):
        runner["sample"](clouds(1)[0, :47])
    with pytest.raises(AssertionError, match="only 47 usable points differ"):
        runner["sample"](np.resize(clouds(1)[0, :47], (300, 3)))


def test_the_runner_says_how_it_is_used(drawer, monkeypatch):
    _, folder = drawer
    monkeypatch.setattr("sys.argv", ["run.py"])
    with pytest.raises(SystemExit, match=r"python run.py cloud.npy poses.npz: "):
        runpy.run_path(str(folder / "run.py"), run_name="__main__")


def test_the_runner_picks_the_points_that_the_package_picks(drawer):
    _, folder = drawer
    runner = runpy.run_path(str(folder / "run.py"))
    rng = np.random.default_rng(0)
    dense = rng.normal([0.0, 0.1, 1.0], [0.3, 0.2, 0.1], (20_000, 3)).astype(np.float32)
    dense[::100, 1] = np.resize([np.nan, np.inf, 3e38, -60.0], 200)  # no measurements, all
    picked = runner["sample"](dense)
    np.testing.assert_array_equal(picked, sample_points(dense, len(picked)).points)


def test_the_command_exports_a_model_of_ones_own(drawer, tmp_path, capsys):
    estimator, folder = drawer
    write_model(tmp_path / "model", estimator.variables, estimator.card)
    command = ["export", "--category", "drawer", "--weights", str(tmp_path / "model")]
    out = tmp_path / "a" / "b"
    options = ["--platform", "cpu", "--batch", "2", "--object-scale", "3", "--camera-roll", "-90"]
    assert cli.main([*command, *options, "--out", str(out)]) == 0
    assert f"written: {out}" in capsys.readouterr().out
    manifest, plain = (json.loads((f / "manifest.json").read_text()) for f in (out, folder))
    assert manifest["platforms"] == ["cpu"]
    assert manifest["inputs"]["points"]["shape"] == [2, 64, 3]
    rolls = [m["inputs"]["points"]["camera_roll_deg"] for m in (manifest, plain)]
    assert rolls == [-90.0, 0.0]
    for scaled, part in zip(manifest["parts"], plain["parts"], strict=True):
        np.testing.assert_allclose(scaled["mean_size"], 3 * np.array(part["mean_size"]))


def test_an_interrupted_export_leaves_no_manifest_of_another_model(drawer, tmp_path, monkeypatch):
    estimator, folder = drawer
    shutil.copytree(folder, tmp_path / "out")

    def full(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("caper_jax.export.write_atomically", full)
    with pytest.raises(OSError, match="No space left"):
        export_estimator(estimator, tmp_path / "out", ("cpu",))
    assert not (tmp_path / "out" / "manifest.json").exists()


def test_mistakes_are_one_line_and_code_2(drawer, tmp_path, capsys):
    estimator, _ = drawer
    write_model(tmp_path / "model", estimator.variables, estimator.card)
    weights = tmp_path / "model" / "weights.npz"
    (tmp_path / "file").write_text("")
    out = ["--out", str(tmp_path / "out")]
    own = ["--category", "drawer", "--weights", str(tmp_path / "model")]
    for arguments, message in (
        (["--category", "teapot", *out], "unknown category 'teapot'"),
        (["--category", "box", "--out", str(tmp_path / "file")], "is a file; give a folder"),
        (["--category", "box", *out, "--batch", "0"], "'0' is neither any nor a number"),
        ([*own, *out, "--platform", "gpu"], "unknown platform 'gpu'"),
        (["--category", "box", "--weights", str(tmp_path), *out], "it has no model.json"),
    ):
        assert cli.main(["export", *arguments]) == 2
        captured = capsys.readouterr()
        assert message in captured.err.splitlines()[-1] and captured.out == ""
    weights.write_bytes(weights.read_bytes()[:1000])
    assert cli.main(["export", *own, *out]) == 2
    assert "weights.npz is damaged" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_library_refuses_what_it_cannot_export(drawer, tmp_path):
    estimator, _ = drawer
    for options, message in (
        ({"platforms": ["cdua"]}, "did you mean 'cuda'"),
        ({"platforms": []}, "no platform"),
        ({"batch": 0}, "batch must be 1 or more"),
    ):
        with pytest.raises(CaperError, match=message):
            export_estimator(estimator, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
