"""The command line's frame: dispatch, exit codes, argument types, progress, bin scripts."""

from __future__ import annotations

import dataclasses
import importlib
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from caper_jax import categories, cli
from caper_jax.cli import common, evaluate, track, validate
from caper_jax.data.readers import formats
from caper_jax.errors import CaperError
from caper_jax.estimator import shipped_weights

ROOT = Path(__file__).resolve().parents[2]


def raising(error: BaseException):
    def main(argv) -> int:
        raise error

    return main


def test_help_lists_every_command(capsys):
    assert cli.main(["--help"]) == 0
    output = capsys.readouterr().out
    for command, summary in cli.COMMANDS.items():
        assert f"  {command}" in output
        assert summary in output
    assert max(map(len, output.splitlines())) <= 80


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_commands_have_help_with_examples(command, capsys):
    """Made of a docstring, which says something of every option; two screens at most."""
    assert cli.main([command, "--help"]) == 0
    output = capsys.readouterr().out
    assert output.startswith(f"usage: caper {command}")
    assert f"examples:\n  caper {command}" in output
    assert len(output.splitlines()) <= 100
    assert max(map(len, output.splitlines())) <= 120
    module = importlib.import_module(f"caper_jax.cli.{command}")
    documented = re.findall(r"^      (\w+): ", class_of(module).__doc__, re.MULTILINE)
    assert documented == [field.name for field in dataclasses.fields(class_of(module))]


def class_of(module):
    """The dataclass of a command's options."""
    names = (module.__name__.rpartition(".")[2], "options")
    return next(
        value
        for value in vars(module).values()
        if dataclasses.is_dataclass(value) and value.__name__.lower() in names
    )


@pytest.mark.parametrize("command", ["train", "track", "generate", "reproduce"])
def test_all_settings_are_listed_with_what_they_mean(command, capsys):
    assert cli.main([command, "--help-settings"]) == 0
    output = capsys.readouterr().out
    assert "(default: " in output
    section = {"track": "tracker.kalman", "generate": "data.table"}.get(command, "loss.heatmap")
    assert f"--{section} " in output


def test_layouts_are_those_there_are():
    """Help texts name the formats of the readers, which import JAX."""
    for module, known in (
        (evaluate, formats(labeled=True)),
        (validate, formats(labeled=True)),
        (track, formats(videos=True)),
    ):
        line = re.search(r"layout of the data: ([^(]*?)(\(|\n      \w+:)", class_of(module).__doc__)
        assert line is not None
        assert set(re.split(r",\s+|\s+or\s+|\s+", line[1].strip())) == set(known)


def test_help_and_mistakes_do_not_wait_for_jax():
    code = (
        "import sys\nfrom caper_jax import cli\n"
        "cli.main(['--help']), cli.main(['train', '--help']), cli.main(['train', '--stesp', '3'])\n"
        "assert not {'jax', 'numpy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("caper train: error: ") and "'--steps'" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--no-such-option"], ["'--no-such-option'"]),
        (["--catgory", "box"], ["'--catgory'", "'--category'"]),
        (["--out"], ["--out"]),
        (["stray"], ["'stray'"]),
    ],
)
def test_a_wrong_option_is_one_line_with_the_nearest(arguments, parts, capsys):
    assert cli.main(["demo", *arguments]) == 2
    message = capsys.readouterr().err
    assert message.startswith("caper demo: error: ") and message.count("\n") == 1
    assert all(part in message for part in parts)


@dataclass(frozen=True)
class Example:
    """An example.

    Attributes:
      count: above 0
      rate: likewise
      path: needed
      names: several
      mode: one of two
    """

    path: Path
    names: tuple[str, ...] = ()
    count: common.Count = 1
    rate: common.Positive | None = None
    mode: Literal["alpha", "beta"] = "alpha"


