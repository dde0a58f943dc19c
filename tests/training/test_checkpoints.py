"""Checkpoints that restore exactly or say why not, and exported models."""

from __future__ import annotations

import gc
import json
import sys
import warnings
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.errors import CaperError
from caper_jax.models.files import flatten, read_model, unflatten, write_model
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
    for _ in range(8):
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
        (wider, r"'opt_state/.*/bias' has shape \(40,\), this model needs \(41,\)"),
        (half, r"'opt_state/.*' has dtype \w+, this model needs bfloat16"),
        (more, "has no 'model_state/more/x'"),
        (less, "has 'model_state/batch_stats/norm/var', which this model has not"),
    ):
        with Checkpoints(saved) as checkpoints, pytest.raises(CaperError, match=message):
            checkpoints.restore(template)


@pytest.mark.parametrize(("saved_on", "restored_on"), [(4, 1), (1, 8), (2, 4)])
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


# Exported models


def variables() -> dict:
    rng = np.random.default_rng(0)
    return {
        "params": {
            "layer": {"kernel": rng.normal(size=(64, 32)).astype(np.float32) * 0.05},
            "large": {"kernel": np.full((2, 2), 1e6, np.float32)},
            "tiny": {"kernel": np.full((2, 2), 1e-7, np.float32)},
        },
        "batch_stats": {
            "norm": {"mean": np.zeros(4, np.float32), "var": np.float32([1e-9, 1e-7, 1, 2])}
        },
    }


CARD = {"category": "box", "steps": 10, "metrics": {"rotation": 1.5}, "mean_pose": [[0.0, 1.0]]}


def test_a_model_survives_export(tmp_path):
    given = variables()
    write_model(tmp_path / "m", jax.tree.map(jnp.asarray, given), CARD)
    card, read = read_model(tmp_path / "m")
    assert card == CARD
    assert jax.tree.structure(read) == jax.tree.structure(given)
    for name, want in flatten(given).items():
        got = flatten(read)[name]
        assert got.dtype == np.float32
        assert np.linalg.norm(got - want) <= 1e-3 * np.linalg.norm(want), name
    assert sorted(p.name for p in (tmp_path / "m").iterdir()) == ["model.json", "weights.npz"]


def test_half_precision_is_used_only_where_it_loses_nothing(tmp_path):
    write_model(tmp_path, variables(), CARD)
    with np.load(tmp_path / "weights.npz") as file:
        kinds = {name: file[name].dtype.name for name in file.files}
    assert kinds == {
        "params/layer/kernel": "float16",
        "params/large/kernel": "float32",
        "params/tiny/kernel": "float32",
        "batch_stats/norm/mean": "float16",
        "batch_stats/norm/var": "float32",
    }
    _, read = read_model(tmp_path)
    np.testing.assert_array_equal(
        read["batch_stats"]["norm"]["var"], variables()["batch_stats"]["norm"]["var"]
    )


def test_what_cannot_be_exported_is_named(tmp_path):
    for leaf, message in (
        (np.float32([1, np.nan]), "'params/w' has values that are not finite"),
        (np.arange(3), "'params/w' is int64; only floats"),
    ):
        with pytest.raises(CaperError, match=message):
            write_model(tmp_path / "m", {"params": {"w": leaf}}, CARD)
    for card in ({"x": float("nan")}, {"x": object()}):
        with pytest.raises(CaperError, match="cannot be written as JSON"):
            write_model(tmp_path / "m", variables(), card)
    assert not (tmp_path / "m").exists()


def test_a_python_without_lzma_says_so(tmp_path, monkeypatch):
    write_model(tmp_path, variables(), CARD)
    monkeypatch.setattr(zipfile, "lzma", None)
    with pytest.raises(CaperError, match="built without liblzma"):
        read_model(tmp_path)


def test_a_damaged_model_is_named(tmp_path):
    write_model(tmp_path, variables(), CARD)
    weights, card = tmp_path / "weights.npz", tmp_path / "model.json"
    good = weights.read_bytes()

    def expect(message):
        with pytest.raises(CaperError, match=message):
            read_model(tmp_path)

    middle = bytearray(good)
    middle[len(middle) // 2] ^= 0xFF
    for content in (good[: len(good) // 2], good[:3], b"", b"text", bytes(middle)):
        weights.write_bytes(content)
        expect("weights.npz is damaged or not a weights file")
    np.savez(weights, x=np.array([{}], dtype=object))  # a pickle inside
    expect("weights.npz is damaged or not a weights file")
    with open(weights, "wb") as file:
        np.save(file, np.zeros(3))
    expect("weights.npz is damaged or not a weights file")
    np.savez(weights, x=np.float16([1, np.inf]))
    expect("weights.npz: 'x' has values that are not finite")
    np.savez(weights, x=np.arange(3))
    expect("'x' is int64, expected float16 or float32")
    np.savez(weights, **{"a": np.float16([1]), "a/b": np.float16([1])})
    expect("'a/b' lies below another array")
    weights.write_bytes(good)
    card.write_text("{")
    expect("model.json is not valid JSON")
    card.write_text("[]")
    expect("model.json must hold a JSON object, got list")
    card.write_bytes(b"\xff")
    expect("model.json is not valid JSON")
    card.unlink()
    expect("it has no model.json")
    card.write_text(json.dumps(CARD))
    weights.unlink()
    expect("it has no weights.npz")


def test_flat_names_round_trip():
    tree = {"a": {"b": 1, "c": {"d": 2}}, "e": 3}
    assert flatten(tree) == {"a/b": 1, "a/c/d": 2, "e": 3}
    assert unflatten(flatten(tree)) == tree
    with pytest.raises(CaperError, match="both an array and a group"):
        unflatten({"a/b": 1, "a": 2})
