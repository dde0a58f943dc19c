"""Benchmarks on tiny settings: that they run and report sane ratios. Nothing is timed."""

from __future__ import annotations

import json
import os

import jax
import numpy as np
import pytest
from _helpers import tiny

from benchmarks import __main__ as benchmark
from benchmarks import ceilings, cost_model, costs, gate, iou, processes, profile, timing, tracker
from benchmarks.models import chain, encoders, random_estimator
from caper_jax import categories, machine
from caper_jax import estimator as estimators
from caper_jax.config import PRESETS, preset
from caper_jax.errors import CaperError
from caper_jax.evaluation import protocol

BASELINE = {"estimator": 2.0, "log": 0.4}


@pytest.fixture
def few(monkeypatch):
    """The ceilings are 100 FLOP/s and 10 bytes/s."""
    monkeypatch.setattr(ceilings, "rates", lambda: (100.0, 10.0))


def run(capsys, tmp_path, *argv):
    """Rows of a benchmark, as its JSON has them."""
    report = tmp_path / "report.json"
    assert benchmark.main([*argv, "--keep-programs", "--json", str(report)]) == 0
    assert capsys.readouterr().out
    return json.loads(report.read_text())["rows"]


@pytest.mark.parametrize("name", [*benchmark.SUMMARIES, "--gate"])
def test_every_benchmark_has_help(name, capsys):
    with pytest.raises(SystemExit) as ended:
        benchmark.main([name, "--help"])
    assert ended.value.code == 0 and "--json" in capsys.readouterr().out


def test_medians_of_interleaved_runs():
    order = []
    calls = {name: lambda name=name: order.append(name) for name in "ab"}
    assert set(timing.interleaved(calls, 3)) == {"a", "b"}
    assert "".join(order) == "abababab"  # each once before, to compile


def test_rows_of_light_benchmarks(few, capsys, tmp_path):
    rows = run(capsys, tmp_path, "se3", "--twists", "64", "--repeats", "1")
    assert [row["function"] for row in rows] == ["exp", "log", "exp+log, gradient"]
    assert all(0 < row["error"] < 5e-6 and row["million_per_s"] > 0 for row in rows)

    (row,) = run(capsys, tmp_path, "iou", "--pairs", "64", "--repeats", "1")
    assert row["pairs"] == 64 and row["pairs_per_s"] > 0 and row["in_matmuls"] > 0
    overlap = np.asarray(iou.call(64)())
    assert (overlap > 0).mean() > 0.9 and overlap.max() < 1

    rows = run(capsys, tmp_path, "ceilings", "--size", "16", "--numbers", "99", "--repeats", "1")
    assert rows[0]["GB/s"] >= 0 and all(row["GFLOP/s"] >= 0 for row in rows[1:])

    arguments = ("--category", "box", "--grid", "16", "--batch", "3", "--repeats", "2")
    (row,) = run(capsys, tmp_path, "generator", *arguments)
    assert (row["category"], row["grid"], row["batch"]) == ("box", 16, 3)
    assert row["frames_per_s"] > 0 and row["GB/s"] > 0


def test_the_naive_encoder_is_the_same_function():
    points = np.random.default_rng(1).normal(size=(2, 64, 3)).astype(np.float32)
    weights, ours, naive = encoders(tiny.HS, points)
    weights = tiny.random_like(jax.eval_shape(lambda: weights))
    one, other = jax.jit(ours)(weights), jax.jit(naive)(weights)
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


