"""Reports as people read them, and the options that lead to them."""

from __future__ import annotations

import dataclasses
import importlib
import types

import pytest
from _helpers.reproductions import run

from caper_jax.cli.reproduce import REPRODUCTIONS
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.report import Table, markdown


def test_tables_are_markdown_with_aligned_columns():
    table = Table("Errors", ["part", "rotation"], [["base", "1.00"], ["the lid", "12.00"]])
    report = types.SimpleNamespace(title="Table 0", tables=[table], facts=["one thing"])
    assert markdown(report).splitlines() == [
        *("# Table 0", "", "**Errors**", ""),
        "| part    |   rotation |",
        "|:--------|-----------:|",
        "| base    |       1.00 |",
        "| the lid |      12.00 |",
        *("", "- one thing"),
    ]


def test_every_reproduction_has_a_module_that_runs_it():
    taken = {field.name for field in dataclasses.fields(Options)}
    for reproduction in REPRODUCTIONS.values():
        assert set(reproduction.options) <= taken
        module = importlib.import_module(f"caper_jax.reproduce.{reproduction.module}")
        assert callable(module.run)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["table4", "--category", "laptop"], "'laptop'"),
        (["table2", "--category", "box", "--data", "x"], "--format"),
        (["table4", "--category", "box", "--split", "train"], "--split"),
        (["table3", "--noise", "fog"], "'fog'"),
        (["table2", "--noise", "none", "--data", ".", "--format", "reartmix"], "--noise"),
        (
            ["table4", "--category", "box", "--data", "x", "--format", "caper", "--mode", "cam"],
            "--mode",
        ),
        (["jitter", "--category", "box", "--frames", "2"], "--frames must be 3"),
        (["jitter", "--category", "boxx"], "'box'"),
        (["table9", "--minutes", "2"], "--minutes"),
        (["table6", "--preset", "fast"], "--preset is no option of table6"),
        (["table6", "--weights", "nothing"], "--weights nothing"),
        (["modes", "--weights", "nothing"], "--weights nothing"),
    ],
)
def test_mistakes_are_named(arguments, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments[:1], tmp_path / "out", *arguments[1:]) == 2
    assert named in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
