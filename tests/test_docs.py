"""The documentation is true: its code runs, its links, commands, options, names and keys exist."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import pytest
from _helpers.quick import traced_jit
from _helpers.tiny import network, random_scorer, random_variables

import caper_jax
import caper_jax.evaluation.protocol  # its programs are jitted before a test replaces jax.jit
from benchmarks.__main__ import main as benchmark
from caper_jax import cli
from caper_jax.config import (
    LoaderConfig,
    NetworkConfig,
    RegistrationConfig,
    TrackerConfig,
    override,
    preset,
    update,
)
from caper_jax.reproduce.study import read_study, runs_of

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINKED = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
NOT_RUN = "<!-- not run"  # stands in the line before a block that takes too long or needs more
COMMAND = re.compile(r"\bbin/([a-z]+)((?: [^`|#\n]*)?)")
OPTION = re.compile(r"(?<![\w-])--[a-z][\w.-]*")
FEW_STEPS = TrackerConfig(registration=RegistrationConfig(steps=1, gaussians=16, capacity=32))
HAS_SUBCOMMANDS = ("reproduce", "benchmark")

named = functools.partial(pytest.mark.parametrize, ids=lambda path: path.name)


def blocks(page: Path, language: str) -> list[tuple[int, str]]:
    """Fenced blocks of a page that are to be run: number of their first line, and the code."""
    found = []
    lines = page.read_text("utf-8").split("\n")
    start = None
    for number, line in enumerate(lines):
        if start is None and line.strip() == f"```{language}":
            start = number + 1
        elif start is not None and line.strip() == "```":
            if not lines[max(start - 2, 0)].startswith(NOT_RUN):
                found.append((start + 1, "\n".join(lines[start:number])))
            start = None
    return found


def code_spans(page: Path) -> list[str]:
    """What stands between backquotes in the text of a page."""
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
    return re.findall(r"`([^`\n]+)`", text)


def commands(page: Path) -> list[tuple[str, str]]:
    """Every command of bin/ that a page names, with what follows it."""
    return COMMAND.findall(page.read_text("utf-8"))


@functools.cache
def options_of(command: str, subcommand: str = "") -> frozenset[str]:
    """The options that ``--help`` of a command names."""
    if command == "test":  # has none of its own
        return frozenset()
    words = [subcommand] if subcommand else []
    help_text = printed(command, *words, "--help")
    settings = settings_of(command) if "--help-settings" in help_text else frozenset()
    return settings.union(OPTION.findall(help_text))


@functools.cache
def settings_of(command: str) -> frozenset[str]:
    """The settings that ``--help-settings`` of a command names; those of subcommands are alike."""
    return frozenset(OPTION.findall(printed(command, "--help-settings")))


def printed(command: str, *arguments: str) -> str:
    """What a command prints."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        benchmark(arguments) if command == "benchmark" else cli.main([command, *arguments])
    return output.getvalue()


def resolve(name: str) -> object:
    """The module or attribute of that dotted name."""
    parts = name.split(".")
    found = importlib.import_module(parts[0])
    for number, part in enumerate(parts[1:], start=1):
        if hasattr(found, part):
            found = getattr(found, part)
        else:
            found = importlib.import_module(".".join(parts[: number + 1]))
    return found


@pytest.fixture(scope="module")
def small_model() -> tuple[caper_jax.Category, NetworkConfig, Any]:
    """A box, and networks in the place of the shipped ones, which take longer to compile."""
    category, sizes = caper_jax.categories.get("box"), network(refine_steps=0)
    variables = random_variables(category, sizes)
    variables["params"]["hypotheses"] = random_scorer()
    return category, sizes, variables


@named("page", [page for page in PAGES if blocks(page, "python")])
def test_python_blocks_run_in_order(page, small_model, tmp_path, monkeypatch):
    # Frames that are written must be such; of estimates nothing but the shape is looked at.
    if page.name not in ("datasets.md", "evaluating.md"):
        monkeypatch.setattr(jax, "jit", traced_jit)
    estimator = caper_jax.Estimator(*small_model, hypotheses=4)
    monkeypatch.setattr(caper_jax, "load", lambda *_, **__: estimator)
    tracker = caper_jax.Tracker(estimator, FEW_STEPS)
    monkeypatch.setattr(caper_jax, "load_tracker", lambda *_, **__: tracker)
    (tmp_path / "caper_jax").symlink_to(ROOT / "caper_jax")
    monkeypatch.chdir(tmp_path)  # what they write goes there
    namespace: dict[str, object] = {"__name__": "__docs__"}
    for line, code in blocks(page, "python"):
        padded = "\n" * (line - 1) + code  # so that a traceback names the line of the page
        exec(compile(padded, str(page), "exec"), namespace)


