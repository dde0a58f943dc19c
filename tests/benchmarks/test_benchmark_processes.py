"""Data parallelism: rows from made-up times, real processes with a step of no work, the model."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks import __main__ as benchmark
from benchmarks import cost_model, processes, worker
from caper_jax.errors import CaperError
from caper_jax.estimator import load
from caper_jax.training import parallel

REPOSITORY = Path(__file__).resolve().parents[2]
LINK = cost_model.Link(bandwidth=100.0, latency=0.5)


def rows(*argv):
    arguments = benchmark.build_parser().parse_args(["processes", *argv])
    return list(processes.run(arguments))


def jobs(count, category="box"):
    """On whatever cores there are, one after the other."""
    cores = sorted(os.sched_getaffinity(0))
    coordinator = f"localhost:{processes._free_port()}"
    return [
        worker.Job(
            *(category, "fast", 4, 3, count, rank, True, "local"),
            *(cores[rank % len(cores)], coordinator),
        )
        for rank in range(count)
    ]


def test_efficiency_is_the_rate_over_that_of_so_many_alone(monkeypatch):
    found = iter(
        [
            [{"step": 0.1}],
            [{"step": 0.1}, {"step": 0.2}],
            [{"step": 0.2, "all_reduce": 0.05, "reductions": 7}] * 2,
            [{"step": 0.125, "all_reduce": 0.05, "reductions": 1}] * 2,
        ]
    )
    seen = []

    def perform(own, keep_programs):
        seen.append([(job.batch, job.rank, job.core, job.together, job.batch_norm) for job in own])
        return next(found)

    monkeypatch.setattr(processes, "perform", perform)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {9, 4, 5})
    alone, apart, together, local = rows("--batch", "8")
    assert seen == [
        [(8, 0, 4, False, "global")],
        [(8, 0, 4, False, "global"), (8, 1, 5, False, "global")],
        [(8, 0, 4, True, "global"), (8, 1, 5, True, "global")],
        [(8, 0, 4, True, "local"), (8, 1, 5, True, "local")],
    ]
    assert [row["samples_per_s"] for row in (alone, apart, together)] == [80, 120, 80]
    assert [row["efficiency_%"] for row in (alone, apart, together)] == [100, 75, 50]
    assert [row["step_ms"] for row in (alone, apart, together)] == [100, 200, 200]
    assert (apart["all_reduce_ms"], together["all_reduce_ms"]) == ("-", 50)
    assert together["all_reduces"] == 7
    assert (local["efficiency_%"], local["all_reduces"]) == (80, 1)


@pytest.mark.parametrize(
    ("cores", "argv", "message"),
    [
        ({0}, (), "2 processes need as many cores"),
        ({0, 1}, ("--step-ms", "5"), "belongs to --model"),
        ({0, 1}, ("--step-ms", "5", "--model"), "say which with --preset"),
    ],
)
def test_mistakes(cores, argv, message, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: cores)
    with pytest.raises(CaperError, match=message):
        rows(*argv)


STAND_IN = """
    import os, sys, time
    import jax, numpy as np
    from benchmarks import costs, training, worker

    def make(category, preset, batch, mesh, batch_norm):
        assert batch == 8 and batch_norm == "local" and mesh.size == jax.process_count() == 2
        assert len(os.sched_getaffinity(0)) == 1
        shapes = {"w": jax.ShapeDtypeStruct((3, 2), np.float32)}
        call = lambda: time.sleep(0.01)
        return training.Step(batch, call, costs.Costs(None, None), shapes, 2, 0.0, 0.0)

    training.make = make
    worker.main(sys.argv[1])
