"""Training over several devices and several processes equals training on one device."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.config import TrainingConfig
from caper_jax.errors import CaperError
from caper_jax.training import parallel
from caper_jax.training.loop import fit
from caper_jax.training.optimizer import Optimizer
from caper_jax.training.run_directory import read_metrics
from caper_jax.training.step import TrainState, compile_step

REPOSITORY = Path(__file__).resolve().parents[2]
BATCH = 16


def batch_fn(key):
    """Random inputs and targets, with a scalar leaf; leading axis BATCH."""
    inputs = jax.random.normal(key, (BATCH, 5, 3))
    return {"x": inputs, "y": jnp.sin(inputs).sum((1, 2)), "scale": jnp.float32(2.0)}


def loss_fn(params, model_state, batch, key, progress):
    """A network with batch norm and noise: both couple or index the samples of a batch."""
    hidden = jnp.einsum("bnc,cd->bnd", batch["x"], params["in"]) + 0.1 * jax.random.normal(
        key, (len(batch["x"]), 1, 8)
    )
    mean = hidden.mean((0, 1))
    hidden = jnp.tanh((hidden - mean) / jnp.sqrt(hidden.var((0, 1)) + 1e-3))
    error = hidden.max(1) @ params["out"] - batch["y"] / batch["scale"]
    state = {"batch_stats": {"mean": 0.9 * model_state["batch_stats"]["mean"] + 0.1 * mean}}
    return jnp.mean(error**2), (state, {"worst": jnp.abs(error).max()})


def host_batch(seed):
    """A batch as a loader gives it: numpy, every leaf leads with the batch axis."""
    batch = batch_fn(jax.random.key(seed))
    return {"x": np.asarray(batch["x"]), "y": np.asarray(batch["y"])}


def fed_loss(params, model_state, batch, key, progress):
    return loss_fn(params, model_state, {**batch, "scale": 2.0}, key, progress)


def variables():
    rng = np.random.default_rng(0)
    return {
        "params": {
            "in": rng.normal(size=(3, 8)).astype(np.float32),
            "out": rng.normal(size=8).astype(np.float32),
        },
        "batch_stats": {"mean": np.zeros(8, np.float32)},
    }


def train(mesh, steps, batch_norm="global"):
    """(state, metrics) after some steps on generated batches."""
    optimizer = Optimizer("ranger", learning_rate=0.02)
    sharding = parallel.one_device() if mesh is None else parallel.replicated(mesh)
    state = parallel.place(TrainState.create(variables(), optimizer, 3), sharding)
    ones = np.ones(steps, np.float32)
    step = compile_step(loss_fn, optimizer, batch_fn=batch_fn, mesh=mesh, batch_norm=batch_norm)
    return step(state, ones, ones, None)


def assert_close(got, wanted):
    for (path, a), b in zip(
        jax.tree_util.tree_flatten_with_path(got)[0], jax.tree.leaves(wanted), strict=True
    ):
        np.testing.assert_allclose(
            np.asarray(a), np.asarray(b), rtol=2e-5, atol=2e-5, err_msg=str(path)
        )


def test_eight_devices_equal_one():
    one, one_metrics = train(None, 8)
    mesh = parallel.data_mesh()
    assert mesh.size == 8
    eight, eight_metrics = train(mesh, 8)
    assert_close(eight_metrics, one_metrics)
    assert_close(eight, one)
    assert one_metrics["loss"][-1] != one_metrics["loss"][0]
    assert len(eight.params.fast["in"].sharding.device_set) == 8


def test_local_batch_norm_is_the_mean_over_devices_that_see_their_own_rows_alone():
    mesh = parallel.data_mesh()
    gradient = jax.value_and_grad(loss_fn, has_aux=True)
    start, key, now = variables(), jax.random.key(5), jnp.float32(0.0)
    params, state = start.pop("params"), start
    batch = batch_fn(jax.random.key(11))
    rows = BATCH // mesh.size

    def of_device(d):
        own = {k: v[d * rows : (d + 1) * rows] if v.ndim else v for k, v in batch.items()}
        return gradient(params, state, own, jax.random.fold_in(key, d), now)

    each = [of_device(d) for d in range(mesh.size)]
    wanted = jax.tree.map(lambda *values: np.mean(values, 0), *each)
    compiled = (
        jax.jit(parallel.each_device(gradient, mesh))
        .lower(params, state, batch, key, now)
        .compile()
    )
    assert compiled.as_text().count(" all-reduce(") == 1
    assert_close(compiled(params, state, batch, key, now), wanted)
    whole = gradient(params, state, batch, key, now)
    assert abs(float(whole[0][0]) - float(wanted[0][0])) > 1e-3  # not what one device would see


def test_a_step_with_local_batch_norm_learns_and_keeps_one_state_everywhere():
    state, metrics = train(parallel.data_mesh(), 8, "local")
    assert metrics["applied"].all() and metrics["loss"][-1] < metrics["loss"][0]
    copies = [np.asarray(shard.data) for shard in state.params.fast["in"].addressable_shards]
    assert len(copies) == 8
    for copy in copies[1:]:
        np.testing.assert_array_equal(copy, copies[0])


def test_generated_batches_are_split_and_do_not_depend_on_the_number_of_devices():
    key, mesh = jax.random.key(11), parallel.data_mesh()
    wanted = jax.jit(batch_fn)(key)
    got = jax.jit(lambda k: parallel.constrain_batch(batch_fn(k), mesh))(key)
    assert got["x"].addressable_shards[0].data.shape == (BATCH // 8, 5, 3)
    np.testing.assert_array_equal(got["x"], wanted["x"])


def test_batches_from_the_host_are_split():
    batch = host_batch(1)
    placed = parallel.place_rows(batch, parallel.data_mesh())
    for name, value in batch.items():
        np.testing.assert_array_equal(placed[name], value)
        for index, shard in enumerate(placed[name].addressable_shards):
            np.testing.assert_array_equal(shard.data, value[2 * index : 2 * index + 2])


def test_a_batch_that_cannot_be_split_is_refused():
    mesh = parallel.data_mesh()
    parallel.check_batch_size(16, mesh)
    parallel.check_batch_size(15, None)
    with pytest.raises(CaperError, match="batch_size 15 cannot be split over 8 devices"):
        parallel.check_batch_size(15, mesh)


def test_a_process_number_out_of_range_is_refused():
    with pytest.raises(CaperError, match=r"process id 2 is not in 0\.\.1"):
        parallel.initialize("localhost:1", 2, 2)


WORKER = """
    import os, sys
    import jax
    jax.config.update("jax_num_cpu_devices", 2)
    from caper_jax.training import parallel
    port, rank, directory = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    parallel.initialize(f"localhost:{port}", 2, rank)
    import test_parallel
    assert jax.device_count() == 4 and jax.local_device_count() == 2
    assert parallel.agree([10.0 + rank, 1.0]) == [10.0, 1.0]
    stopped = test_parallel.run(directory, stop_at=6)  # only process 0 gets the signal
    assert not stopped.finished and int(stopped.state.step) == 7
    jax.distributed.shutdown()
