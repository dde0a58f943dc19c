"""The logs of members that train side by side, and which of them diverged."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from caper_jax.errors import CaperError
from caper_jax.training.grid import Member
from caper_jax.training.run_directory import METRICS_FILE, MetricsLog


class MemberLogs:
    """The metrics of members side by side: a metrics.jsonl for each, as that of a single run.

    Args:
      members: of the program, in the order of its states.
      directory: that has their folders.
      step: the step the program starts or resumes from.
      saved: ``saved()`` when its checkpoint was written; None for a new run.
    """

    def __init__(
        self, members: Sequence[Member], directory: Path, step: int, saved: dict[str, Any] | None
    ) -> None:
        self.members = members
        # Member -> the last of its steps that made it count as diverged.
        self.diverged: dict[str, int] = dict(saved["diverged"]) if saved else {}
        self.logs = [
            MetricsLog(
                directory / member.name / METRICS_FILE,
                step,
                member.config.training.log_steps,
                member.config.training.batch_size,
                saved and saved["members"][number],
            )
            for number, member in enumerate(members)
        ]

    def _training(self) -> list[MetricsLog]:
        return [
            log
            for log, member in zip(self.logs, self.members, strict=True)
            if member.name not in self.diverged
        ]

    @property
    def loss(self) -> float:
        """Median of those that have not diverged."""
        return statistics.median(log.loss for log in self._training())

    @property
    def rate(self) -> float:
        """Samples per second of all together."""
        return sum(log.rate for log in self.logs)

    def restart_clock(self) -> None:
        for log in self.logs:
            log.restart_clock()

    def add(self, step: int, values: dict[str, list[Any]], factor: float, seconds: float) -> None:
        for number, (log, member) in enumerate(zip(self.logs, self.members, strict=True)):
            if member.name not in self.diverged:
                log.add(step, {k: v[number] for k, v in values.items()}, factor, seconds)

    def check(self, step: int, max_bad_steps: int) -> None:
        """Notes members that have diverged by now; raises a CaperError if none is left."""
        for log, member in zip(self.logs, self.members, strict=True):
            bad = log.averages.bad_in_a_row
            if bad >= max_bad_steps and member.name not in self.diverged:
                self.diverged[member.name] = step
                print(
                    f"{member.name} diverged: its loss or gradient was not finite in the {bad} "
                    f"steps up to step {step}; the others go on",
                    file=sys.stderr,
                )
        if len(self.diverged) == len(self.members):
            raise CaperError(
                f"every member diverged by step {step}; lower the learning rate, or look for bad "
                "samples"
            )

    def flush(self, step: int, factor: float, seconds: float) -> None:
        for log in self._training():
            log.flush(step, factor, seconds)

    def saved(self) -> dict[str, Any]:
        return {"members": [log.saved() for log in self.logs], "diverged": dict(self.diverged)}
