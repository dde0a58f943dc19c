"""What the commands share: options parsed by tyro, settings, errors as exit codes."""

from __future__ import annotations

import difflib
import io
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

from annotated_types import Ge, Gt

from caper_jax.errors import CaperError, describe_problem, unknown_name

Options = TypeVar("Options")

# Types of options; their bounds are checked once all are parsed.
Count = Annotated[int, Ge(1)]
Size = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0)]

EXIT_USAGE = 2  # a mistake in what the user gave
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE

ALL = "all"
_HELP_SETTINGS = "--help-settings"
# tyro's words for a number that is none, of an option that has a default and of one that has not.
_WRONG_NUMBER = re.compile(
    r"Error parsing (\S+): (?:no type matching (?:INT|FLOAT) .*|invalid literal for int.*"
    r"|could not convert string to float.*)'(.*)'"
)


@dataclass(frozen=True)
class Settings:
    """The sections of a configuration that a command takes as ``--section.key value``.

    Attributes:
      sections: name -> what it is, for --help.
      defaults: gives the sections by name, for --help-settings; called only there.
    """

    sections: Mapping[str, str]
    defaults: Callable[[], Mapping[str, Any]]


# ------------------------------------------------------------------------------------ parsing


def parse(
    options: type[Options],
    argv: Sequence[str],
    examples: Sequence[tuple[str, str]] = (),
    *,
    prog: str | None = None,
    notes: str = "",
) -> Options:
    """The options of a command.

    Args:
      options: a dataclass; its docstring is the help text, its "Attributes" those of the options.
        A field that is a tuple may be given several times.
      argv: arguments after the command's name.
      examples: (arguments after the command's name, what they do), for the end of --help.
      prog: what to type; by default "caper" and the dataclass's name.
      notes: more for the end of --help.

    Raises:
      CaperError: what is wrong, in one line that names the option.
      SystemExit: code 0, once --help is printed.
    """
    import tyro
    from pydantic import TypeAdapter, ValidationError

    prog = prog or f"caper {options.__name__.lower()}"
    markers = (
        tyro.conf.UseAppendAction,
        tyro.conf.FlagCreatePairsOff,
        tyro.conf.DisallowNone,
        tyro.conf.HelptextFromCommentsOff,
    )
    shown, complaint = _Captured(), _Captured()
    try:
        with redirect_stdout(shown), redirect_stderr(complaint):
            parsed, unknown = tyro.cli(
                options, prog=prog, args=list(argv), return_unknown_args=True, config=markers
            )
    except SystemExit as stop:
        if stop.code:
            raise _mistake(complaint.getvalue(), options) from None
        print(_without_boxes(shown.getvalue()) + _format_examples(prog, examples) + notes, end="")
        raise
    for each in fields(options):  # type: ignore[arg-type]
        if getattr(parsed, each.name) == () and each.default is MISSING:
            raise CaperError(f"missing {flag(options, each.name)}")
    if unknown:
        raise _unknown_option(unknown[0].partition("=")[0], options)
    try:
        return TypeAdapter(options).validate_python(vars(parsed))
    except ValidationError as error:
        name = str(error.errors()[0]["loc"][0])
        problem = describe_problem(error).removeprefix(name)
        raise CaperError(f"{flag(options, name)}{problem}") from None


def parse_with_settings(
    options: type[Options],
    argv: Sequence[str],
    examples: Sequence[tuple[str, str]],
    settings: Settings,
    *,
    prog: str | None = None,
    notes: str = "",
) -> tuple[Options, list[str]]:
    """The options of a command, and its settings as ``config.override`` takes them.

    Settings are ``--section.key value``, ``--section.key=value`` or ``--set section.key=value``.

    Args:
      options, argv, examples, prog, notes: as for ``parse``.
      settings: what may be set.

    Raises:
      CaperError: see ``parse`` and ``split_settings``.
      SystemExit: code 0, once --help or --help-settings is printed.
    """
    prog = prog or f"caper {options.__name__.lower()}"
    if _HELP_SETTINGS in argv:
        _print_settings(settings, prog)
        raise SystemExit(0)
    rest, assignments = split_settings(argv, settings.sections)
    lines = [f"  --{name + '.*':<14}  {text}\n" for name, text in settings.sections.items()]
    notes += f"\nsettings, as --section.key value ({_HELP_SETTINGS} lists them):\n" + "".join(lines)
    return parse(options, rest, examples, prog=prog, notes=notes), assignments


def split_settings(argv: Sequence[str], sections: Iterable[str]) -> tuple[list[str], list[str]]:
    """The arguments that are no settings, and the settings as "section.key=value".

    Raises:
      CaperError: a setting without value or of an unknown section.
    """
    rest, assignments = [], []
    arguments = iter(argv)
    for argument in arguments:
        option, equals, value = argument.partition("=")
        named = option.startswith("--") and "." in option
        if not named and option != "--set":
            rest.append(argument)
            continue
        value = value if equals else next(arguments, "")
        if value.startswith("--"):  # the next option
            value = ""
        key = option[2:]
        if not named:
            key, _, value = value.partition("=")
        if not value:
            raise CaperError(f"{option} needs a value, as in --section.key value")
        section, dot, _ = key.partition(".")
        if section not in sections or not dot:
            raise unknown_name("section of settings", section, sections)
        assignments.append(f"{key.replace('-', '_')}={value}")
    return rest, assignments


