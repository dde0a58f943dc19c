"""Every example runs as it stands, is short, and uses public names alone."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import caper_jax

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "examples"
SCRIPTS = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
ALLOWED = {"caper_jax", "flax", "jax", "matplotlib", "numpy", "optax", "pyrealsense2", "small"}


def run(name: str, *arguments: str | Path) -> str:
    """What an example prints, run in a process of its own with warnings as errors."""
    (script,) = (path for path in SCRIPTS if path.name.startswith(name))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    command = [sys.executable, "-W", "error", script, *arguments]
    process = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert process.returncode == 0, process.stderr
    return process.stdout


def number_after(text: str, words: str) -> float:
    """The number that follows some words."""
    return float(text.split(words, 1)[1].split()[0].rstrip(",;"))


def test_there_is_one_of_each_number():
    assert [path.name[:2] for path in SCRIPTS] == [f"{number:02d}" for number in range(1, 18)]
    table = (FOLDER / "README.md").read_text()
    assert all(f"[{path.name}]({path.name})" in table for path in SCRIPTS)


@pytest.mark.parametrize("path", [*SCRIPTS, FOLDER / "small.py"], ids=lambda path: path.name)
def test_public_names_are_enough(path):
    source = path.read_text()
    assert len(source.splitlines()) <= 100
    tree = ast.parse(source)
    assert ast.get_docstring(tree)
    used = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                package, _, module = alias.name.partition(".")
                assert package in sys.stdlib_module_names | ALLOWED, alias.name
                assert package != "caper_jax" or not module, alias.name
        elif isinstance(node, ast.ImportFrom):
            package = (node.module or "").partition(".")[0]
            assert node.level == 0, ast.unparse(node)
            assert package in sys.stdlib_module_names | ALLOWED - {"caper_jax"}, ast.unparse(node)
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "caper":
            used.add(node.attr)
    assert used, "shows nothing of caper_jax"
    assert used <= set(caper_jax.__all__)


def test_estimate(tmp_path):
    text = run("01", "--out", tmp_path)
    assert "base: origin" in text
    assert (tmp_path / "estimate.png").stat().st_size > 10_000


def test_track(tmp_path):
    text = run("02", "--frames", "8", "--out", tmp_path)
    assert number_after(text, "joint of lid: off by") < 5
    assert "lost in 0 of 8 frames" in text
    assert (tmp_path / "track.png").stat().st_size > 5_000


def test_gradient_through_the_estimator(tmp_path):
    text = run("03", "--quick", "--out", tmp_path)
    slope = number_after(text, "slope along the weights' gradient")
    assert slope == pytest.approx(number_after(text, "by finite differences"), rel=0.1)
    assert 0 < number_after(text, "after one step on the weights:") < number_after(text, "loss")
    assert (tmp_path / "gradient.png").is_file()


def test_gradient_through_the_tracker(tmp_path):
    text = run("04", "--quick", "--frames", "3", "--out", tmp_path)
    sizes = [number_after(text, f"frame {frame}: |d state / d points| =") for frame in range(3)]
    assert all(0 < size < 1e4 for size in sizes)
    assert (tmp_path / "memory.png").is_file()


def test_training_resumes(tmp_path):
    first = run("05", "--quick", "--out", tmp_path)
    assert "4 steps: caper.load('box'" in first
    (file,) = (tmp_path / "box").glob("weights.*")
    weights = file.read_bytes()
    assert run("05", "--quick", "--out", tmp_path) == first
    assert file.read_bytes() == weights


def test_own_category(tmp_path):
    text = run("06", "--quick", "--out", tmp_path)
    assert number_after(text, "unit ") == pytest.approx(7.23, rel=0.05)
    assert (tmp_path / "faucets.png").stat().st_size > 10_000


def test_own_loss():
    text = run("07", "--quick", "--steps", "3")
    assert text.count("mm from their boxes") == 2


def test_own_encoder(tmp_path):
    text = run("08", "--quick", "--steps", "3", "--out", tmp_path)
    assert "in 3 steps" in text
    assert (tmp_path / "pointnet.png").is_file()


def test_own_reader(tmp_path):
    text = run("09", "--frames", "4", "--out", tmp_path)
    for part in ("base", "lid"):
        assert f"truth, {part}: 0.00 deg, IoU 1.000" in text


def test_many_seeds(tmp_path):
    small = ("--seeds", "2", "--steps", "3", "--batch-size", "2")
    text = run("10", *small, "--out", tmp_path)
    rows = text.splitlines()[-3:]
    assert all(row.count("+-") == 2 and "nan" not in row for row in rows)


def test_export_and_serve(tmp_path):
    text = run("11", "--out", tmp_path)
    assert number_after(text, "rotation: largest difference") < 1e-3


def test_live_camera():
    text = run("12", "--source", "generated", "--frames", "8")
    lines = text.splitlines()
    assert len(lines) == 8
    assert not any("lost" in line for line in lines)


def test_pose_refinement(tmp_path):
    text = run("13", "--starts", "1", "--out", tmp_path)
    assert 65 < number_after(text, "Gauss-Newton, twists:") <= 100
    descent = number_after(text, "gradient descent, twists:")
    assert 50 < descent <= 100
    assert descent > number_after(text, "gradient descent, Euler angles:")
    assert (tmp_path / "basin.png").stat().st_size > 10_000


def test_camera_calibration(tmp_path):
    text = run("14", "--quick", "--frames", "4", "--out", tmp_path)
    start, alone, _, both = (
        [number_after(line, words) for words in ("off by", "deg,", "focal by")]
        for line in text.splitlines()
        if "off by" in line
    )
    assert start[0] > 20 and start[1] > 300
    assert alone[2] == 5
    assert both[0] < 0.6 and both[1] < 6 and both[2] < 2
    assert both[1] < alone[1]
    assert (tmp_path / "calibration.png").stat().st_size > 10_000


def test_filter_is_learned(tmp_path):
    sizes = ("--frames", "3", "--videos", "1", "--points", "128", "--steps", "3")
    text = run("15", *sizes, "--out", tmp_path)
    learned = text.split("videos learned from:")[1]
    before, after = number_after(text, "learned from:"), number_after(learned, "before,")
    assert 0 < after < before < 20
    assert (tmp_path / "filter.png").is_file()


def test_joint_from_motion(tmp_path):
    text = run("16", "--frames", "10", "--out", tmp_path)
    assert "laptop, truth: revolute, axis 0.0" in text
    assert number_after(text, "laptop, motion: revolute, axis") < 5
    assert number_after(text.split("laptop, motion:")[1], "pivot") < 20
    assert number_after(text.split("laptop, motion:")[1], "state") < 1
    assert number_after(text, "drawer, motion: prismatic, axis") < 10
    assert number_after(text.split("drawer, motion:")[1], "state") < 6
    assert (tmp_path / "motion.png").stat().st_size > 10_000


def test_sensitivity(tmp_path):
    text = run("17", "--quick", "--draws", "60", "--out", tmp_path)
    for line in ("root rotation:", "root translation:", "joint of lid:"):
        sampled = number_after(text.split(line)[1], "by the Jacobian,")
        assert number_after(text, line) == pytest.approx(sampled, rel=0.25)
    assert (tmp_path / "sensitivity.png").stat().st_size > 10_000
