"""The loop: same bits after any interruption, honest metrics, budgets, clean stops."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.config import LoaderConfig, TrainingConfig, preset, to_dict
from caper_jax.errors import CaperError
from caper_jax.training import loop
from caper_jax.training.loop import fit
from caper_jax.training.optimizer import flat_and_anneal
from caper_jax.training.run_directory import check_configuration, read_metrics
from caper_jax.training.step import compile_step, data_key

REPOSITORY = Path(__file__).resolve().parents[2]
BATCH = 8


def batch_fn(key):
    inputs = jax.random.normal(key, (BATCH, 3))
    return {"x": inputs, "y": jnp.sin(inputs)}


def loss_fn(params, model_state, batch, key, progress):
    noise = 0.01 * jax.random.normal(key, batch["x"].shape)
    error = jnp.tanh((batch["x"] + noise) @ params["kernel"] + params["bias"]) - batch["y"]
    seen = model_state["batch_stats"]["mean"]
    mean = 0.9 * seen + 0.1 * batch["x"].mean(0)
    return jnp.mean(error**2), (
        {"batch_stats": {"mean": mean}},
        {"worst": jnp.abs(error).max(), "progress": progress},
    )


def variables(width: int = 0):
    """Width > 0 adds idle weights, so that saving takes a while."""
    params = {"kernel": np.zeros((3, 3), np.float32), "bias": np.zeros(3, np.float32)}
    if width:
        params["idle"] = np.zeros((width, 1000), np.float32)
    return {"params": params, "batch_stats": {"mean": np.zeros(3, np.float32)}}


def config(**changes):
    given = {"batch_size": BATCH, "learning_rate": 0.2, "warmup": 5, "log_steps": 10}
    return TrainingConfig(**{**given, "steps": 60, **changes})


def without_clock(state):
    return state.replace(elapsed=0.0)


def assert_same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


def metrics_of(directory):
    """The lines of metrics.jsonl without what a clock wrote."""
    lines = read_metrics(Path(directory) / "metrics.jsonl")
    return [{k: v for k, v in line.items() if k not in ("seconds", "rate")} for line in lines]


def host_batches(stop_at=None, bad=()):
    """The batches of `batch_fn`, from the host; signals at a step, NaN at others."""
    seed = jnp.uint32(0)

    def batches(step):
        if step == stop_at:
            signal.raise_signal(signal.SIGTERM)
        batch = jax.tree.map(np.array, batch_fn(data_key(seed, jnp.int32(step))))
        if step in bad:
            batch["x"][0, 0] = np.nan
        return batch

    return batches


@pytest.fixture(scope="module")
def unkilled(tmp_path_factory):
    directory = tmp_path_factory.mktemp("unkilled")
    result = fit(directory, config(), loss_fn, variables(), batch_fn=batch_fn)
    return types.SimpleNamespace(directory=directory, state=result.state, finished=result.finished)


# The loop


def test_training_learns(unkilled):
    losses = [line["loss"] for line in metrics_of(unkilled.directory)]
    assert unkilled.finished and len(losses) == 6
    assert losses[-1] < 0.6 * losses[0]


def test_metrics_are_averages_and_the_factor_is_the_schedule(unkilled):
    lines = metrics_of(unkilled.directory)
    assert [line["step"] for line in lines] == [10, 20, 30, 40, 50, 60]
    for line in lines:
        done = line["step"] - 10 + np.arange(10)
        assert line["progress"] == pytest.approx(np.mean(done / 60), rel=1e-5)
        last = line["step"] - 1
        assert line["factor"] == pytest.approx(flat_and_anneal(last / 60, last, 5), rel=1e-5)
        assert line["skipped"] == 0 and line["worst"] > 0 and line["gradient_norm"] > 0


def test_data_from_the_host_and_arrays_for_the_generator_give_the_same_run(tmp_path, unkilled):
    def shifted(key, data):
        batch = batch_fn(key)
        return {**batch, "x": batch["x"] + data["zero"]}

    data = {"zero": np.zeros(3, np.float32)}
    given = fit(tmp_path / "data", config(), loss_fn, variables(), batch_fn=shifted, data=data)
    host = fit(tmp_path / "host", config(), loss_fn, variables(), batches=host_batches())
    for result in (given, host):
        for a, b in zip(
            jax.tree.leaves(without_clock(result.state)),
            jax.tree.leaves(without_clock(unkilled.state)),
            strict=True,
        ):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_a_stopped_run_resumes_to_the_same_bits(tmp_path, capsys, monkeypatch):
    """SIGTERM in the first dispatch, amid a line of metrics; the last dispatch is a short one."""
    settings = config(steps=6, steps_per_dispatch=4, log_steps=3)
    straight = fit(tmp_path / "a", settings, loss_fn, variables(), batch_fn=batch_fn)

    def make_stopping_step(*args, **kwargs):
        step = compile_step(*args, **kwargs)

        def stopping(*given):
            signal.raise_signal(signal.SIGTERM)
            return step(*given)

        return stopping

    with monkeypatch.context() as patch:
        patch.setattr(loop, "compile_step", make_stopping_step)
        first = fit(tmp_path / "b", settings, loss_fn, variables(), batch_fn=batch_fn)
    assert not first.finished and int(first.state.step) == 4
    assert "stopped at step 4; the same command resumes" in capsys.readouterr().err
    last = fit(tmp_path / "b", settings, loss_fn, variables(), batch_fn=batch_fn)
    assert last.finished and int(last.state.step) == 6
    assert_same_bits(without_clock(last.state), without_clock(straight.state))
    assert metrics_of(tmp_path / "b") == metrics_of(tmp_path / "a")
    assert [line["step"] for line in metrics_of(tmp_path / "b")] == [3, 6]
    assert last.state.elapsed > first.state.elapsed > 0


def test_skipped_steps_are_counted_and_left_out_of_the_averages(tmp_path):
    result = fit(
        tmp_path, config(steps=20), loss_fn, variables(), batches=host_batches(bad={3, 4, 12})
    )
    assert int(result.state.skipped) == 3
    first, second = metrics_of(tmp_path)
    assert (first["skipped"], second["skipped"]) == (2, 3)
    applied = [s for s in range(10) if s not in (3, 4)]
    assert first["progress"] == pytest.approx(np.mean(applied) / 20, rel=1e-5)
    assert np.isfinite(first["loss"]) and np.isfinite(second["loss"])


def test_a_diverged_run_stops_and_names_the_step(tmp_path):
    batches = host_batches(bad=set(range(13, 100)))
    with pytest.raises(CaperError, match=r"not finite in the 5 steps up to step 18"):
        fit(tmp_path, config(max_bad_steps=5), loss_fn, variables(), batches=batches)


class Clock:
    """A clock that moves by a fixed time whenever it is read."""

    def __init__(self, tick):
        self.now, self.tick = 0.0, tick

    def monotonic(self):
        self.now += self.tick
        return self.now


def test_a_run_bounded_by_minutes_uses_them_up_over_resumes(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "time", Clock(tick=0.25))
    settings = config(steps=None, minutes=0.5, log_steps=1)
    first = fit(tmp_path, settings, loss_fn, variables(), batches=host_batches(stop_at=8))
    assert not first.finished and int(first.state.step) == 9
    last = fit(tmp_path, settings, loss_fn, variables(), batches=host_batches())
    assert last.finished and float(last.state.elapsed) == pytest.approx(30, abs=2)

    lines = metrics_of(tmp_path)
    assert [line["step"] for line in lines] == list(range(1, int(last.state.step) + 1))
    progress = [line["progress"] for line in lines]
    assert np.all(np.diff(progress) > 0) and progress[0] < 0.1 and 0.9 < progress[-1] < 1
    for step, line in enumerate(lines):
        wanted = flat_and_anneal(line["progress"], step, settings.warmup)
        assert line["factor"] == pytest.approx(wanted, abs=1e-5)
    # A finished run is left as it is.
    again = fit(tmp_path, settings, loss_fn, variables(), batches=host_batches())
    assert again.finished
    assert_same_bits(without_clock(again.state), without_clock(last.state))


def test_compiling_is_not_training(tmp_path, monkeypatch):
    clock = Clock(tick=0.25)
    monkeypatch.setattr(loop, "time", clock)

    def slow_at_first(*arguments, **options):
        step, called = compile_step(*arguments, **options), []

        def call(*arguments):
            clock.now += 0.0 if called else 100.0
            called.append(True)
            return step(*arguments)

        return call

    monkeypatch.setattr(loop, "compile_step", slow_at_first)
    settings = config(steps=None, minutes=0.5)
    result = fit(tmp_path, settings, loss_fn, variables(), batches=host_batches())
    assert result.finished and int(result.state.step) > 10
    assert float(result.state.elapsed) == pytest.approx(30, abs=2)


def test_epochs_need_to_know_how_many_frames_there_are(tmp_path):
    given = config(steps=None, epochs=2.0)
    with pytest.raises(CaperError, match=r"training\.epochs = 2\.0 needs a dataset"):
        fit(tmp_path, given, loss_fn, variables(), batches=host_batches())
    assert not list(tmp_path.iterdir())


def test_another_configuration_is_refused_by_key(tmp_path, unkilled):
    def resume(settings, description=None):
        return fit(
            unkilled.directory,
            settings,
            loss_fn,
            variables(),
            batch_fn=batch_fn,
            description=description,
        )

    with pytest.raises(CaperError, match=r"training.learning_rate \(0.2 there, 0.1 now\)") as e:
        resume(config(learning_rate=0.1, seed=4))
    assert "training.seed" in str(e.value) and "batch_size" not in str(e.value)
    with pytest.raises(CaperError, match=r"network.width \('absent' there, 64 now\)"):
        resume(config(), {"network": {"width": 64}})
    many = {f"setting{i}": i for i in range(20)}
    with pytest.raises(
        CaperError, match=r"setting0 \('absent' there, 0 now\), .*, 12 settings more;"
    ):
        resume(config(), many)
    with pytest.raises(CaperError, match="it started from other weights"):
        resume(config(), {"initial": {"steps": 3, "run": many}})
    free = config(checkpoint_minutes=1.0, checkpoint_steps=7, keep_checkpoints=1)
    assert_same_bits(resume(free).state.params, unkilled.state.params)


def test_a_run_resumes_when_settings_with_defaults_were_added_since(tmp_path):
    now = to_dict(preset("fast", "box"))
    now["loader"] = to_dict(LoaderConfig("caper", "box.h5"))
    older = json.loads(json.dumps(now))
    del older["training"]["save_memory"], older["network"]["refiner"]["iterations"]
    del older["loader"]["split"], older["init_weight_average"], older["network"]["increment"]
    (tmp_path / "config.json").write_text(json.dumps(older))
    check_configuration(tmp_path, now)
    now["network"]["increment"] = "euclidean"
    with pytest.raises(CaperError, match=r": network.increment \('lie' there, 'euclidean' now\);"):
        check_configuration(tmp_path, now)
    # What has no default, and what this version does not know, is named.
    del older["network"]["encoder"], older["loader"]["root"]
    older["network"] |= {"encoder": "fast", "turn_width": 64}
    older["loss"]["turned"] = 0.2
    (tmp_path / "config.json").write_text(json.dumps(older))
    now["network"]["increment"] = "lie"
    with pytest.raises(CaperError) as error:
        check_configuration(tmp_path, now)
    for text in ("loader.root ('absent'", "loss.turned (0.2 there", "network.turn_width (64 there"):
        assert text in str(error.value)
    assert "increment" not in str(error.value) and "\n" not in str(error.value)


def test_the_model_a_run_started_from_is_told_in_a_word(tmp_path):
    start = {"initial": {"steps": 3, "run": {"seed": 0}}}
    check_configuration(tmp_path, {"seed": 1, **start})
    check_configuration(tmp_path, {"seed": 1, **start})
    with pytest.raises(CaperError, match="it started from other weights"):
        check_configuration(tmp_path, {"seed": 1})
    other = {"seed": 2, "initial": {"steps": 4, "run": {"seed": 0}}}
    with pytest.raises(CaperError, match=r"it started from other weights, seed \(1 there, 2 now\)"):
        check_configuration(tmp_path, other)


def test_a_broken_configuration_or_metrics_file_is_named(tmp_path):
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(CaperError, match=r"config.json is not valid JSON"):
        fit(tmp_path, config(), loss_fn, variables(), batch_fn=batch_fn)
    (tmp_path / "config.json").unlink()
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n{"stp": 2}\n{"st')
    with pytest.raises(CaperError, match=r"metrics.jsonl, line 2: not a line of metrics"):
        fit(tmp_path, config(), loss_fn, variables(), batch_fn=batch_fn)


# kill -9


def worker(directory: str, output: str) -> None:
    """A run that saves every 20 of 400 steps; what the subprocesses below execute."""
    settings = config(steps=400, checkpoint_steps=20, log_steps=7, keep_checkpoints=2)
    result = fit(directory, settings, loss_fn, variables(width=300), batch_fn=batch_fn)
    leaves = jax.tree.leaves(without_clock(result.state))
    np.savez(output, **{str(i): np.asarray(leaf) for i, leaf in enumerate(leaves)})


def start_worker(directory, output):
    path = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests" / "training")])
    code = f"import test_loop as t; t.worker({str(directory)!r}, {str(output)!r})"
    return subprocess.Popen(
        [sys.executable, "-c", code],
        # The shared cache of programs would keep what a killed process had half written.
        env={**os.environ, "PYTHONPATH": path, "JAX_ENABLE_COMPILATION_CACHE": "false"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process):
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0, output


def kill_when(process, ready):
    """SIGKILL as soon as ``ready()``; whether the process was still running then."""
    try:
        while process.poll() is None and not ready():
            time.sleep(0.001)
        running = process.poll() is None
    finally:
        process.kill()
        process.communicate()
    return running


def test_kill_9_at_any_moment_and_the_same_command_gives_the_same_bits(tmp_path):
    """Killed before the first checkpoint, while one is written, and at random moments."""
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    reference = start_worker(straight, tmp_path / "straight.npz")
    checkpoints = killed / "checkpoints"
    rng = random.Random(0)

    def unfinished():
        return set(checkpoints.glob("*tmp*"))

    def finished():
        return {p for p in checkpoints.glob("*") if p.name.isdigit()}

    process = start_worker(killed, tmp_path / "killed.npz")
    kills = [kill_when(process, lambda: (killed / "metrics.jsonl").exists())]
    finish(reference)

    # While a checkpoint is written, be it the first or the third of that process.
    process = start_worker(killed, tmp_path / "killed.npz")
    before, left_over, wanted = finished(), unfinished(), rng.randint(0, 2)
    kills.append(
        kill_when(
            process,
            lambda: len(finished() - before) >= wanted and unfinished() - left_over,
        )
    )
    assert unfinished() - left_over
    # At a random moment of the next ones.
    process = start_worker(killed, tmp_path / "killed.npz")
    before, wanted = finished(), rng.uniform(0.0, 0.2)
    kills.append(kill_when(process, lambda: finished() - before))
    assert sum(kills) >= 2  # the test did interrupt a running worker
    finish(start_worker(killed, tmp_path / "killed.npz"))

    with np.load(tmp_path / "straight.npz") as a, np.load(tmp_path / "killed.npz") as b:
        assert a.files == b.files
        for name in a.files:
            assert a[name].tobytes() == b[name].tobytes()
    assert metrics_of(killed) == metrics_of(straight)
    assert json.loads((killed / "config.json").read_text()) == json.loads(
        (straight / "config.json").read_text()
    )
    assert {p.name for p in killed.iterdir()} == {p.name for p in straight.iterdir()}
