"""The training loop: budget, metrics, checkpoints, clean stops and exact resumes."""

from __future__ import annotations

import dataclasses
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from caper_jax.config import TrainingConfig
from caper_jax.errors import CaperError
from caper_jax.progress import progress as progress_display
from caper_jax.training import parallel
from caper_jax.training.checkpoints import Checkpoints
from caper_jax.training.optimizer import Optimizer, flat_and_anneal
from caper_jax.training.run_directory import (
    METRICS_FILE,
    Logs,
    MetricsLog,
    check_configuration,
)
from caper_jax.training.statistics import compile_statistics, with_own_statistics
from caper_jax.training.step import LossFn, TrainState, compile_step

PyTree = Any


class StopRequest:
    """Turns SIGTERM and the first Ctrl-C into a request to save and stop.

    A second Ctrl-C interrupts at once. Outside the main thread signals are left alone.
    """

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: Any) -> None:
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.requested = True


@dataclass(frozen=True)
class FitResult:
    """What `fit` hands back.

    Attributes:
      state: the last training state; ``state.variables`` are the weights to use. Of a finished run
        its mutable collections are those of these weights (``training.statistics``).
      finished: whether the budget was used up; False after SIGTERM or Ctrl-C.
    """

    state: TrainState
    finished: bool


def fit(
    directory: str | Path,
    config: TrainingConfig,
    loss_fn: LossFn,
    variables: dict[str, PyTree],
    *,
    batch_fn: Callable[..., PyTree] | None = None,
    data: PyTree = None,
    batches: Callable[[int], PyTree] | None = None,
    mesh: jax.sharding.Mesh | None = None,
    description: dict[str, Any] | None = None,
) -> FitResult:
    """Train; call again with the same arguments to go on where a run stopped or was killed.

    The run directory holds config.json, metrics.jsonl and checkpoints/. A run bounded by steps
    ends with the same bits however often it was interrupted, on the same machine and software
    (on GPUs only as far as the operations of the loss are deterministic). SIGTERM or Ctrl-C saves
    and returns; of several processes, the signals and the clock of the first decide for all.

    Args:
      directory: the run directory.
      config: how to train.
      loss_fn: see `training.step.train_step`.
      variables: initial variables of the network; on resume their shapes and dtypes.
      batch_fn: ``(key) -> batch`` or ``(key, data) -> batch``, traced into the step.
      data: arrays handed to ``batch_fn`` besides the key, kept on the device.
      batches: instead of ``batch_fn``: ``(step) -> batch`` on the host, of which each process
        gives its own rows; a function of the step, so that a resumed run sees the same data.
      mesh: devices to split the batch over; one device without it.
      description: what else defines the run (the other sections of a ``RunConfig``, say); kept in
        config.json and compared on resume. Must be JSON-serializable.

    Raises:
      CaperError: the directory holds a run of another configuration or cannot be read, a
        configuration value is out of range, or the loss stays non-finite.
    """
    if config.epochs is not None:
        raise CaperError(
            f"training.epochs = {config.epochs} needs a dataset, which only a whole run has "
            "(training.train.train); give steps or minutes"
        )
    if (batch_fn is None) == (batches is None):
        raise ValueError("give either batch_fn or batches")
    if batches is not None and config.steps_per_dispatch != 1:
        raise CaperError("training.steps_per_dispatch must be 1 with batches from the host")
    if mesh is None and jax.process_count() > 1:
        mesh = parallel.data_mesh()
    parallel.check_batch_size(config.batch_size, mesh)
    directory = Path(directory)
    check_configuration(directory, {"training": dataclasses.asdict(config), **(description or {})})

    optimizer = Optimizer.of(config)
    step_fn = compile_step(
        loss_fn,
        optimizer,
        batch_fn=batch_fn,
        data_seed=config.data_seed,
        mesh=mesh,
        batch_norm=config.batch_norm,
        save_memory=config.save_memory,
    )
    sharding = parallel.replicated(mesh) if mesh is not None else parallel.one_device()
    state = parallel.place(TrainState.create(variables, optimizer, config.seed), sharding)
    if data is not None:
        data = parallel.place(data, sharding)

    def batch_of(step: int) -> PyTree:
        if batches is None:
            return data
        batch = batches(step)
        return batch if mesh is None else parallel.place_rows(batch, mesh)

    def logs(step: int, saved: dict[str, Any] | None) -> MetricsLog:
        path = directory / METRICS_FILE if jax.process_index() == 0 else None
        return MetricsLog(path, step, config.log_steps, config.batch_size, saved)

    result = run_steps(directory, config, step_fn, state, batch_of, logs)
    if not result.finished:
        return result
    statistics = compile_statistics(loss_fn, batch_fn, config.data_seed, mesh)
    return FitResult(with_own_statistics(result.state, statistics, batch_of), finished=True)


