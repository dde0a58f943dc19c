"""The metrics file of a run: one JSON object per line, averaged over the steps since the last."""

from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path
from typing import Any

from caper_jax.errors import CaperError

FILE = "metrics.jsonl"


class MetricsLog:
    """Appends to metrics.jsonl, every ``every`` steps.

    On resume the lines after the restored step are cut off, and the sums of the unfinished line
    come from the checkpoint, so that the file equals that of a run that was never stopped (but
    for its clock: "seconds" and "rate").

    Args:
      path: the file; None to write nothing (all processes but the first).
      step: the step the run starts or resumes from.
      every: steps per line.
      batch_size: samples per step.
      saved: what `to_dict` gave when the checkpoint was written; None for a new run.
    """

    def __init__(
        self,
        path: Path | None,
        step: int,
        every: int,
        batch_size: int,
        saved: dict[str, Any] | None = None,
    ) -> None:
        self._path = path
        self._every = every
        self._batch_size = batch_size
        saved = saved or {}
        self._sums: dict[str, float] = saved.get("sums", {})
        self._applied: int = saved.get("applied", 0)
        self._steps: int = saved.get("steps", 0)
        self.skipped: int = saved.get("skipped", 0)
        self.bad_in_a_row: int = saved.get("bad_in_a_row", 0)
        self.loss = math.nan
        self._rate = math.nan
        self.restart_clock()
        if path is not None:
            _cut(path, step)

    def to_dict(self) -> dict[str, Any]:
        """What a checkpoint must hold for the file to go on without a seam."""
        return {
            "sums": self._sums,
            "applied": self._applied,
            "steps": self._steps,
            "skipped": self.skipped,
            "bad_in_a_row": self.bad_in_a_row,
        }

    def restart_clock(self) -> None:
        """Measure the rate from now on, e.g. after the first, compiling call."""
        self._since = time.monotonic()
        self._timed_steps = 0

    @property
    def rate(self) -> float:
        """Samples per second since the clock was restarted; nan before the first step."""
        if self._timed_steps:
            passed = max(time.monotonic() - self._since, 1e-9)
            self._rate = self._timed_steps * self._batch_size / passed
        return self._rate

    def add(self, step: int, values: dict[str, float], factor: float, seconds: float) -> None:
        """Count one step, and write a line when it is due.

        Args:
          step: number of steps done with this one.
          values: metrics of the step, "loss" and "applied" among them.
          factor: learning-rate factor of the step.
          seconds: of training so far.
        """
        self._steps += 1
        self._timed_steps += 1
        if values["applied"]:
            self._applied += 1
            self.bad_in_a_row = 0
            self.loss = values["loss"]
            for name, value in values.items():
                if name != "applied":
                    self._sums[name] = self._sums.get(name, 0.0) + value
        else:
            self.skipped += 1
            self.bad_in_a_row += 1
        if step % self._every == 0:
            self.flush(step, factor, seconds)

    def flush(self, step: int, factor: float, seconds: float) -> None:
        """Write the line of the steps since the last one, if there are any."""
        if not self._steps:
            return
        means = {k: v / self._applied for k, v in self._sums.items()} if self._applied else {}
        line = {
            "step": step,
            "seconds": round(seconds, 3),
            "factor": factor,
            "loss": means.pop("loss", None),
            **means,
            "rate": round(self.rate, 1),
            "skipped": self.skipped,
        }
        if self._path is not None:
            finite = {
                k: None if isinstance(v, float) and not math.isfinite(v) else v
                for k, v in line.items()
            }
            with open(self._path, "a", encoding="utf-8") as file:
                file.write(json.dumps(finite, allow_nan=False) + "\n")
        self._sums, self._applied, self._steps = {}, 0, 0
        self.restart_clock()


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """The lines of a metrics file; a last line cut short by a kill is left out.

    Raises:
      CaperError: a line is not a JSON object with a step.
    """
    lines = []
    texts = Path(path).read_text(encoding="utf-8").split("\n")
    for number, text in enumerate(texts[:-1], start=1):  # what follows the last newline is a rest
        try:
            line = json.loads(text)
            int(line["step"])
        except (ValueError, TypeError, KeyError) as error:
            raise CaperError(f"{path}, line {number}: not a line of metrics: {text!r}") from error
        lines.append(line)
    return lines


def _cut(path: Path, step: int) -> None:
    """Drop the lines after ``step``, and a broken last line."""
    if not path.exists():
        return
    kept = [json.dumps(line) + "\n" for line in read_metrics(path) if line["step"] <= step]
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text("".join(kept), encoding="utf-8")
    os.replace(temporary, path)
