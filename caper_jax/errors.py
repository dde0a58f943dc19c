"""The one exception type for mistakes in what a user gave, and how they are worded."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Any

_TYPE = re.compile(r"int|float|str|list\[.*\]")


class CaperError(ValueError):
    """A mistake in what the user gave: a file, an argument, a config key.

    The message says what was wrong, in which file or argument, and what to do. The command line
    prints it as one line and exits with code 2; from Python it is an ordinary ``ValueError``.
    """


def unknown_name(kind: str, name: str, known: Iterable[str]) -> CaperError:
    """The error for a name outside a closed list, with the nearest known name."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return CaperError(f"unknown {kind} {name!r}{hint} (known: {', '.join(names)})")


def describe_problem(error: Any) -> str:
    """The first problem of a pydantic ``ValidationError``, in one line that names the field.

    Args:
      error: as raised by ``validate_python`` or ``validate_json``.
    """
    problem = error.errors()[0]
    if isinstance(known := problem.get("ctx", {}).get("error"), CaperError):
        return str(known)  # names its fields itself
    # Of alternatives such as ``int | str``, pydantic adds the type that it tried.
    names = [str(name) for name in problem["loc"] if not _TYPE.fullmatch(str(name))]
    key, value = ".".join(names) or "the content", problem["input"]
    if problem["type"] == "json_invalid":
        return f"broken JSON ({problem['ctx']['error']})"
    if problem["type"] == "missing":
        return f"{key} is missing"
    if problem["type"] == "literal_error" and isinstance(value, str):
        names = problem["ctx"]["expected"].replace("'", "").replace(" or ", ", ").split(", ")
        return str(unknown_name(key, value, names))
    message = re.sub(r"^(Input|List|Tuple|String|Dictionary) should", "must", problem["msg"])
    message = (
        message.replace("greater than or equal to", "at least")
        .replace("less than or equal to", "at most")
        .replace("greater than", "above")
        .replace("less than", "below")
        .removeprefix("Value error, ")
    )
    return f"{key} {message}, got {_short(repr(value))}"


def _short(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."