def test_options_are_typed_and_may_be_repeated():
    given = ["--path", "a", "--names", "x,y", "--names=z", "--rate", "1e-3", "--count=3"]
    assert common.parse(Example, given) == Example(Path("a"), ("x,y", "z"), 3, 1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--path", "a", "--count", "0"], "--count must be at least 1, got 0"),
        (["--path", "a", "--count", "1.5"], "--count: '1.5' is no whole number"),
        (["--path", "a", "--rate", "nan"], "--rate must be above 0, got nan"),
        (["--path", "a", "--rate", "x"], "--rate: 'x' is no number"),
        (["--path", "a", "--mode", "c"], "'c' for argument '--mode'"),
        ([], "missing --path"),
        (["--pth", "a"], "did you mean '--path'"),
    ],
)
def test_values_are_checked(arguments, message):
    with pytest.raises(CaperError) as caught:
        common.parse(Example, arguments)
    assert message in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_settings_are_split_from_options():
    given = ["--out", "o", "--a.b-c", "1", "--set", "a.d=x=y", "--b.e=[1, 2]", "--flag"]
    rest, settings = common.split_settings(given, ("a", "b"))
    assert rest == ["--out", "o", "--flag"]
    assert settings == ["a.b_c=1", "a.d=x=y", "b.e=[1, 2]"]


def test_categories_may_be_listed_repeated_or_all():
    assert common.chosen_categories(["box,laptop", "box", "drawer"]) == ["box", "laptop", "drawer"]
    assert common.chosen_categories(["all"]) == list(categories.names())
    assert common.chosen_categories([], ["a", "b"]) == ["a", "b"]


def test_unknown_command_names_the_nearest(capsys):
    assert cli.main(["estimte"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("caper: error: unknown command 'estimte'")
    assert "did you mean 'estimate'?" in captured.err


def test_no_command_prints_help_to_stderr(capsys):
    assert cli.main([]) == 2
    assert "commands:" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (CaperError("bad mask\n  in a.png"), 2, "caper x: error: bad mask in a.png\n"),
        (FileNotFoundError(2, "No such file", "a.png"), 2, "caper x: error: a.png: No such file\n"),
        (KeyboardInterrupt(), 130, "caper x: interrupted\n"),
        (SystemExit(3), 3, ""),
        (SystemExit(None), 0, ""),
        (SystemExit("stopped"), 2, "caper x: error: stopped\n"),
    ],
)
def test_run_turns_errors_into_codes(error, code, message, capsys):
    assert common.run(raising(error), [], command="x") == code
    assert capsys.readouterr().err == message


def test_run_keeps_the_traceback_of_faults():
    with pytest.raises(ZeroDivisionError):
        common.run(raising(ZeroDivisionError()), [])
    with pytest.raises(ValueError, match="not the user"):
        common.run(raising(ValueError("not the user")), [])


def test_run_passes_arguments_and_code():
    assert common.run(lambda argv: len(argv), ["a", "b", "c"]) == 3


def test_a_closed_pipe_is_no_traceback():
    """``caper --help | head -0``: the reader is gone before anything is written."""
    code = (
        "import sys, time; from caper_jax.cli import common\n"
        "def main(argv):\n    time.sleep(0.3); print('x' * 100000); return 0\n"
        "sys.exit(common.run(main, []))"
    )
    command = f'"{sys.executable}" -c "$1" | true; echo "${{PIPESTATUS[0]}}"'
    done = subprocess.run(
        ["bash", "-c", command, "-", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout == "141\n"
    assert done.stderr == ""


def test_check_folder(tmp_path):
    common.check_folder(tmp_path / "a" / "b", "--out")
    (tmp_path / "file").write_text("")
    with pytest.raises(CaperError, match=r"--out .*file is a file; give a folder"):
        common.check_folder(tmp_path / "file" / "b", "--out")


def test_a_model_that_ships_goes_by_its_category(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert common.model_folder(Path("box")) == shipped_weights() / "box"
    for text in ("bax", "runs/box", str(tmp_path / "box")):
        assert common.model_folder(Path(text)) == Path(text)
    (tmp_path / "box").mkdir()
    assert common.model_folder(Path("box")) == Path("box")