"""


def run(directory, stop_at=None):
    """`fit` for twelve steps, stopped by a signal at a step if asked."""

    def batches(step):
        if step == stop_at and jax.process_index() == 0:
            signal.raise_signal(signal.SIGTERM)
        count = BATCH // jax.process_count()
        rows = slice(jax.process_index() * count, (jax.process_index() + 1) * count)
        return jax.tree.map(lambda values: values[rows], host_batch(100 + step))

    config = TrainingConfig(batch_size=BATCH, learning_rate=0.02, warmup=3, steps=12, log_steps=4)
    return fit(directory, config, fed_loss, variables(), batches=batches)


def test_two_processes_equal_one_and_their_run_may_go_on_in_one(tmp_path):
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = str(probe.getsockname()[1])
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests" / "training")]),
        "JAX_PLATFORMS": "cpu",
    }
    workers = [
        subprocess.Popen(
            [
                sys.executable,
                "-c",
                textwrap.dedent(WORKER),
                port,
                str(rank),
                str(tmp_path / "two"),
            ],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in (0, 1)
    ]
    try:
        outputs = [worker.communicate(timeout=120)[0] for worker in workers]
    finally:
        for worker in workers:
            worker.kill()
    for worker, output in zip(workers, outputs, strict=True):
        assert worker.returncode == 0, output
    assert "stopped at step 7" in outputs[0]

    # One process with one device takes over, and ends where it would have come alone.
    two, one = run(tmp_path / "two"), run(tmp_path / "one")
    assert two.finished and int(two.state.step) == int(one.state.step) == 12
    assert_close(two.state.replace(elapsed=0.0), one.state.replace(elapsed=0.0))
    for two_line, one_line in zip(
        read_metrics(tmp_path / "two" / "metrics.jsonl"),
        read_metrics(tmp_path / "one" / "metrics.jsonl"),
        strict=True,
    ):
        assert two_line["step"] == one_line["step"]
        np.testing.assert_allclose(two_line["loss"], one_line["loss"], rtol=2e-5)
