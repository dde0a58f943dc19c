"""The readable files of a run directory: config.json, which a resumed run must match, and
metrics.jsonl, one JSON object per line with averages over the steps since the last."""

from __future__ import annotations

import dataclasses
import json
import math
import time
import typing
from pathlib import Path
from typing import Any

import jax
from flax.traverse_util import flatten_dict

from caper_jax.config import RunConfig, to_dict
from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.jsonl"
STARTED_FROM = "initial"  # key of the card of the model that the run started from
# Keys of the configuration that a resumed run may change: they do not touch the result.
_FREE_KEYS = frozenset(
    {
        "training.checkpoint_minutes",
        "training.checkpoint_steps",
        "training.keep_checkpoints",
        "loader.workers",
        "loader.prefetch",
        "loader.cache_gib",
    }
)
_ABSENT = "absent"
_MAX_NAMED = 8  # settings that a message names


def check_configuration(directory: Path, configuration: dict[str, Any]) -> None:
    """Keep the configuration of a run in its directory, and hold a resumed run to it.

    A stored run may lack settings that a later version added: they had their defaults.

    Args:
      directory: the run directory; created.
      configuration: sections of a ``RunConfig`` as plain values, and what else defines the run.

    Raises:
      CaperError: the directory is of a run with another configuration; names what differs.
    """
    path = directory / CONFIG_FILE
    text = json.dumps(configuration, indent=2, sort_keys=True)
    if not path.exists():
        if jax.process_index() == 0:
            directory.mkdir(parents=True, exist_ok=True)
            write_atomically(path, text.encode() + b"\n")
        return
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise CaperError(f"{path} is not valid JSON: {error}") from error
    given = json.loads(text)
    saved, now = (
        flatten_dict(tree, keep_empty_nodes=True, sep=".")
        for tree in (_with_defaults(stored, given, RunConfig), given)
    )
    different = [
        key
        for key in sorted(saved.keys() | now.keys())
        if key not in _FREE_KEYS and saved.get(key, _ABSENT) != now.get(key, _ABSENT)
    ]
    if different:
        raise CaperError(
            f"{directory} holds a run of another configuration: "
            f"{_differences(different, saved, now)}; use its configuration to resume it, or "
            "another directory (a new run can start from the model of this one)"
        )


def _with_defaults(stored: dict[str, Any], given: dict[str, Any], kind: type) -> dict[str, Any]:
    """Stored values of a section, and the defaults of fields that only the given ones have."""
    filled = dict(stored)
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        name = field.name
        if name not in given:
            continue
        if name not in stored:
            if field.default is not dataclasses.MISSING:
                filled[name] = _plain(field.default)
        elif isinstance(stored[name], dict) and isinstance(given[name], dict):
            options = (hints[name], *typing.get_args(hints[name]))  # T of T | None
            section: Any = next(t for t in options if dataclasses.is_dataclass(t))
            filled[name] = _with_defaults(stored[name], given[name], section)
    return filled


def _plain(value: Any) -> Any:
    """A default as JSON has it."""
    return to_dict(value) if dataclasses.is_dataclass(value) else json.loads(json.dumps(value))


def _differences(different: list[str], saved: dict[str, Any], now: dict[str, Any]) -> str:
    """What differs, for a message; the model that a run started from in a word."""
    settings = [key for key in different if not key.startswith(f"{STARTED_FROM}.")]
    parts = ["it started from other weights"] if len(settings) < len(different) else []
    for key in settings[:_MAX_NAMED]:
        parts.append(f"{key} ({saved.get(key, _ABSENT)!r} there, {now.get(key, _ABSENT)!r} now)")
    if len(settings) > _MAX_NAMED:
        parts.append(f"{len(settings) - _MAX_NAMED} settings more")
    return ", ".join(parts)


@dataclasses.dataclass
class Averages:
    """Of the steps since the last line of metrics; a checkpoint keeps it.

    Attributes:
      sums: metrics of the applied steps, summed, by name.
      steps: how many steps.
      applied: how many of them were applied.
      skipped: steps of the whole run that were not.
      bad_in_a_row: how many of those end with the last step.
    """

    sums: dict[str, float] = dataclasses.field(default_factory=dict)
    steps: int = 0
    applied: int = 0
    skipped: int = 0
    bad_in_a_row: int = 0


class Logs(typing.Protocol):
    """What the loop tells of its steps: ``MetricsLog``, or those of many members at once."""

    @property
    def loss(self) -> float: ...

    @property
    def rate(self) -> float: ...

    def restart_clock(self) -> None: ...

    def add(self, step: int, values: dict[str, Any], factor: float, seconds: float) -> None: ...

    def check(self, step: int, max_bad_steps: int) -> None: ...

    def flush(self, step: int, factor: float, seconds: float) -> None: ...

    def saved(self) -> dict[str, Any]: ...


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
      saved: ``saved()`` when the checkpoint was written; None for a new run.
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
        self.averages = Averages(**saved or {})
        self.loss = math.nan
        self._rate = math.nan
        self.restart_clock()
        if path is not None and path.exists():
            kept = [json.dumps(line) + "\n" for line in read_metrics(path) if line["step"] <= step]
            write_atomically(path, "".join(kept).encode())

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
        now = self.averages
        now.steps += 1
        self._timed_steps += 1
        if values["applied"]:
            now.applied += 1
            now.bad_in_a_row = 0
            self.loss = values["loss"]
            for name, value in values.items():
                if name != "applied":
                    now.sums[name] = now.sums.get(name, 0.0) + value
        else:
            now.skipped += 1
            now.bad_in_a_row += 1
        if step % self._every == 0:
            self.flush(step, factor, seconds)

    def check(self, step: int, max_bad_steps: int) -> None:
        """Raises a CaperError where so many steps in a row, up to this one, were not applied."""
        bad = self.averages.bad_in_a_row
        if bad >= max_bad_steps:
            raise CaperError(
                f"training diverged: the loss or its gradient was not finite in the {bad} steps "
                f"up to step {step}; lower the learning rate, or look for bad samples"
            )

    def saved(self) -> dict[str, Any]:
        """What a checkpoint keeps of the unfinished line."""
        return dict(vars(self.averages))

    def flush(self, step: int, factor: float, seconds: float) -> None:
        """Write the line of the steps since the last one, if there are any."""
        now = self.averages
        if not now.steps:
            return
        means = {name: value / now.applied for name, value in now.sums.items()}
        line = {
            "step": step,
            "seconds": round(seconds, 3),
            "factor": factor,
            "loss": means.pop("loss", None),
            **means,
            "rate": round(self.rate, 1),
            "skipped": now.skipped,
        }
        if self._path is not None:
            finite = {
                name: None if isinstance(value, float) and not math.isfinite(value) else value
                for name, value in line.items()
            }
            with open(self._path, "a", encoding="utf-8") as file:
                file.write(json.dumps(finite, allow_nan=False) + "\n")
        self.averages = Averages(skipped=now.skipped, bad_in_a_row=now.bad_in_a_row)
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
