"""The command line: ``caper <command> ...`` or ``python -m caper_jax <command> ...``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from caper_jax._version import __version__
from caper_jax.cli import common
from caper_jax.errors import unknown_name
from caper_jax.machine import keep_programs

# Command -> one line for --help; the module of the same name holds it, imported only when it runs.
COMMANDS = {
    "demo": "estimate poses on the depth frames that ship with the package",
    "estimate": "estimate poses from your own depth image or point cloud",
    "generate": "write synthetic labeled data",
    "train": "train a category's networks, or resume a run",
    "ablate": "compare variants of a training over several seeds",
    "calibrate": "calibrate what a model says about its own errors",
    "export": "write a model that runs without this package",
    "track": "track an object through videos or a live stream",
    "evaluate": "measure a model on labeled data",
    "validate": "check labeled data and list what is wrong with it",
    "gallery": "draw the generated shapes of the categories",
    "reproduce": "measure the tables of the paper again",
}


def help_text() -> str:
    """What ``caper --help`` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {summary}\n" for name, summary in COMMANDS.items()]
    return (
        "usage: caper <command> [options]\n\n"
        "Poses of articulated objects (boxes, laptops, ...) from a single depth image.\n\n"
        f"commands:\n{''.join(lines)}\noptions:\n"
        "  -h, --help  show this text\n"
        "  --version   show the version\n\nexamples:\n"
        "  caper demo                        pictures and a page in outputs/demo\n"
        "  caper train --help                options and examples of one command\n"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Runs ``caper``; returns the exit code (0, 2 for a mistake of the user, 130 for Ctrl-C)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments:
        print(help_text(), end="", file=sys.stderr)
        return common.EXIT_USAGE
    command, rest = arguments[0], arguments[1:]
    if command in ("-h", "--help", "help"):
        print(help_text(), end="")
        return 0
    if command == "--version":
        print(f"caper-jax {__version__}")
        return 0
    if command not in COMMANDS:
        print(f"caper: error: {unknown_name('command', command, COMMANDS)}", file=sys.stderr)
        return common.EXIT_USAGE

    def start(command_argv: Sequence[str]) -> int:
        # Imported inside run, so that Ctrl-C during a slow import is reported like any other.
        module = importlib.import_module(f"caper_jax.cli.{command}")
        options = module.parse(command_argv)  # help and mistakes come before JAX is imported
        keep_programs()
        return module.run(options)

    return common.run(start, rest, command=command)