"""


def test_two_processes_meet(tmp_path, monkeypatch):
    (tmp_path / "stand_in.py").write_text(textwrap.dedent(STAND_IN))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(REPOSITORY), str(tmp_path)]))
    monkeypatch.setattr(processes, "_WORKER", "stand_in")
    found = processes.perform(jobs(2), keep_programs=False)
    assert len(found) == 2
    for result in found:
        assert result["step"] >= 0.01 and result["all_reduce"] > 0 and result["reductions"] == 2


def test_a_process_that_fails_is_not_waited_for(monkeypatch):
    """The first would wait for the second, which stumbles over what it was given."""
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    first, _ = jobs(2)
    with pytest.raises(CaperError, match="process id 5 is not"):
        processes.perform([first, worker.Job(**{**vars(first), "rank": 5})], keep_programs=False)


def test_sums_over_devices():
    mesh = parallel.data_mesh()
    shapes = {"a": jax.ShapeDtypeStruct((2, 3), np.float32), "b": jax.ShapeDtypeStruct((), "f4")}
    total = worker._all_reduce(shapes, mesh)()
    np.testing.assert_array_equal(total["a"], np.full((2, 3), mesh.size))
    assert float(total["b"]) == mesh.size


def test_one_message_is_as_long_as_all_arrays():
    shapes = {"a": jax.ShapeDtypeStruct((2, 3), np.float32), "b": jax.ShapeDtypeStruct((), "f4")}
    assert worker._flat(shapes) == jax.ShapeDtypeStruct((7,), np.float32)


@pytest.mark.parametrize(("devices", "seconds"), [(1, 0.0), (2, 1 + 2 * 0.5), (4, 1.5 + 6 * 0.5)])
def test_a_ring(devices, seconds):
    """2 (n - 1) / n of the bytes, and a latency per turn."""
    assert cost_model.ring_seconds(100, devices, LINK) == pytest.approx(seconds)


@pytest.mark.parametrize(("devices", "levels"), [(1, 0), (2, 1), (5, 3), (8, 3), (64, 6)])
def test_a_tree(devices, levels):
    assert cost_model.tree_seconds(devices, LINK) == 2 * levels * 0.5


def test_gradients_are_as_large_as_the_shipped_weights():
    weights = load("box").variables
    stages = {name: weights["params"][name] for name in ("root", "parts")}  # sides train alone
    sizes = [np.asarray(leaf).nbytes for leaf in jax.tree.leaves(stages)]
    found = cost_model.network("fast", "box")
    assert found.gradient_bytes == sum(sizes)
    assert 2 * found.norms == len(jax.tree.leaves(weights["batch_stats"]))


def test_the_model_on_paper(monkeypatch, capsys):
    """Eight devices use the links within a node, more the slower ones; steps are measured once."""
    monkeypatch.setattr(cost_model, "network", lambda *_: cost_model.Network(8_000_000, 10))
    monkeypatch.setattr(cost_model, "measured_step", lambda *_: 0.01)
    found = rows("--model", "--batch", "16")
    assert [(row["preset"], row["devices"]) for row in found] == [
        (preset, devices) for preset in ("fast", "paper") for devices in (1, 8, 64)
    ]
    one, eight, many = found[:3]
    assert (one["efficiency_%"], one["samples_per_s"]) == (100, 1600)
    assert eight["all_reduce_ms"] == pytest.approx(1.75 * 8 / 450 + 14 * 0.003, abs=1e-3)
    assert eight["norms_ms"] == pytest.approx(20 * 6 * 0.003)
    assert many["all_reduce_ms"] == pytest.approx(126 / 64 * 8 / 50 + 126 * 0.01, abs=1e-3)
    assert many["norms_ms"] == pytest.approx(20 * 12 * 0.01)
    whole = 10 + many["all_reduce_ms"] + many["norms_ms"]
    assert many["efficiency_%"] == pytest.approx(1000 / whole, abs=0.1)
    local = 1000 / (10 + many["all_reduce_ms"])
    assert many["batch_norms_local_%"] == pytest.approx(local, abs=0.1)

    given = ["--model", "--preset", "paper", "--step-ms", "80"]
    assert benchmark.main(["processes", *given]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2 + 3
