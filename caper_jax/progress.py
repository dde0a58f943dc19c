"""One progress display for everything that takes long: tqdm on a terminal, else plain lines.

Progress goes to standard error, so that standard output holds results only.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TextIO

LINE_INTERVAL = 5.0  # seconds between plain lines


class Progress(Protocol):
    """What ``progress`` yields."""

    def update(self, n: int = 1, **values: float | str) -> None:
        """Counts ``n`` more steps as done and shows ``values`` (loss, rate, ...) beside them."""


@contextmanager
def progress(
    title: str,
    total: int | None = None,
    *,
    start: int = 0,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Progress]:
    """Shows how far a long task is.

    Example:
      with progress("training", total=steps, start=resumed_step) as bar:
          for _ in range(resumed_step, steps):
              bar.update(1, loss=0.12, rate="31 steps/s")

    Args:
      title: what is being done, in a word or two.
      total: number of steps, or None when it is unknown.
      start: steps already done, e.g. by an earlier run that is resumed.
      stream: standard error by default.
      clock: seconds, of the plain lines; for tests.

    Yields:
      An object whose ``update(n, **values)`` counts n steps as done.
    """
    stream = sys.stderr if stream is None else stream
    plain = not stream.isatty() or "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb"
    if plain:
        lines = _Lines(title, total, start, stream, clock)
        yield lines
        lines.finish()
        return
    from tqdm import tqdm

    with tqdm(desc=title, total=total, initial=start, file=stream, dynamic_ncols=True) as bar:
        yield _Bar(bar)


def _format(values: dict[str, float | str]) -> str:
    """``loss 0.0123  rate 31 steps/s``; four significant digits."""
    return "  ".join(
        f"{name} {value}" if isinstance(value, str) else f"{name} {float(value):.4g}"
        for name, value in values.items()
    )


class _Bar:
    """A bar drawn by tqdm."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def update(self, n: int = 1, **values: float | str) -> None:
        self._bar.set_postfix_str(_format(values), refresh=False)
        self._bar.update(n)


class _Lines:
    """Plain lines: one at the start, one every ``LINE_INTERVAL`` seconds, one at the end."""

    def __init__(
        self,
        title: str,
        total: int | None,
        start: int,
        stream: TextIO,
        clock: Callable[[], float],
    ) -> None:
        self._title, self._total, self._stream = title, total, stream
        self._start = self._done = start
        self._clock, self._began = clock, clock()
        self._values: dict[str, float | str] = {}
        self._print()

    def update(self, n: int = 1, **values: float | str) -> None:
        self._done += n
        self._values = values
        if self._clock() - self._printed_at >= LINE_INTERVAL:
            self._print()

    def finish(self) -> None:
        if self._printed != self._done:
            self._print()

    def _print(self) -> None:
        from tqdm import tqdm

        counted = "{n_fmt}/{total_fmt} ({percentage:.0f} %)" if self._total else "{n_fmt}"
        left = "" if self._total in (None, 0, self._done) else ", {remaining} left"
        line = tqdm.format_meter(
            n=self._done,
            total=self._total,
            initial=self._start,
            elapsed=self._clock() - self._began,
            prefix=f"{self._title}: ",
            postfix=_format(self._values),
            bar_format="{desc}" + counted + ", {elapsed}" + left + "{postfix}",
        )
        print(line, file=self._stream, flush=True)
        self._printed_at, self._printed = self._clock(), self._done
