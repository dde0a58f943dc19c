"""Checkpoints that restore exactly or say why not."""

from __future__ import annotations

import gc
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.errors import CaperError
from caper_jax.training import parallel
from caper_jax.training.checkpoints import Checkpoints, CheckpointWarning
from caper_jax.training.optimizer import Optimizer
from caper_jax.training.step import TrainState


def make_state(step: int, width: int = 40) -> TrainState:
    rng = np.random.default_rng(step)
    variables = {
        "params": {
            "kernel": rng.normal(size=(100, width)).astype(np.float32),
            "bias": rng.normal(size=width).astype(np.float32),
        },
        "batch_stats": {"norm": {"var": np.ones(3, np.float32)}},
    }
    return TrainState.create(variables, Optimizer(), step).replace(step=jnp.int32(step))


def assert_same(a, b) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


@pytest.fixture
def saved(tmp_path) -> Path:
    with Checkpoints(tmp_path / "c", keep=3) as checkpoints:
        for step in (1, 2, 3, 4):
            checkpoints.save(step, make_state(step), {"step": step, "sum": 0.1 + 0.2})
    return tmp_path / "c"


def test_what_changes_after_save_is_not_in_the_checkpoint(tmp_path, monkeypatch):
    """Orbax writes in the background: a sum that grows meanwhile must not leak into the file."""
    state, extra = make_state(1), {"sums": {"loss": 1.0}}
    with Checkpoints(tmp_path) as checkpoints:
        save = checkpoints._manager.save

        def late_save(*args, **kwargs):
            extra["sums"]["loss"] = 2.0
            return save(*args, **kwargs)

        monkeypatch.setattr(checkpoints._manager, "save", late_save)
        checkpoints.save(1, state, extra)
        jax.jit(lambda s: jax.tree.map(lambda x: x * 0, s), donate_argnums=0)(state)
    with Checkpoints(tmp_path) as checkpoints:
        restored, extra = checkpoints.restore(make_state(0))
    assert_same(restored, make_state(1))
    assert extra == {"sums": {"loss": 1.0}}


def largest_data_file(step: Path) -> Path:
    return max(step.glob("state/ocdbt.process_0/d/*"), key=lambda path: path.stat().st_size)


def test_the_newest_checkpoints_are_kept_and_restored_exactly(saved):
    with Checkpoints(saved) as checkpoints:
        assert checkpoints.steps() == [2, 3, 4]
        state, extra = checkpoints.restore(make_state(0))
    assert_same(state, make_state(4))
    assert extra == {"step": 4, "sum": 0.1 + 0.2}


def test_an_empty_directory_restores_nothing(tmp_path):
    with Checkpoints(tmp_path / "new") as checkpoints:
        assert checkpoints.restore(make_state(0)) is None


