"""Model directories: weights that survive, and every damage named."""

from __future__ import annotations

import json
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from caper_jax.errors import CaperError
from caper_jax.models.files import flatten, read_model, unflatten, write_model


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


CARD = {
    "category": "box",
    "steps": 10,
    "more": {"rotation": 1.5},
    "mean_pose": {"offset": [0.0, 1.0]},
}


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


def test_weights_compressed_by_lzma_are_read_where_python_can(tmp_path, monkeypatch):
    """As the shipped ones are."""
    write_model(tmp_path, variables(), CARD)
    with np.load(tmp_path / "weights.npz") as file:
        arrays = dict(file)
    with zipfile.ZipFile(tmp_path / "weights.npz", "w", zipfile.ZIP_LZMA) as file:
        for name, array in arrays.items():
            with file.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, array)
    kept = flatten(read_model(tmp_path)[1])
    for name, array in arrays.items():
        np.testing.assert_array_equal(kept[name], array)
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
    expect("'a' is both an array and a group")
    weights.write_bytes(good)
    card.write_text("{")
    expect("model.json is not valid JSON")
    card.write_text("[]")
    expect("model.json must hold a JSON object, got list")
    card.write_text('{"steps": "many"}')
    expect("model.json: steps .* got 'many'")
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