def test_many_videos_at_once(few, monkeypatch):
    """Distinct ones repeat, in order, and every frame of each is shown."""
    shown = []

    def videos(category, count):
        points = np.random.default_rng(0).uniform(-0.1, 0.1, (count, 3, 64, 3)) + [0, 0, 0.8]
        return type("Batch", (), {"points": points.astype(np.float32)})

    several = tracker.several
    monkeypatch.setattr(tracker, "several", lambda points: shown.append(points) or several(points))
    monkeypatch.setattr(tracker, "_videos", videos)
    box = categories.get("box")
    weights = tiny.random_variables(box, tiny.network())
    model = estimators.Estimator(box, tiny.network(), weights)
    monkeypatch.setattr(estimators, "load", lambda *_: model)
    arguments = ["tracker", "--category", "box", "--videos", "5", "--repeats", "2"]
    (row,) = tracker.run(benchmark.build_parser().parse_args(arguments))
    assert row["category"] == "box" and row["videos"] == 5
    assert row["frames_per_s"] == pytest.approx(5000 / row["step_ms"], rel=0.01)
    assert len(shown) == 3 and shown[0].shape == (5, 64, 3)
    np.testing.assert_array_equal(shown[1][4], shown[1][0])
    assert (shown[1][1] != shown[1][0]).any()


def test_an_evaluation_beside_its_estimates(capsys, tmp_path, monkeypatch):
    """Both have all frames of the file, and the evaluation all errors."""
    box = categories.get("box")
    weights = tiny.random_variables(box, tiny.network())
    model = estimators.Estimator(box, tiny.network(), weights)
    monkeypatch.setattr(estimators, "load", lambda *_: model)
    measured, evaluations = protocol.evaluate, []
    monkeypatch.setattr(protocol, "evaluate", lambda *a, **k: evaluations.append(measured(*a, **k)))
    sizes = ("--frames", "9", "--batch", "8", "--points", "100", "--grid", "16")
    sizes = (*sizes, "--repeats", "1")
    (row,) = run(capsys, tmp_path, "evaluation", "--category", "box", *sizes)
    assert (row["frames"], row["batch"]) == (9, 8)
    ratio = 100 * row["evaluated_per_s"] / row["estimates_per_s"]
    assert row["ratio_%"] == pytest.approx(ratio, rel=0.05)
    assert [len(found.errors.rotation_deg) for found in evaluations] == [9, 9]


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_random_model_of_every_preset_estimates(name):
    """Also of chains longer than any category, as the benchmark of scaling measures them."""
    estimator = random_estimator(chain(5), preset(name).network)
    clouds = jax.ShapeDtypeStruct((2, 1024, 3), np.float32)
    prediction = jax.eval_shape(estimator.function, estimator.variables, clouds)
    assert prediction.pose.rotation.shape == (2, 5, 3, 3)


def test_costs_and_their_shares(few):
    x, y = np.ones((32, 64), np.float32), np.ones((64, 64), np.float32)
    lowered = jax.jit(lambda x, y: x @ y).lower(x, y)
    cost = costs.of(lowered, lowered.compile())
    assert cost.flops == pytest.approx(2 * 32 * 64 * 64, rel=0.01)
    row = costs.columns(costs.Costs(4e9, None), 2.0, times=3)
    assert row == {"GFLOP/s": 6.0, "of_matmul_%": 6e9, "GB/s": "-", "of_copy_%": "-"}


def test_stages_of_a_profile():
    medians = {"a": 0.002, "net": 0.006, "encoder": 0.005, "whole": 0.010}
    parts = {"first": ("a",), "encoder": ("encoder",), "heads": ("net", "encoder")}
    rows = profile.stages("estimator", parts, medians)
    milliseconds = {row["stage"]: row["ms"] for row in rows}
    assert milliseconds == {"first": 2.0, "encoder": 5.0, "heads": 1.0, "rest": 2.0}
    assert sum(row["share_%"] for row in rows) == pytest.approx(100)


