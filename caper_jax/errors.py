"""The one exception type for mistakes a person can mend."""

from __future__ import annotations

import difflib
import math
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


def check_bounds(section: str, config: Any, **bounds: float) -> None:
    """CaperError for a number of a configuration that is below its bound or not finite, or none.

    Args:
      section: where a configuration file has it, for the message.
      config: holds the numbers as attributes; a tuple of numbers is held to the bound in each.
      **bounds: the least value of each.
    """
    for name, low in bounds.items():
        value = getattr(config, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if not numbers:
            raise CaperError(f"{section}.{name} must not be empty")
        if not all(low <= number < math.inf for number in numbers):
            kind = "finite and " if math.inf in numbers else ""
            raise CaperError(f"{section}.{name} must be {kind}at least {low}, got {value}")


def check_fractions(section: str, config: Any, names: Iterable[str]) -> None:
    """CaperError for a number of a configuration, of these names, that is not in [0, 1]."""
    for name in names:
        value = getattr(config, name)
        if not 0.0 <= value <= 1.0:
            raise CaperError(f"{section}.{name} is a fraction from 0 to 1, got {value}")
