"""Configurations from TOML and from the command line."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from caper_jax import config as configuration
from caper_jax.config import TrainingConfig
from caper_jax.errors import CaperError
from caper_jax.training import train as runs


@dataclass(frozen=True)
class Layers:
    width: int = 64
    widths: tuple[int, ...] = (64, 128)
    box: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Example:
    name: str
    rate: float = 1e-3
    fast: bool = False
    mode: Literal["a", "b"] = "a"
    limit: float | None = None
    label: str | None = None
    layers: Layers = field(default_factory=Layers)

    def __post_init__(self):
        if self.rate <= 0:
            raise CaperError("rate must be positive")


def load(tmp_path, text, *overrides):
    path = tmp_path / "example.toml"
    path.write_text(text)
    return configuration.load(path, Example, *overrides)


def test_values_are_read_and_defaults_filled_in(tmp_path):
    got = load(
        tmp_path,
        'name = "x"\nrate = 2\nlimit = 3\n[layers]\nwidths = [1, 2, 3]\nbox = [0, 2.5]\n',
    )
    assert got == Example("x", 2.0, limit=3.0, layers=Layers(64, (1, 2, 3), (0.0, 2.5)))
    assert type(got.rate) is float and type(got.layers.box[0]) is float


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "x"\nrat = 1.0', "example.toml: unknown key 'rat'; did you mean 'rate'"),
        ('name = "x"\n[layers]\nwidht = 1', "'layers.widht'; did you mean 'layers.width'"),
        ("rate = 1.0", "example.toml: name is missing"),
        ("name = 1", "example.toml: name must be a string, got 1"),
        ('name = "x"\nrate = "fast"', "rate must be a number, got 'fast'"),
        ('name = "x"\nrate = true', "rate must be a number, got True"),
        ('name = "x"\nfast = 1', "fast must be true or false, got 1"),
        ('name = "x"\nmode = "c"', "unknown mode 'c'"),
        ('name = "x"\nmode = 3', "mode must be one of 'a', 'b', got 3"),
        ('name = "x"\nlimit = "none"', "limit must be a number"),
        ('name = "x"\nlayers = 3', "layers must be a table, got 3"),
        ('name = "x"\n[layers]\nwidth = 1.5', "layers.width must be an integer, got 1.5"),
        ('name = "x"\n[layers]\nwidths = [1, "b"]', r"layers.widths\[1\] must be an integer"),
        ('name = "x"\n[layers]\nwidths = 1', "layers.widths must be a list, each item an integer"),
        ('name = "x"\n[layers]\nbox = [1.0]', "layers.box must be a list of 2"),
        ('name = "x"\nrate = -1.0', "example.toml: rate must be positive"),
        ("name = ", "example.toml is not valid TOML"),
    ],
)
def test_mistakes_in_a_file_are_named(tmp_path, text, message):
    with pytest.raises(CaperError, match=message):
        load(tmp_path, text)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CaperError, match=r"cannot read configuration .*absent\.toml"):
        configuration.load(tmp_path / "absent.toml", Example)


def test_overrides_take_toml_values_and_bare_strings():
    start = Example("x", limit=1.0, label="l")
    got = configuration.override(
        start,
        "rate=5e-4",
        "name = big box",
        "label=12",
        "fast=true",
        "mode=b",
        "limit=none",
        "layers.widths=[3, 4]",
    )
    layers = Layers(widths=(3, 4))
    assert got == Example("big box", 5e-4, True, "b", None, "12", layers)
    assert start == Example("x", limit=1.0, label="l")
    assert configuration.override(start) == start


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("rate", "write section.key=value"),
        ("raet=1", "unknown key 'raet'; did you mean 'rate'"),
        ("layer.width=1", "unknown key 'layer'; did you mean 'layers'"),
        ("layers.widt=1", "did you mean 'layers.width'"),
        ("layers=1", "layers is a section"),
        ("rate.x=1", "rate is not a section"),
        ("rate=fast", "rate must be a number, got 'fast'"),
        ("rate=none", "rate must be a number, got 'none'"),
        ("rate=0.0", "override: rate must be positive"),
    ],
)
def test_mistakes_in_an_override_are_named(assignment, message):
    with pytest.raises(CaperError, match=message):
        configuration.override(Example("x"), assignment)


def test_overrides_of_a_file_are_validated_together(tmp_path):
    path = tmp_path / "t.toml"
    path.write_text("steps = 100\nbatch_size = 8\n")
    got = configuration.load(path, TrainingConfig, "minutes=2.5", "steps=none")
    assert (got.steps, got.minutes, got.batch_size) == (None, 2.5, 8)
    with pytest.raises(CaperError, match="either steps or minutes"):
        configuration.load(path, TrainingConfig, "steps=none")


def test_of_alternatives_the_one_named_last_holds(tmp_path):
    path = tmp_path / "t.toml"
    preset = TrainingConfig(minutes=60.0)
    path.write_text("steps = 100\n")
    assert configuration.update(preset, path) == TrainingConfig(steps=100)
    assert configuration.load(path, TrainingConfig, "minutes=2.5") == TrainingConfig(minutes=2.5)
    path.write_text("steps = 100\nminutes = 2.5\n")
    with pytest.raises(CaperError, match="either steps or minutes"):
        configuration.update(preset, path)


@dataclass(frozen=True)
class Optional:
    layers: Layers | None = None


def test_a_section_that_may_be_absent(tmp_path):
    path = tmp_path / "t.toml"
    path.write_text("[layers]\nwidth = 5\n")
    got = configuration.update(Optional(), path)
    assert got == Optional(Layers(5))
    assert configuration.override(got, "layers.box=[1, 2]").layers == Layers(5, box=(1.0, 2.0))
    with pytest.raises(CaperError, match="layers is a section"):
        configuration.override(got, "layers=1")
    assert configuration.override(got, "layers=none") == Optional()
    with pytest.raises(CaperError, match=r"'layers.width=3': there is no layers in this run"):
        configuration.override(Optional(), "layers.width=3")


@pytest.mark.parametrize(
    "config",
    [
        Example("plain"),
        Example(
            'q"uo\\te\n\x7fé🙂', 1e-5, True, "b", float("inf"), "l", Layers(1, (), (-0.5, 1e20))
        ),
        TrainingConfig(steps=10),
        TrainingConfig(minutes=0.5, optimizer="adamw"),
    ],
)
def test_toml_and_json_round_trips(tmp_path, config):
    path = tmp_path / "r.toml"
    path.write_text(configuration.to_toml(config), encoding="utf-8")
    assert configuration.load(path, type(config)) == config
    values = json.loads(json.dumps(configuration.to_dict(config)))
    assert configuration.from_dict(type(config), values, "json") == config


def test_none_where_the_default_is_not_none_cannot_be_written():
    @dataclass(frozen=True)
    class Bounded:
        limit: float | None = 1.0

    assert tomllib.loads(configuration.to_toml(Bounded())) == {"limit": 1.0}
    with pytest.raises(CaperError, match="limit is None"):
        configuration.to_toml(Bounded(None))


CONFIGS = sorted((Path(__file__).resolve().parents[1] / "configs").glob("*.toml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_the_configurations_that_ship_can_be_used(path):
    """Those of the presets say what the presets are."""
    is_preset = path.stem in ("fast", "paper")
    preset = runs.preset(path.stem if is_preset else "fast", "box")
    assert (configuration.update(preset, path) == preset) == is_preset
