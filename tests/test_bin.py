"""The scripts in bin/: they find Python, and two at once share one installation."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from caper_jax import cli

ROOT = Path(__file__).resolve().parents[1]
BASH = shutil.which("bash")
pytestmark = pytest.mark.skipif(BASH is None, reason="needs bash")

# Stands for Python, venv and pip: slow, and destroyed by whoever works at the same time.
PYTHON = """\
#!/bin/bash
case "$*" in
    *"-m venv"*) mkdir -p "$3/bin"; cp "$0" "$3/bin/python" ;;
    *"-m pip"*)
        mkdir "$BUSY" || exit 1
        echo installed >>"$LOG"
        sleep 0.5
        rmdir "$BUSY" ;;
    *"-m caper_jax"*) echo "$*" ;;
    "-c"*) exit 0 ;;
    *) exit 0 ;;
esac
"""
TOOLS = ("bash", "cat", "cksum", "cp", "dirname", "ln", "mkdir", "readlink", "rm", "rmdir")
TOOLS += ("sleep", "touch")


def test_every_command_has_an_executable_script():
    for command in (*cli.COMMANDS, "benchmark", "test"):
        assert os.access(ROOT / "bin" / command, os.X_OK), command


def test_scripts_run_from_any_folder(tmp_path):
    done = subprocess.run(
        ["bash", str(ROOT / "bin" / "demo"), "--help"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "CAPER_PYTHON": sys.executable},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: caper demo")


def test_a_python_that_does_not_run_is_passed_over(tmp_path):
    for name, script in (
        ("python3.12", "exit 127"),
        ("python3.11", "exit 1"),  # too old, says the version check
        ("python3", f'exec "{sys.executable}" "$@"'),
    ):
        write_script(tmp_path / name, f"#!/bin/sh\n{script}\n")
    found = find_python(tmp_path)
    assert found.stdout.strip() == str(tmp_path / "python3")
    write_script(tmp_path / "python3", "#!/bin/sh\nexit 1\n")
    none = find_python(tmp_path)
    assert none.returncode == 1
    assert "no Python 3.11 or newer found" in none.stderr


@pytest.fixture(params=["flock", "no flock"])
def clone(request, tmp_path):
    """A fresh clone with stubs for all that the scripts call; gives what to start them with."""
    if request.param == "flock" and shutil.which("flock") is None:
        pytest.skip("needs flock")
    repository, path = tmp_path / "clone", tmp_path / "path"
    (repository / "bin").mkdir(parents=True)
    path.mkdir()
    for name in ("_environment", "demo", "train"):
        shutil.copy(ROOT / "bin" / name, repository / "bin")
    shutil.copy(ROOT / "pyproject.toml", repository)
    write_script(path / "python3.12", PYTHON)
    for tool in (*TOOLS, *([] if request.param == "no flock" else ["flock"])):
        (path / tool).symlink_to(shutil.which(tool))
    variables = {"PATH": str(path), "BUSY": str(tmp_path / "busy"), "LOG": str(tmp_path / "log")}
    return repository, variables


def start(clone, name):
    repository, variables = clone
    return subprocess.Popen(
        [BASH, str(repository / "bin" / name)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=variables,
    )


def test_two_scripts_at_once_in_a_fresh_clone(clone, tmp_path):
    """Both work; one installs, the other waits for it."""
    both = [start(clone, name) for name in ("demo", "train")]
    results = [process.communicate(timeout=30) for process in both]
    assert [process.returncode for process in both] == [0, 0], results
    assert [out.strip() for out, _ in results] == ["-m caper_jax demo", "-m caper_jax train"]
    assert (tmp_path / "log").read_text().splitlines() == ["installed"]
    assert sum("waiting for another script" in err for _, err in results) == 1


def test_the_lock_of_a_killed_script_is_no_obstacle(clone, tmp_path):
    killed = start(clone, "demo")
    while not (tmp_path / "busy").exists():
        assert killed.poll() is None
        time.sleep(0.05)
    killed.kill()
    killed.communicate()
    while (tmp_path / "busy").exists():  # the stub of pip ends by itself
        time.sleep(0.05)
    after = start(clone, "train")
    out, err = after.communicate(timeout=30)
    assert (after.returncode, out.strip()) == (0, "-m caper_jax train"), err
    assert len((tmp_path / "log").read_text().splitlines()) == 2  # it was not whole


def write_script(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def find_python(folder: Path) -> subprocess.CompletedProcess[str]:
    """With no other command on the path than those in the folder, and dirname."""
    dirname = shutil.which("dirname")
    assert dirname
    if not (folder / "dirname").exists():
        (folder / "dirname").symlink_to(dirname)
    return subprocess.run(
        [str(BASH), "-c", f'source "{ROOT}/bin/_environment" && find_python'],
        capture_output=True,
        text=True,
        env={"PATH": str(folder)},
        check=False,
    )
