"""The one exception type for mistakes in what a user gave."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


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
    key = ".".join(map(str, problem["loc"])) or "the value"
    if problem["type"] == "missing":
        return f"{key} is missing"
    if problem["type"] == "literal_error" and isinstance(problem["input"], str):
        names = problem["ctx"]["expected"].replace("'", "").replace(" or ", ", ").split(", ")
        return str(unknown_name(key, problem["input"], names))
    message = (
        problem["msg"]
        .replace("Input should be", "must be")
        .replace("greater than or equal to", "at least")
        .replace("less than or equal to", "at most")
        .replace("greater than", "above")
        .replace("less than", "below")
        .removeprefix("Value error, ")
    )
    return f"{key} {message}, got {problem['input']!r}"