@pytest.mark.parametrize(
    ("ratios", "slower"),
    [
        ({"estimator": 1.51, "log": 0.31}, []),  # 24.5 % and 22.5 %
        ({"estimator": 1.49, "log": 0.4}, ["estimator"]),
        ({"estimator": 9.0}, ["log"]),  # no longer measured
        ({"estimator": 2.0, "log": 0.4, "new": 0.01}, []),
    ],
)
def test_a_loss_of_a_quarter_is_named(ratios, slower, capsys):
    rows = list(gate.compare(ratios, BASELINE))
    assert [row["what"].strip() for row in rows if row["verdict"] == "slower"] == slower
    assert gate.verdict(rows) == bool(slower)
    message = capsys.readouterr().err
    assert all(name in message for name in slower)


def test_gate_measures_again_before_it_fails(monkeypatch, tmp_path, capsys):
    path = tmp_path / "baseline.json"
    path.write_text(json.dumps({"other": {"log": 9.0}, machine.processor(): BASELINE}))
    monkeypatch.setattr(gate, "measured", lambda: {name: (name, None) for name in BASELINE})
    ratios = {"estimator": iter([1.0, 2.1, 5.0]), "log": iter([0.1, 0.2, 0.5])}
    monkeypatch.setattr(gate, "ratio", lambda ours, reference, repeats: next(ratios[ours]))
    arguments = ["gate", "--keep-programs", "--baseline", str(path)]
    assert benchmark.main(arguments) == 1
    captured = capsys.readouterr()
    assert "log        " in captured.err and "-50 %" in captured.err
    assert "estimator" not in captured.err  # a busy moment, the second time it was as before

    assert benchmark.main([*arguments, "--update"]) == 0
    own = {"estimator": 5.0, "log": 0.5}
    assert gate.read_baselines(path) == {"other": {"log": 9.0}, machine.processor(): own}
    path.write_text('{"x": {"a": 0}}')
    with pytest.raises(CaperError, match=r"baseline\.json"):
        gate.read_baselines(path)


def test_the_committed_baseline():
    baselines = gate.read_baselines(gate.BASELINE)
    assert baselines and all(len(ratios) >= 8 for ratios in baselines.values())


def test_efficiency_is_the_rate_over_that_of_so_many_alone(monkeypatch):
    results = iter(
        [
            [{"step": 0.1}],
            [{"step": 0.1}, {"step": 0.2}],
            [{"step": 0.2, "all_reduce": 0.05, "reductions": 7}] * 2,
            [{"step": 0.125, "all_reduce": 0.05, "reductions": 1}] * 2,
        ]
    )
    monkeypatch.setattr(processes, "perform", lambda jobs, keep_programs: next(results))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {4, 5})
    arguments = benchmark.build_parser().parse_args(["processes", "--batch", "8"])
    alone, apart, together, local = processes.run(arguments)
    assert [row["samples_per_s"] for row in (alone, apart, together)] == [80, 120, 80]
    assert [row["efficiency_%"] for row in (alone, apart, together)] == [100, 75, 50]
    assert (together["all_reduce_ms"], together["all_reduces"]) == (50, 7)
    assert (local["efficiency_%"], local["all_reduces"]) == (80, 1)


def test_data_parallelism_on_paper(monkeypatch, capsys, tmp_path):
    """Eight devices use the links within a node, more the slower ones."""
    monkeypatch.setattr(cost_model, "network", lambda *_: cost_model.Network(8_000_000, 10))
    arguments = ("--model", "--preset", "fast", "--batch", "16", "--step-ms", "10")
    one, eight, many = run(capsys, tmp_path, "processes", *arguments)
    assert (one["efficiency_%"], one["samples_per_s"]) == (100, 1600)
    assert eight["all_reduce_ms"] == pytest.approx(1.75 * 8 / 450 + 14 * 0.003, abs=1e-3)
    assert eight["norms_ms"] == pytest.approx(20 * 6 * 0.003)
    assert many["all_reduce_ms"] == pytest.approx(126 / 64 * 8 / 50 + 126 * 0.01, abs=1e-3)
    whole = 10 + many["all_reduce_ms"] + many["norms_ms"]
    assert many["efficiency_%"] == pytest.approx(1000 / whole, abs=0.1)