def run_steps(
    directory: Path,
    config: TrainingConfig,
    step_fn: Callable[..., tuple[TrainState, dict[str, jax.Array]]],
    state: TrainState,
    batch_of: Callable[[int], PyTree],
    make_logs: Callable[[int, dict[str, Any] | None], Logs],
    title: str = "training",
) -> FitResult:
    """Calls a compiled step until the budget is used up or a stop is requested; resumes.

    Args:
      directory: gets checkpoints/, from whose newest the run goes on.
      config: the budget, and how often to save.
      step_fn: as ``step.compile_step`` gives it; the state may be a stack of states.
      state: before the first step; on resume its shapes, dtypes and shardings.
      batch_of: step -> the data that ``step_fn`` takes.
      make_logs: (step the run starts from, what they saved then or None) -> the logs.
      title: of the progress display.

    Raises:
      CaperError: the checkpoints cannot be read or written, or the loss stays non-finite.
    """
    with (
        Checkpoints(directory / "checkpoints", keep=config.keep_checkpoints) as checkpoints,
        StopRequest() as stop,
    ):
        state, extra = checkpoints.restore(state) or (state, {})
        started = int(np.ravel(state.step)[0])
        logs = make_logs(started, extra.get("metrics"))
        run = _Run(config, directory, checkpoints, stop, state, logs, bool(extra), title)
        return run.go(step_fn, batch_of)


