"""One progress display for everything that takes long: a bar on a terminal, else plain lines.

Progress goes to standard error, so that standard output holds results only.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, TextIO

LINE_INTERVAL = 5.0  # seconds between plain lines
BAR_INTERVAL = 0.1  # seconds between redraws of the terminal bar


class Progress(Protocol):
    """What ``progress`` yields."""

    def update(self, n: int = 1, **values: float | str) -> None:
        """Counts ``n`` more steps as done and shows ``values`` (loss, rate, ...) beside them."""


def plain_output(stream: TextIO) -> bool:
    """Whether ``stream`` wants neither colors nor moving output."""
    return not stream.isatty() or "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb"


@contextmanager
def progress(
    title: str,
    total: int | None = None,
    *,
    start: int = 0,
    stream: TextIO | None = None,
    interval: float = LINE_INTERVAL,
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
      interval: seconds between lines when the output is plain.
      clock: seconds; for tests.

    Yields:
      An object whose ``update(n, **values)`` counts n steps as done.
    """
    stream = sys.stderr if stream is None else stream
    if plain_output(stream):
        lines = _Lines(title, total, start, stream, interval, clock)
        yield lines
        lines.finish()
    else:
        with _bar(title, total, start, stream) as bar:
            yield bar


def format_values(values: dict[str, float | str]) -> str:
    """``loss 0.0123  rate 31 steps/s``; four significant digits."""
    return "  ".join(
        f"{name} {value}" if isinstance(value, str) else f"{name} {float(value):.4g}"
        for name, value in values.items()
    )


def format_seconds(seconds: float) -> str:
    """``7 s``, ``3:05``, ``2:03:05``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class _Lines:
    """Plain lines: one at the start, one every ``interval`` seconds, one at the end."""

    def __init__(
        self,
        title: str,
        total: int | None,
        start: int,
        stream: TextIO,
        interval: float,
        clock: Callable[[], float],
    ) -> None:
        self._title, self._total, self._stream = title, total, stream
        self._interval, self._clock = interval, clock
        self._start = self._done = start
        self._began = clock()
        self._values: dict[str, float | str] = {}
        self._print()

    def update(self, n: int = 1, **values: float | str) -> None:
        self._done += n
        self._values = values
        if self._clock() - self._printed_at >= self._interval:
            self._print()

    def finish(self) -> None:
        if self._printed_done != self._done:
            self._print()

    def _print(self) -> None:
        now = self._clock()
        elapsed = now - self._began
        if self._total is None:
            parts = [f"{self._title}: {self._done}", format_seconds(elapsed)]
        else:
            share = 100 * self._done // max(self._total, 1)
            parts = [f"{self._title}: {self._done}/{self._total} ({share} %)"]
            parts.append(format_seconds(elapsed))
            fresh = self._done - self._start
            if fresh > 0 and self._done < self._total:
                left = elapsed / fresh * (self._total - self._done)
                parts.append(f"{format_seconds(left)} left")
        if self._values:
            parts.append(format_values(self._values))
        print(", ".join(parts), file=self._stream, flush=True)
        self._printed_at, self._printed_done = now, self._done


@contextmanager
def _bar(title: str, total: int | None, start: int, stream: TextIO) -> Iterator[Progress]:
    """A bar drawn by rich."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as RichProgress

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[shown]}"),
    )
    with RichProgress(*columns, console=Console(file=stream)) as display:
        task = display.add_task(escape(title), total=total, completed=start, shown="")

        class Bar:
            values: dict[str, float | str]
            drawn_at = 0.0

            def update(self, n: int = 1, **values: float | str) -> None:
                self.values = values
                display.update(task, advance=n)
                # Redrawing text can cost more than a fast step does.
                if time.monotonic() - self.drawn_at >= BAR_INTERVAL:
                    self.show_values()

            def show_values(self) -> None:
                self.drawn_at = time.monotonic()
                display.update(task, shown=escape(format_values(self.values)))

        bar = Bar()
        bar.values = {}
        try:
            yield bar
        finally:
            bar.show_values()
