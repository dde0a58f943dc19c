"""Compiled programs kept between runs: where, how much, and when not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from caper_jax import machine

ROOT = Path(__file__).resolve().parents[1]

# A command that compiles something slow enough to be kept, and tells where JAX keeps it.
PROGRAM = """
import sys
from caper_jax import cli, machine
from caper_jax.cli import validate
machine._WORTH_KEEPING = 0.0

def main(options):
    import jax
    jax.jit(lambda x: x * 2 + 1)(jax.numpy.ones(3)).block_until_ready()
    print(jax.config.jax_compilation_cache_dir)
    return 0

validate.parse, validate.run = list, main
sys.exit(cli.main(["validate"]))
"""


# The environment without a word on caches.
PLAIN = {
    name: value
    for name, value in os.environ.items()
    if name not in (machine.SWITCH, "XDG_CACHE_HOME") and not name.startswith("JAX_")
}


def run(**environment: str) -> str:
    """What the program prints, with these variables; it must succeed and say nothing else."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**PLAIN, "PYTHONPATH": str(ROOT), **environment},
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.strip()


def entries(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_commands_keep_what_they_compile(tmp_path):
    folder = Path(run(XDG_CACHE_HOME=str(tmp_path)))
    assert folder.is_relative_to(tmp_path / "caper_jax")
    before = {path: path.stat().st_mtime_ns for path in entries(folder)}
    assert any("lambda" in path.name for path in before)
    assert run(XDG_CACHE_HOME=str(tmp_path)) == str(folder)
    # Used again: no entry is new, none was written twice.
    assert {path: path.stat().st_mtime_ns for path in entries(folder)} == before


def test_without_a_home_there_is_no_cache_and_no_complaint(tmp_path):
    assert machine.keep_programs({"HOME": str(tmp_path / "absent")}) is None
    assert not (tmp_path / "absent").exists()


@pytest.mark.parametrize(
    "environment",
    [
        {"CAPER_CACHE": "off"},
        {"CAPER_CACHE": "0"},
        {"JAX_COMPILATION_CACHE_DIR": "/elsewhere"},
        {"XDG_CACHE_HOME": "relative"},  # to be ignored, says the specification
    ],
)
def test_left_alone(environment, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert machine.keep_programs({"XDG_CACHE_HOME": str(tmp_path), **environment}) is None
    assert not entries(tmp_path)


def test_a_folder_that_cannot_be_made_or_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    assert machine.keep_programs({"XDG_CACHE_HOME": str(tmp_path / "file")}) is None
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    assert machine.keep_programs({"XDG_CACHE_HOME": str(tmp_path)}) is None


def test_folders_of_the_systems(tmp_path):
    home = {"HOME": str(tmp_path)}
    assert machine.user_folder(home, "linux") == tmp_path / ".cache"
    assert machine.user_folder(home, "darwin") == tmp_path / "Library/Caches"
    assert machine.user_folder({**home, "LOCALAPPDATA": "/local"}, "win32") == Path("/local")
    assert machine.user_folder({**home, "XDG_CACHE_HOME": "/caches"}, "linux") == Path("/caches")
    assert machine.user_folder({"HOME": str(tmp_path / "absent")}, "linux") is None


def test_the_longest_unused_goes_first(tmp_path):
    for number, name in enumerate(("old", "used", "new")):
        path = tmp_path / name
        path.write_bytes(b"0" * 100)
        os.utime(path, (1000 + number, 1000 + number))
    os.utime(tmp_path / "used", (9000, 1001))  # read after it was written
    machine.trim(tmp_path, 300)
    assert len(entries(tmp_path)) == 3
    machine.trim(tmp_path, 150)
    assert [path.name for path in entries(tmp_path)] == ["used"]
    machine.trim(tmp_path / "absent", 0)


def test_the_library_keeps_nothing(tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import caper_jax, jax; print(jax.config.jax_compilation_cache_dir)",
        ],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**PLAIN, "XDG_CACHE_HOME": str(tmp_path)},
        check=True,
    )
    assert done.stdout.strip() == "None"
    assert not entries(tmp_path)
