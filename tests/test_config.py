"""Configurations from TOML files and from "section.key=value"."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pytest

from caper_jax import config as configuration
from caper_jax.config import Count, Positive, TrainingConfig, preset, section
from caper_jax.errors import CaperError

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


@section
@dataclass(frozen=True)
class Layers:
    width: int = 64
    widths: tuple[Count, ...] = (64, 128)
    box: tuple[float, float] = (0.0, 1.0)


@section
@dataclass(frozen=True)
class Example:
    name: str = "x"
    rate: Positive = 1e-3
    fast: bool = False
    mode: Literal["alpha", "beta"] = "alpha"
    limit: float | None = None
    label: str | None = None
    layers: Layers = Layers()

    def __post_init__(self):
        if self.name == "forbidden":
            raise CaperError("name must be allowed")


@section
@dataclass(frozen=True)
class Optional:
    layers: Layers | None = None


def update(tmp_path, text, config):
    path = tmp_path / "example.toml"
    path.write_text(text)
    return configuration.update(config, path)


def test_a_file_says_what_differs(tmp_path):
    got = update(
        tmp_path,
        'name = "y"\nrate = 2\nlimit = 3\n[layers]\nwidths = [1, 2, 3]\nbox = [0, 2.5]\n',
        Example(mode="beta"),
    )
    assert got == Example("y", 2.0, mode="beta", limit=3.0, layers=Layers(64, (1, 2, 3), (0, 2.5)))
    assert type(got.rate) is float and type(got.layers.box[0]) is float


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("rat = 1.0", ["'rat'", "'rate'"]),
        ("[layers]\nwidht = 1", ["'layers.widht'", "'layers.width'"]),
        ("name = 1", ["name", "1"]),
        ('rate = "fast"', ["rate", "'fast'"]),
        ("rate = true", ["rate", "True"]),
        ("rate = -1.0", ["rate", "0", "-1.0"]),
        ("rate = inf", ["rate", "inf"]),
        ("rate = 2026-01-01", ["date"]),
        ("fast = 1", ["fast", "1"]),
        ('mode = "alhpa"', ["mode", "'alpha'"]),
        ("mode = 3", ["mode", "'alpha'", "3"]),
        ("layers = 3", ["layers", "3"]),
        ("[layers]\nwidth = 1.5", ["layers.width", "1.5"]),
        ('[layers]\nwidths = [1, "b"]', ["layers.widths.1", "'b'"]),
        ("[layers]\nwidths = [0]", ["layers.widths.0", "at least 1"]),
        ("[layers]\nbox = [1.0]", ["layers.box"]),
        ('name = "forbidden"', ["name must be allowed"]),
        ("name = ", ["TOML"]),
    ],
)
def test_mistakes_in_a_file_name_file_key_and_value(tmp_path, text, parts):
    with pytest.raises(CaperError) as caught:
        update(tmp_path, text, Example())
    assert all(part in str(caught.value) for part in ["example.toml", *parts])
    assert len(str(caught.value).splitlines()) == 1


def test_a_missing_key_or_file_is_named(tmp_path):
    with pytest.raises(CaperError, match=r"absent\.toml"):
        configuration.update(Example(), tmp_path / "absent.toml")
    with pytest.raises(CaperError, match="there: root is missing"):
        configuration.from_dict(configuration.LoaderConfig, {"format": "caper"}, "there")


def test_overrides_take_toml_values_and_bare_strings():
    start = Example("x", limit=1.0, label="l")
    got = configuration.override(
        start,
        "rate=5e-4",
        "name = big box",
        "label=12",
        "fast=true",
        "mode=beta",
        "limit=none",
        "layers.widths=[3, 4]",
        "layers.box=1,2.5",
    )
    layers = Layers(widths=(3, 4), box=(1.0, 2.5))
    assert got == Example("big box", 5e-4, True, "beta", None, "12", layers)
    assert start == Example("x", limit=1.0, label="l")
    assert configuration.override(start) == start
    assert configuration.override(start, 'name="1 = 1"').name == "1 = 1"


@pytest.mark.parametrize(
    ("assignment", "parts"),
    [
        ("rate", ["'rate'", "section.key=value"]),
        ("raet=1", ["'raet'", "'rate'"]),
        ("layer.width=1", ["'layer'", "'layers'"]),
        ("layers.widt=1", ["'layers.widt'", "'layers.width'"]),
        ("layers=1", ["layers is a section"]),
        ("rate.x=1", ["rate is not a section"]),
        ("rate=fast", ["rate", "'fast'"]),
        ("rate=none", ["rate", "'none'"]),
        ("rate=0.0", ["rate", "0.0"]),
    ],
)
def test_mistakes_in_an_override_are_named(assignment, parts):
    with pytest.raises(CaperError) as caught:
        configuration.override(Example(), assignment)
    assert all(part in str(caught.value) for part in parts)


def test_of_alternatives_the_one_named_last_holds(tmp_path):
    by_time = TrainingConfig(minutes=60.0)
    assert update(tmp_path, "steps = 100\n", by_time) == TrainingConfig(steps=100)
    got = configuration.override(by_time, "steps=7", "minutes=2.5")
    assert got == TrainingConfig(minutes=2.5)
    assert configuration.override(by_time, "epochs=250") == TrainingConfig(epochs=250.0)
    for both in ("steps = 100\nminutes = 2.5\n", "minutes = 2.5\nepochs = 3\n"):
        with pytest.raises(CaperError, match="one of steps, minutes and epochs"):
            update(tmp_path, both, by_time)
    with pytest.raises(CaperError, match="one of steps, minutes and epochs"):
        configuration.override(by_time, "minutes=none")


def test_epochs_need_a_dataset():
    by_epochs = configuration.override
    with pytest.raises(CaperError, match=r"training\.epochs = 3\.0 needs a dataset"):
        by_epochs(preset("paper", "box"), "training.epochs=3")
    loader = configuration.LoaderConfig("caper", "box.h5")
    fed = by_epochs(replace(preset("paper", "box"), loader=loader), "training.epochs=3")
    assert (fed.training.epochs, fed.training.minutes, fed.training.steps) == (3.0, None, None)


def test_a_section_that_may_be_absent(tmp_path):
    got = update(tmp_path, "[layers]\nwidth = 5\n", Optional())
    assert got == Optional(Layers(5))
    assert configuration.override(got, "layers.box=[1, 2]").layers == Layers(5, box=(1.0, 2.0))
    assert configuration.override(got, "layers=none") == Optional()
    for config, assignment in ((got, "layers=1"), (Optional(), "layers.width=3")):
        with pytest.raises(CaperError, match="layers"):
            configuration.override(config, assignment)


@pytest.mark.parametrize("config", [*configuration.PRESETS.values(), Example("é🙂", 1e-5)])
def test_json_round_trip(config):
    values = json.loads(json.dumps(configuration.to_dict(config)))
    assert configuration.from_dict(type(config), values) == config
    assert configuration.check(config) == config


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_the_files_that_ship(path):
    """fast.toml is the preset written out; each of the others changes something."""
    base = preset("paper" if path.stem == "paper" else "fast", "box")
    assert (configuration.update(base, path) == base) == (path.stem == "fast")
    opening = path.read_text().split("\n\n")[0]
    assert f"--config configs/{path.name}" in opening
    assert "# Time: " in opening and "Score" in opening


def test_fast_toml_names_every_value_that_the_preset_sets():
    """A change of the preset alone, or of its file alone, is noticed."""
    import tomllib

    def flat(values, prefix=""):
        for key, value in values.items():
            if isinstance(value, dict):
                yield from flat(value, f"{prefix}{key}.")
            else:
                yield prefix + key, value

    blank = configuration.RunConfig("", configuration.NetworkConfig())
    written = dict(flat(tomllib.loads((CONFIGS / "fast.toml").read_text())))
    default = dict(flat(configuration.to_dict(blank)))
    for key, value in flat(configuration.to_dict(preset("fast"))):
        if value != default[key]:
            assert written.get(key) == value, key
