"""Benchmarks beside what the device can do, on tiny networks; no figure of time is asserted."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers import tiny
from _helpers.quick import quick_jit

from benchmarks import __main__ as benchmark
from benchmarks import (
    ceilings,
    costs,
    estimator,
    generator,
    timing,
    tracker,
    training,
)
from caper_jax import categories, cli
from caper_jax import estimator as estimators
from caper_jax.config import GeneratorConfig
from caper_jax.training import memory, parallel
from caper_jax.training import train as runs
from caper_jax.training.objective import Objective

BOX = categories.get("box")


@pytest.fixture(scope="module")
def weights():
    return tiny.random_variables(BOX, tiny.network())


@pytest.fixture
def few(weights, monkeypatch):
    """Programs compile fast, and the ceilings are 100 FLOP/s and 10 bytes/s."""
    monkeypatch.setattr(jax, "jit", quick_jit)
    monkeypatch.setattr(ceilings, "rates", lambda: (100.0, 10.0))


def parsed(*argv):
    return benchmark.build_parser().parse_args(argv)


class Program:
    """What says of its costs what it is told to."""

    def __init__(self, analysis):
        self.analysis = analysis

    def cost_analysis(self):
        if isinstance(self.analysis, Exception):
            raise self.analysis
        return self.analysis


@pytest.mark.parametrize(
    "analysis",
    [
        None,
        {},
        [],
        [{}],
        {"flops": -1.0, "bytes accessed": 0.0},
        {"flops": math.nan, "bytes accessed": math.inf},
        NotImplementedError(),
        RuntimeError("UNIMPLEMENTED"),
    ],
)
def test_costs_that_are_not_known(analysis, few):
    found = costs.of(Program(analysis), Program(analysis))
    assert found == costs.Costs(None, None)
    assert costs.columns(found, 1.0) == dict.fromkeys(costs.COLUMNS, "-")


def test_rates_and_their_shares(few):
    found = costs.of(Program([{"flops": 4e9}]), Program({"bytes accessed": 6e9, "flops": 1.0}))
    assert found == costs.Costs(4e9, 6e9)
    row = costs.columns(costs.Costs(4e9, None), 2.0, times=3)
    assert row == {"GFLOP/s": 6.0, "of_matmul_%": 6e9, "GB/s": "-", "of_copy_%": "-"}
    row = costs.columns(costs.Costs(None, 6e9), 2.0)
    assert row == {"GFLOP/s": "-", "of_matmul_%": "-", "GB/s": 3.0, "of_copy_%": 3e10}


def test_costs_of_a_product_and_of_one_in_a_loop():
    """The compiler counts the product exactly, and that of a loop once."""

    def looped(x, y):
        return jax.lax.scan(lambda h, _: (h @ y, None), x, None, length=7)[0]

    x, y = np.ones((32, 64), np.float32), np.ones((64, 64), np.float32)
    for function in (lambda x, y: x @ y, looped):
        lowered = quick_jit(function).lower(x, y)
        found = costs.of(lowered, lowered.compile())
        assert found.flops == pytest.approx(2 * 32 * 64 * 64, rel=0.01)
        assert found.bytes >= 4 * (2 * 32 * 64 + 64 * 64)


def test_ceilings(monkeypatch):
    """The operations are what they are called, and the rates follow from made-up times."""
    calls = ceilings.calls(16, 100)
    assert calls["copy"]().shape == (100,)
    found = [calls[f"product, {name}"]() for name in ("float32", "float32 highest", "bfloat16")]
    assert [x.dtype for x in found] == [jnp.float32, jnp.float32, jnp.bfloat16]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found[2].astype(jnp.float32), found[1], rtol=0.1, atol=0.3)

    monkeypatch.setattr(timing, "interleaved", lambda calls, repeats: dict.fromkeys(calls, 1e-6))
    rows = list(ceilings.run(parsed("ceilings", "--size", "16", "--numbers", "100")))
    assert [row["GB/s"] for row in rows] == [0.8, "-", "-", "-"]
    assert [row["GFLOP/s"] for row in rows] == ["-", 8.2, 8.2, 8.2]
    monkeypatch.setattr(ceilings, "sizes", lambda: (16, 100))
    assert ceilings.rates.__wrapped__() == pytest.approx((8.192e9, 8e8))


@pytest.mark.parametrize("kept", [False, True])
def test_kept_programs(kept, monkeypatch, capsys):
    """Without them programs are compiled anew; with them no time of compilation is told."""
    anew = []
    monkeypatch.setattr(benchmark, "_compile_anew", lambda: anew.append(True))
    monkeypatch.setattr(generator, "run", lambda arguments: iter([{"compile_s": 12.5}]))
    assert cli.main(["benchmark", "generator", *["--keep-programs"] * kept]) == 0
    output = capsys.readouterr().out
    assert anew == [True] * (not kept)
    assert ("12.5" in output, "programs kept" in output) == (not kept, kept)


@pytest.mark.parametrize("batch", [1, 3])
def test_an_estimate_on_the_device_is_the_estimators(batch, few, weights):
    model = estimators.Estimator(BOX, tiny.network(), weights)
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (batch, 64, 3)).astype(np.float32)
    points[..., 2] += 0.8
    call, cost = estimator._call(model, points)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), call(), model(points))
    assert cost.flops and cost.bytes


def test_clouds_of_a_large_batch_need_no_more_shapes(monkeypatch):
    built = []

    class Generator:
        def __init__(self, category, config, split):
            built.append(config.instances)

        def batch(self, key, count):
            return type("Batch", (), {"points": np.zeros((count, 8, 3))})

    from benchmarks import models

    monkeypatch.setattr("caper_jax.synthetic.frames.Generator", Generator)
    assert models.clouds(BOX, 1000).shape == (1000, 8, 3)
    assert built == [200]


def test_many_videos_at_once(few, weights, monkeypatch):
    """Distinct ones repeat, in order, and every frame of each is shown."""
    shown = []

    def videos(category, count):
        points = np.random.default_rng(0).uniform(-0.1, 0.1, (count, 3, 64, 3)) + [0, 0, 0.8]
        return type("Batch", (), {"points": points.astype(np.float32)})

    several = tracker.several
    monkeypatch.setattr(tracker, "several", lambda points: shown.append(points) or several(points))
    monkeypatch.setattr(tracker, "_videos", videos)
    model = estimators.Estimator(BOX, tiny.network(), weights)
    monkeypatch.setattr(estimators, "load", lambda *arguments: model)
    (row,) = tracker.run(parsed("tracker", "--category", "box", "--videos", "5", "--repeats", "2"))
    assert row["category"] == "box" and row["videos"] == 5
    assert row["frames_per_s"] == pytest.approx(5000 / row["step_ms"], rel=0.01)
    assert len(shown) == 3 and shown[0].shape == (5, 64, 3)
    np.testing.assert_array_equal(shown[1][4], shown[1][0])
    assert (shown[1][1] != shown[1][0]).any()
    assert row["GFLOP/s"] > 0 and row["memory_MB"] > 0


@pytest.fixture
def tiny_preset(monkeypatch):
    data = GeneratorConfig(instances=5000, grid=16, num_points=64)
    monkeypatch.setattr(
        runs, "preset", lambda name, category: runs.RunConfig(category, tiny.network(), data)
    )


@pytest.mark.parametrize("count", [1, 3])
def test_steps_of_training(count, few, tiny_preset, monkeypatch):
    """Several per call, or one whose batch eight devices share: they sum at least the gradient."""
    variables = {"params": {"shift": np.ones(3, np.float32)}}
    monkeypatch.setattr(Objective, "init", lambda task, key: variables)

    def loss(task, params, model_state, batch, key, progress):
        """In place of the networks', which compile for half a minute."""
        assert batch.points.shape == (8, 64, 3)
        return jnp.mean((batch.points - params["shift"]) ** 2), (model_state, {})

    monkeypatch.setattr(Objective, "__call__", loss)
    monkeypatch.setattr(memory, "value_and_grad", jax.value_and_grad)  # it has no stages
    mesh = parallel.data_mesh() if count == 1 else None
    step = training.make("box", "fast", 8, count, mesh)
    assert step.batch == 8 and step.gradients["shift"].shape == (3,)
    assert [int(step.call()) for _ in range(2)] == [count, 2 * count]
    assert (step.reductions > 0) == (mesh is not None)
    assert step.costs.flops and step.megabytes > 0 and step.compile_seconds > 0


def test_frames_of_the_generator(few):
    arguments = parsed(
        "generator", "--category", "box", "--grid", "16", "--batch", "3", "--repeats", "2"
    )
    (row,) = generator.run(arguments)
    assert (row["category"], row["grid"], row["batch"]) == ("box", 16, 3)
    assert row["frames_per_s"] == pytest.approx(3000 / row["ms_per_batch"], rel=0.05)
    assert row["GB/s"] > 0