@named("page", [page for page in PAGES if blocks(page, "toml")])
def test_settings_are_read(page, tmp_path):
    for _, text in blocks(page, "toml"):
        path = tmp_path / "settings.toml"
        path.write_text(text, "utf-8")
        if "[variants." in text:
            runs_of(read_study(path))
        else:
            update(preset("fast", "box"), path)


def test_the_readme_is_one_page():
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 150


@named("page", LINKED)
def test_links_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8"))
    local = [target.partition("#")[0] for target in targets if "://" not in target]
    assert [target for target in local if not (page.parent / target).exists()] == []


@named("page", LINKED)
def test_files_exist(page):
    places = ("caper_jax/", "configs/", "examples/", "tests/", "benchmarks/", "docs/", "bin/")
    paths = [span for span in code_spans(page) if span.startswith(places) and " " not in span]
    assert [path for path in paths if not list(ROOT.glob(path.rstrip("/")))] == []
    assert [name for name, _ in commands(page) if not (ROOT / "bin" / name).is_file()] == []


@named("page", PAGES)
def test_commands_have_the_options_they_are_given(page):
    wrong = []
    for command, rest in commands(page):
        words = rest.split()
        subcommand = words[0] if command in HAS_SUBCOMMANDS and words else ""
        options = set(OPTION.findall(rest)) - {"--help"}
        if options:
            wrong += [f"{command}: {name}" for name in options - options_of(command, subcommand)]
    assert wrong == []


@named("page", PAGES)
def test_options_named_alone_are_of_some_command(page):
    asked = [(path.name, "") for path in (ROOT / "bin").glob("[a-z]*")]
    asked += [("reproduce", "table6"), ("reproduce", "ablations"), ("benchmark", "processes")]
    known = frozenset[str]().union({"--help"}, *(options_of(*names) for names in asked))
    spans = [span for span in code_spans(page) if "bin/" not in span]
    assert [name for span in spans for name in OPTION.findall(span) if name not in known] == []


@named("page", PAGES)
def test_names_exist(page):
    names = [span.partition("(")[0] for span in code_spans(page)]
    dotted = [name for name in names if re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", name)]
    for name in dotted:
        if page.name == "paper-map.md":
            resolve(f"caper_jax.{name}")
        elif name.startswith("caper_jax."):
            resolve(name)
        elif name.startswith("caper."):
            resolve(f"caper_jax.{name.removeprefix('caper.')}")


@named("page", [page for page in PAGES if page.name != "paper-map.md"])
def test_settings_exist(page):
    sections = {"registration": TrackerConfig(), "loader": {"loader": LoaderConfig("caper", "")}}
    for span in code_spans(page):
        key = re.fullmatch(r"((network|loss|training|loader|registration)(\.\w+)+)( ?=.*)?", span)
        if key is None:
            continue
        section: Any = sections.get(key[2], preset("fast", "box"))
        for name in key[1].split("."):
            section = section[name] if isinstance(section, dict) else getattr(section, name)


@named("page", PAGES)
def test_settings_on_the_command_line_have_values_that_fit(page):
    for line in page.read_text("utf-8").splitlines():  # those of a line may have to agree
        for sections, config in (
            ("network|data|loss|training", preset("fast", "box")),
            ("tracker", TrackerConfig()),
        ):
            given = re.findall(rf"--((?:{sections})\.[\w.-]+)[ =]([^\s`|]+)", line)
            keys = [key.replace("-", "_").removeprefix("tracker.") for key, _ in given]
            override(config, *(f"{k}={v}" for k, (_, v) in zip(keys, given, strict=True)))


def test_the_site_builds(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("material")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    loaded = re.compile(r"""<(?:script|link|img)[^>]*(?:src|href)=["']?https?://""")
    pages = list(tmp_path.rglob("*.html"))
    assert pages and not [page for page in pages if loaded.search(page.read_text("utf-8"))]
