"""The one exception type for mistakes in what a user gave."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


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