def damage(step: Path, kind: str) -> None:
    data = largest_data_file(step)
    content = bytearray(data.read_bytes())
    if kind == "truncated":
        data.write_bytes(content[: len(content) // 2])
    elif kind == "one bit":  # Orbax alone would restore this without a word
        content[len(content) // 2] ^= 0x10
        data.write_bytes(content)
    elif kind == "no data":
        data.unlink()
    elif kind == "no metadata":
        (step / "state" / "_METADATA").write_text("{")
    elif kind == "no note":
        (step / "note" / "metadata").write_text('{"extra": ')


@pytest.mark.parametrize("kind", ["truncated", "one bit", "no data", "no metadata", "no note"])
def test_a_damaged_checkpoint_is_passed_over(saved, kind):
    damage(saved / "4", kind)
    before = {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()}
    passed_over = pytest.warns(CheckpointWarning, match=r"c/4 .*falling back to step 3")
    with Checkpoints(saved) as checkpoints, passed_over:
        state, extra = checkpoints.restore(make_state(0))
    assert_same(state, make_state(3))
    assert extra["step"] == 3
    assert {p: p.read_bytes() for p in saved.rglob("*") if p.is_file()} == before


def test_training_goes_on_past_damaged_checkpoints_without_deleting_them(saved):
    damage(saved / "4", "truncated")
    broken = largest_data_file(saved / "4").read_bytes()
    (saved / "9").mkdir()  # no commit marker; Orbax takes it for the newest step
    with Checkpoints(saved, keep=3) as checkpoints:
        with pytest.warns(CheckpointWarning):
            checkpoints.restore(make_state(0))
        checkpoints.save(4, make_state(4))
        checkpoints.save(5, make_state(5))
    assert largest_data_file(saved / "4.unreadable").read_bytes() == broken
    assert (saved / "9.unreadable").is_dir()
    with Checkpoints(saved) as checkpoints, warnings.catch_warnings():
        assert checkpoints.steps() == [3, 4, 5]
        assert_same(checkpoints.restore(make_state(0))[0], make_state(5))


def test_an_unfinished_write_is_ignored(saved):
    """And its remains are cleared away, lest every kill cost disk space."""
    (saved / "9.orbax-checkpoint-tmp").mkdir()
    with Checkpoints(saved) as checkpoints:
        assert checkpoints.restore(make_state(0))[1]["step"] == 4
        checkpoints.save(5, make_state(5))
    assert sorted(p.name for p in saved.iterdir()) == ["3", "4", "5"]


def test_if_nothing_can_be_read_all_are_named(saved):
    for step in (2, 3, 4):
        damage(saved / str(step), "no data")
    message = r"no checkpoint can be read: .*c/4 .*c/3 .*c/2 "
    with Checkpoints(saved) as checkpoints, pytest.raises(CaperError, match=message):
        checkpoints.restore(make_state(0))


def test_a_failed_restore_leaves_nothing_behind(saved, capfd, monkeypatch):
    """Its other reads once died after the loop had closed, on standard error and in later tests."""
    reports = []
    monkeypatch.setattr(sys, "unraisablehook", reports.append)
    for step in (2, 3, 4):
        damage(saved / str(step), "no data")
    for _ in range(4):
        with Checkpoints(saved) as checkpoints, pytest.raises(CaperError, match="can be read"):
            checkpoints.restore(make_state(0))
        gc.collect()
    assert not reports
    assert capfd.readouterr() == ("", "")


def test_another_model_is_refused_by_leaf(saved):
    wider, other = make_state(0, width=41), make_state(0)
    half = other.replace(opt_state=jax.tree.map(lambda x: x.astype(jnp.bfloat16), other.opt_state))
    more = other.replace(model_state={**other.model_state, "more": {"x": jnp.ones(1)}})
    less = other.replace(model_state={})
    for template, message in (
        (wider, r"'opt_state/.*/bias' has shape \(40,\).*, this model needs shape \(41,\)"),
        (half, r"'opt_state/.*' has .*dtype \w+, this model needs .*dtype bfloat16"),
        (more, "has no 'model_state/more/x'"),
        (less, "has 'model_state/batch_stats/norm/var', which this model has not"),
    ):
        with Checkpoints(saved) as checkpoints, pytest.raises(CaperError, match=message):
            checkpoints.restore(template)


@pytest.mark.parametrize(("saved_on", "restored_on"), [(4, 1), (1, 8)])
def test_the_number_of_devices_may_change(tmp_path, saved_on, restored_on):
    def on(count):
        mesh = parallel.data_mesh(jax.devices()[:count])
        return parallel.place(make_state(7), parallel.replicated(mesh))

    with Checkpoints(tmp_path / "c") as checkpoints:
        checkpoints.save(7, on(saved_on))
    with Checkpoints(tmp_path / "c") as checkpoints:
        state, _ = checkpoints.restore(on(restored_on))
    assert_same(state, make_state(7))
    assert len(state.params.slow["kernel"].sharding.device_set) == restored_on


def test_a_save_that_does_not_happen_is_an_error(saved, monkeypatch):
    with Checkpoints(saved) as checkpoints:
        with pytest.raises(CaperError, match="cannot save step 4"):
            checkpoints.save(4, make_state(4))
        monkeypatch.setattr(checkpoints._manager, "save", lambda *a, **k: False)
        with pytest.raises(CaperError, match="step 6 was not saved"):
            checkpoints.save(6, make_state(6))


def test_nothing_is_written_to_the_log(saved, capfd):
    with Checkpoints(saved) as checkpoints:
        checkpoints.restore(make_state(0))
        checkpoints.save(8, make_state(8))
    assert capfd.readouterr() == ("", "")