class _Run:
    """The moving parts of one call of `fit`."""

    def __init__(
        self,
        config: TrainingConfig,
        directory: Path,
        checkpoints: Checkpoints,
        stop: StopRequest,
        state: TrainState,
        logs: Logs,
        resumed: bool,
        title: str,
    ) -> None:
        self.config = config
        self.directory = directory
        self.checkpoints = checkpoints
        self.stop = stop
        self.state = state
        self.logs = logs
        self.title = title
        self.step = int(np.ravel(state.step)[0])
        self.saved_step = self.step if resumed else -1
        self.elapsed_before = float(np.ravel(state.elapsed)[0])
        self.began = self.saved_at = time.monotonic()
        # The dispatch whose metrics were not read yet: (its last step, factors, metrics).
        self.unread: tuple[int, np.ndarray, dict[str, jax.Array]] | None = None
        self.factor = 0.0
        self.first_read = True
        self.compiling = True  # as the first call of the step does

    def go(
        self,
        step_fn: Callable[..., tuple[TrainState, dict[str, jax.Array]]],
        batch_of: Callable[[int], PyTree],
    ) -> FitResult:
        """Train until the budget is used up or a stop is requested; saves at the end."""
        with self.display() as show:
            while True:
                elapsed, stop, due = parallel.agree(
                    [self.elapsed(), self.stop.requested, self.save_due()]
                )
                finished = self.fraction(self.step, elapsed) >= 1.0
                if stop or finished:
                    break
                if due:
                    self.save()
                progress, factor = self.schedule(elapsed)
                batch, called = batch_of(self.step), time.monotonic()
                self.state, metrics = step_fn(self.state, progress, factor, batch)
                if self.compiling:
                    self.compiling = False
                    self.began += time.monotonic() - called
                self.step += len(factor)
                # One dispatch stays unread, so that the device need not wait for the host.
                self.read()
                self.unread = self.step, factor, metrics
                show()
            self.read()
            if finished:
                self.logs.flush(self.step, self.factor, self.elapsed())
            self.save()
            show()
        self.checkpoints.wait()  # nobody should be told of a checkpoint that is not there yet
        if not finished:
            print(
                f"stopped at step {self.step}; the same command resumes from {self.directory}",
                file=sys.stderr,
            )
        return FitResult(self.state, finished)

    def elapsed(self) -> float:
        """Seconds of training, in this call and those before it."""
        return self.elapsed_before + time.monotonic() - self.began

    def fraction(self, step: int, elapsed: float) -> float:
        """How much of the budget is used."""
        if self.config.steps is not None:
            return step / self.config.steps
        assert self.config.minutes is not None
        return elapsed / (60.0 * self.config.minutes)

    def schedule(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """(progress, factor) [n] float32 of the next dispatch of n steps."""
        count = self.config.steps_per_dispatch
        if self.config.steps is not None:
            count = min(count, self.config.steps - self.step)
        steps = np.arange(self.step, self.step + count)
        progress = np.array([self.fraction(step, elapsed) for step in steps.tolist()])
        factor = flat_and_anneal(progress, steps, self.config.warmup)
        return progress.astype(np.float32), np.asarray(factor, np.float32)

    def read(self) -> None:
        """Log the dispatch that is still unread; waits for it."""
        if self.unread is None:
            return
        last, factors, on_device = self.unread
        self.unread = None
        metrics = {name: values.tolist() for name, values in jax.device_get(on_device).items()}
        for index, factor in enumerate(factors.tolist()):
            step = last - len(factors) + index + 1
            row = {name: values[index] for name, values in metrics.items()}
            self.logs.add(step, row, factor, self.elapsed())
            self.logs.check(step, self.config.max_bad_steps)
            self.factor = factor
        if self.first_read:  # that dispatch compiled: its time says nothing of the rate
            self.first_read = False
            self.logs.restart_clock()

    def save_due(self) -> bool:
        """Whether a checkpoint is due, by the clock or by the step."""
        if time.monotonic() - self.saved_at >= 60.0 * self.config.checkpoint_minutes:
            return True
        every = self.config.checkpoint_steps
        return every > 0 and self.step // every > max(self.saved_step, 0) // every

    def save(self) -> None:
        """Write a checkpoint of the current step, unless it was written already."""
        self.read()
        elapsed = np.full(self.state.elapsed.shape, self.elapsed(), np.float32)
        self.state = dataclasses.replace(
            self.state, elapsed=parallel.place(elapsed, self.state.elapsed.sharding)
        )
        if self.step != self.saved_step:
            self.checkpoints.save(self.step, self.state, {"metrics": self.logs.saved()})
            self.saved_step = self.step
        self.saved_at = time.monotonic()

    @contextmanager
    def display(self) -> Iterator[Callable[[], None]]:
        """The progress display, in steps or in seconds; yields what brings it up to date."""
        config = self.config
        if config.steps is not None:
            title, total = self.title, config.steps
        else:
            assert config.minutes is not None
            title, total = f"{self.title} (seconds)", math.ceil(60.0 * config.minutes)

        def done() -> int:
            return self.step if config.steps is not None else min(int(self.elapsed()), total)

        if jax.process_index() != 0:
            yield lambda: None
            return
        shown = done()
        with progress_display(title, total=total, start=shown) as bar:

            def show() -> None:
                nonlocal shown
                now = done()
                values: dict[str, float | str] = {"step": str(self.step)}
                if math.isfinite(self.logs.loss):
                    values["loss"] = self.logs.loss
                if math.isfinite(self.logs.rate):
                    values["rate"] = f"{self.logs.rate:.0f} samples/s"
                bar.update(now - shown, **values)
                shown = now

            yield show
