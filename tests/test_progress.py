"""Progress: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import io

import pytest

from caper_jax.progress import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_lines_every_few_seconds_when_not_a_terminal():
    stream, now = io.StringIO(), [0.0]
    with progress("training", 40, start=10, stream=stream, clock=lambda: now[0]) as bar:
        for step in range(30):
            now[0] += 0.5
            bar.update(1, loss=1 / (step + 1), rate="2 steps/s")
    assert stream.getvalue().splitlines() == [
        "training: 10/40 (25 %), 00:00, ? left",
        "training: 20/40 (50 %), 00:05, 00:10 left, loss 0.1  rate 2 steps/s",
        "training: 30/40 (75 %), 00:10, 00:05 left, loss 0.05  rate 2 steps/s",
        "training: 40/40 (100 %), 00:15, loss 0.03333  rate 2 steps/s",
    ]


def test_without_total():
    stream = io.StringIO()
    with progress("reading", stream=stream, clock=lambda: 0.0) as bar:
        bar.update(3)
    assert stream.getvalue().splitlines() == ["reading: 0, 00:00", "reading: 3, 00:00"]


def test_a_bar_on_a_terminal(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    stream = Terminal()
    with progress("work [1]", 4, stream=stream) as bar:
        bar.update(4, loss=0.5)
    shown = stream.getvalue()
    assert "\r" in shown and "work [1]" in shown and "4/4" in shown and "loss 0.5" in shown


@pytest.mark.parametrize(("name", "value"), [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_terminals_that_want_no_moving_output(name, value, monkeypatch):
    monkeypatch.setenv(name, value)
    stream = Terminal()
    with progress("work", 4, stream=stream) as bar:
        bar.update(4)
    assert "\r" not in stream.getvalue()
    assert stream.getvalue().splitlines()[-1] == "work: 4/4 (100 %), 00:00"
