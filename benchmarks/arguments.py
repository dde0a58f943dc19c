"""Argument types of the benchmarks, and a parser whose --help ends with examples."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence


def create_parser(
    prog: str, description: str, examples: Sequence[tuple[str, str]]
) -> argparse.ArgumentParser:
    """A parser that keeps line breaks.

    Args:
      prog: what to type.
      description: what it does; may have several lines.
      examples: (arguments, what they do).
    """
    width = max((len(arguments) for arguments, _ in examples), default=0)
    lines = [f"  {prog} {arguments:<{width}}  # {note}" for arguments, note in examples]
    return argparse.ArgumentParser(
        prog=prog,
        description=description,
        epilog="examples:\n" + "\n".join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def positive_int(text: str) -> int:
    """Argument type: an integer above 0."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def positive_float(text: str) -> float:
    """Argument type: a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
