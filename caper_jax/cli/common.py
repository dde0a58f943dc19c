"""What the commands share: parsers with examples, argument types, errors as exit codes."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from caper_jax.errors import CaperError

Number = TypeVar("Number", int, float)

EXIT_USAGE = 2  # a mistake in what the user gave
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE


def run(
    main: Callable[[Sequence[str]], int], argv: Sequence[str], *, command: str | None = None
) -> int:
    """Runs one command and turns what it raises into an exit code.

    Mistakes of the user (``CaperError``, a file that cannot be read or written) become one line
    on standard error and code 2. Anything else is a fault of this program and keeps its traceback.

    Args:
      main: the command; takes its arguments, returns its exit code.
      argv: arguments after the command's name.
      command: name for messages; the last part of the module that defines ``main`` by default.

    Returns:
      The exit code.
    """
    name = main.__module__.rpartition(".")[2] if command is None else command
    try:
        code = main(argv)
        # Written here, a closed pipe is still reported below rather than at exit.
        sys.stdout.flush()
        return code
    except CaperError as error:
        return report_error(name, str(error))
    except SystemExit as stop:
        # argparse leaves this way: 0 after --help, 2 after a wrong argument.
        if isinstance(stop.code, str):
            return report_error(name, stop.code)
        return 0 if stop.code is None else int(stop.code)
    except KeyboardInterrupt:
        print(f"caper {name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader (head, less) has gone; keep the interpreter from flushing into it again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except OSError as error:
        if error.filename is None:
            raise
        return report_error(name, f"{error.filename}: {error.strerror}")


def report_error(command: str, message: str) -> int:
    """Prints ``caper <command>: error: <message>`` as one line; returns exit code 2."""
    one_line = " ".join(message.split())
    print(f"caper {command}: error: {one_line}", file=sys.stderr)
    return EXIT_USAGE


def printable(text: str) -> str:
    """Text that standard output can take: escapes what its encoding lacks, e.g. of file names."""
    encoding = sys.stdout.encoding or "utf-8"
    return text.encode(encoding, "backslashreplace").decode(encoding)


def create_parser(
    command: str, description: str, examples: Sequence[tuple[str, str]]
) -> argparse.ArgumentParser:
    """A parser whose --help ends with examples and keeps line breaks.

    Args:
      command: name after ``caper``.
      description: what the command does; may have several lines.
      examples: (arguments after ``caper <command>``, what they do).
    """
    width = max((len(arguments) for arguments, _ in examples), default=0)
    lines = [f"  caper {command} {arguments:<{width}}  # {note}" for arguments, note in examples]
    return argparse.ArgumentParser(
        prog=f"caper {command}",
        description=description,
        epilog="examples:\n" + "\n".join(lines) if lines else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_splits(parser: argparse.ArgumentParser) -> None:
    """The options of commands that read a labeled dataset."""
    parser.add_argument("--split", help="split to read (default: all there is)")
    parser.add_argument(
        "--official-split",
        action="store_true",
        help="tell train from test by the published object ids, not by the lists of the root",
    )


def check_folder(folder: Path, argument: str) -> None:
    """Refuses, before any work, a folder that cannot be made or written in.

    Raises:
      CaperError: a part of the path is a file, or there is no permission.
    """
    existing = folder
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise CaperError(f"{argument} {folder}: {existing} is a file; give a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise CaperError(f"{argument} {folder}: no permission to write in {existing}")


def positive_int(text: str) -> int:
    """Argument type: an integer above 0."""
    return _checked(int, text, "a whole number above 0", lambda value: value > 0)


def non_negative_int(text: str) -> int:
    """Argument type: an integer, 0 or more."""
    return _checked(int, text, "a whole number, 0 or more", lambda value: value >= 0)


def positive_float(text: str) -> float:
    """Argument type: a finite number above 0."""
    return _checked(float, text, "a number above 0", lambda value: 0 < value < math.inf)


def model_folder(text: str) -> Path:
    """Argument type: a folder, or the name of a category for the model that ships."""
    folder = Path(text)
    if not folder.exists() and folder.name == text:
        from caper_jax.estimator import shipped_weights

        if (shipped_weights() / text).is_dir():
            return shipped_weights() / text
    return folder


OBJECT_SCALE: dict[str, Any] = {
    "type": positive_float,
    "default": 1.0,
    "metavar": "S",
    "help": "the objects are S times as large as those the model was trained on, e.g. 3.7 for the "
    "laptops of PM-Videos and ArtImage (PartNet units read as meters)",
}


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """How objects and camera differ from what the models know, of commands that load one."""
    parser.add_argument("--object-scale", **OBJECT_SCALE)
    parser.add_argument(
        "--camera-roll",
        type=float,
        default=0.0,
        metavar="DEG",
        help="the camera is not level: by so many degrees its image shows things turned clockwise, "
        "180 for upside down (models know level cameras, within 15)",
    )


def model_options(arguments: argparse.Namespace) -> tuple[Path | None, float, float]:
    """What ``estimator.load`` takes besides the category."""
    return arguments.weights, arguments.object_scale, arguments.camera_roll


def pixel_box(text: str) -> tuple[float, float, float, float]:
    """Argument type: x1,y1,x2,y2 in pixels."""
    try:
        x1, y1, x2, y2 = (float(value) for value in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not x1,y1,x2,y2 in pixels") from None
    return x1, y1, x2, y2


def _checked(
    convert: Callable[[str], Number], text: str, wanted: str, accept: Callable[[Number], bool]
) -> Number:
    try:
        value = convert(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}") from None
    if not accept(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}")
    return value