def _print_settings(settings: Settings, prog: str) -> None:
    """Every key of every section with its default, as tyro makes it of the docstrings."""
    import tyro

    values = settings.defaults()
    made = [(name, type(values[name]), field(default=values[name])) for name in settings.sections]
    everything = make_dataclass("Settings", made)
    everything.__doc__ = f"Settings of {prog}, with their defaults."
    shown = _Captured()
    markers = (tyro.conf.AvoidSubcommands, tyro.conf.FlagConversionOff)
    try:
        with redirect_stdout(shown):
            tyro.cli(everything, prog=prog, args=["--help"], config=markers)
    except SystemExit:
        print(_without_boxes(shown.getvalue()), end="")


class _Captured(io.StringIO):
    """What tyro prints, always framed in the same way."""

    encoding = "utf-8"


def _without_boxes(text: str) -> str:
    """tyro's help as plain text: no frames, no defaults that say nothing."""
    lines = []
    for line in text.splitlines():
        if line.startswith("╭"):
            line = line.strip("╭─╮ ") + ":"
        elif line.startswith("│ ─"):
            continue
        elif line.startswith("│"):
            line = " " + line.strip("│")
        elif line.startswith("╰"):
            line = ""
        else:
            line = textwrap.fill(line, 80)
        lines.append(line.rstrip())
    text = "\n".join(lines).rstrip() + "\n"
    return re.sub(r"\s*\(default:\s+(None|False)\)", "", text)


def _mistake(complaint: str, options: Any) -> CaperError:
    """tyro's boxed complaint as an error of one line: its message, without the help after it."""
    if unknown := re.search(r"Unrecognized options:[│\s]*(\S+)", complaint):
        return _unknown_option(unknown[1], options)
    text, inside = [], False
    for line in complaint.splitlines():
        content = line.strip("│╭╮╰╯ ")
        if inside and content.startswith("─"):
            break
        if line.startswith("│") and content:
            inside = True
            text.append(content)
    message = " ".join(text).partition(" Got errors:")[0]
    if message.startswith("Missing from"):
        return CaperError(f"missing {', '.join(re.findall(r'--[a-z-]+', message))}")
    if wrong := _WRONG_NUMBER.match(message):
        kind = "whole number" if re.search(r"\bint\b", message, re.IGNORECASE) else "number"
        return CaperError(f"{wrong[1]}: {wrong[2]!r} is no {kind}")
    return CaperError(message.removeprefix("Error parsing "))


def flag(options: Any, name: str) -> str:
    """How a field is called on the command line; ``tyro.conf.arg`` may say otherwise."""
    kind = get_type_hints(options, include_extras=True)[name]
    given = [m.name for m in getattr(kind, "__metadata__", ()) if getattr(m, "name", None)]
    return "--" + (given[0] if given else name.replace("_", "-"))


def _unknown_option(given: str, options: Any) -> CaperError:
    if not given.startswith("-"):
        return CaperError(f"unexpected argument {given!r}")
    known = [flag(options, f.name) for f in fields(options)]
    near = difflib.get_close_matches(given, known, n=1)
    hint = f"did you mean {near[0]!r}?" if near else "--help lists what there is"
    return CaperError(f"unknown option {given!r}; {hint}")


def _format_examples(prog: str, examples: Sequence[tuple[str, str]]) -> str:
    lines = [f"  {f'{prog} {arguments}'.rstrip()}  # {note}\n" for arguments, note in examples]
    return "\nexamples:\n" + "".join(lines) if lines else ""


# ----------------------------------------------------------------------- values of options


def chosen_categories(given: Sequence[str], known: Iterable[str] | None = None) -> list[str]:
    """The categories of ``--category``, which may be repeated, hold commas, or be "all".

    Args:
      given: values of the option; none stands for all.
      known: what "all" are; by default every category of the package.
    """
    from caper_jax import categories

    names = [name for text in given for name in text.split(",") if name]
    if not names or ALL in names:
        return list(categories.names() if known is None else known)
    return list(dict.fromkeys(names))


def model_folder(folder: Path) -> Path:
    """A folder, or for the name of a category, where there is no such folder, its shipped model."""
    if not folder.exists() and folder.name == str(folder):
        from caper_jax.estimator import shipped_weights

        if (shipped_weights() / folder.name).is_dir():
            return shipped_weights() / folder.name
    return folder


def pixel_box(text: str) -> tuple[float, float, float, float]:
    """x1,y1,x2,y2 in pixels.

    Raises:
      CaperError: something else.
    """
    try:
        x1, y1, x2, y2 = (float(value) for value in text.split(","))
    except ValueError:
        raise CaperError(f"--box: {text!r} is not x1,y1,x2,y2 in pixels") from None
    return x1, y1, x2, y2


def direction(text: str, argument: str) -> tuple[float, float, float]:
    """x,y,z of a direction, of any length.

    Raises:
      CaperError: something else, or no direction.
    """
    try:
        x, y, z = (float(value) for value in text.split(","))
    except ValueError:
        raise CaperError(f"{argument}: {text!r} is not x,y,z") from None
    if not 1e-6 < x * x + y * y + z * z < float("inf"):
        raise CaperError(f"{argument}: {text!r} is no direction")
    return x, y, z


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


# ------------------------------------------------------------------------ errors and output


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
        # After --help, with 0; argparse, of the benchmarks, leaves with 2 after a mistake.
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
