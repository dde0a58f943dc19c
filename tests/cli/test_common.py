"""The command line's frame: dispatch, exit codes, argument types, progress, bin scripts."""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from caper_jax import cli
from caper_jax.cli import common
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
    assert cli.main([command, "--help"]) == 0
    output = capsys.readouterr().out
    assert output.startswith(f"usage: caper {command}")
    assert f"examples:\n  caper {command}" in output
    module = importlib.import_module(f"caper_jax.cli.{command}")
    assert isinstance(module.build_parser(), argparse.ArgumentParser)


def test_unknown_command_names_the_nearest(capsys):
    assert cli.main(["estimte"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("caper: error: unknown command 'estimte'")
    assert "did you mean 'estimate'?" in captured.err


def test_no_command_prints_help_to_stderr(capsys):
    assert cli.main([]) == 2
    assert "commands:" in capsys.readouterr().err


def test_wrong_argument_exits_with_2(capsys):
    assert cli.main(["demo", "--no-such-option"]) == 2
    assert "caper demo: error: unrecognized arguments" in capsys.readouterr().err


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


@pytest.mark.parametrize(
    ("kind", "good", "bad"),
    [
        (common.positive_int, {"3": 3}, ["0", "-1", "1.5", "x"]),
        (common.non_negative_int, {"0": 0}, ["-1", "x"]),
        (common.positive_float, {"0.5": 0.5}, ["0", "nan", "inf", "-2", "x"]),
    ],
)
def test_argument_types(kind, good, bad):
    for text, value in good.items():
        assert kind(text) == value
    for text in bad:
        with pytest.raises(argparse.ArgumentTypeError, match="is not a"):
            kind(text)


def test_check_folder(tmp_path):
    common.check_folder(tmp_path / "a" / "b", "--out")
    (tmp_path / "file").write_text("")
    with pytest.raises(CaperError, match=r"--out .*file is a file; give a folder"):
        common.check_folder(tmp_path / "file" / "b", "--out")


def test_demo_rejects_a_category_without_frames(capsys):
    assert cli.main(["demo", "--category", "teapot"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
class TestBin:
    def test_shims_run_from_any_folder(self, tmp_path):
        environment = {**os.environ, "CAPER_PYTHON": sys.executable}
        done = subprocess.run(
            ["bash", str(ROOT / "bin" / "demo"), "--help"],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("usage: caper demo")

    def test_every_command_has_an_executable_shim(self):
        for command in (*cli.COMMANDS, "test"):
            assert os.access(ROOT / "bin" / command, os.X_OK), command

    def test_a_python_that_does_not_run_is_passed_over(self, tmp_path):
        for name, script in (
            ("python3.12", "exit 127"),
            ("python3.11", "exit 1"),  # too old, says the version check
            ("python3", f'exec "{sys.executable}" "$@"'),
        ):
            (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
            (tmp_path / name).chmod(0o755)
        found = self.find_python(tmp_path)
        assert found.stdout.strip() == str(tmp_path / "python3")
        (tmp_path / "python3").write_text("#!/bin/sh\nexit 1\n")
        none = self.find_python(tmp_path)
        assert none.returncode == 1
        assert "no Python 3.11 or newer found" in none.stderr

    def find_python(self, folder: Path) -> subprocess.CompletedProcess[str]:
        """With no other command on the path than those in the folder, and dirname."""
        dirname = shutil.which("dirname")
        assert dirname
        if not (folder / "dirname").exists():
            (folder / "dirname").symlink_to(dirname)
        return subprocess.run(
            ["/bin/bash", "-c", f'source "{ROOT}/bin/_environment" && find_python'],
            capture_output=True,
            text=True,
            env={"PATH": str(folder)},
            check=False,
        )


def test_a_model_that_ships_goes_by_its_category(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert common.model_folder("box") == shipped_weights() / "box"
    for text in ("bax", "runs/box", str(tmp_path / "box")):
        assert common.model_folder(text) == Path(text)
    (tmp_path / "box").mkdir()
    assert common.model_folder("box") == Path("box")
