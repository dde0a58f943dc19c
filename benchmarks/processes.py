"""``bin/benchmark processes``: what data parallelism costs, measured here or on paper."""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks import cost_model
from benchmarks.arguments import positive_int
from benchmarks.training import TARGETS
from benchmarks.worker import Job
from caper_jax import machine
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.config import BatchNormExtent

_PROCESSES = 2
_WORKER = "benchmarks.worker"
_PATIENCE = 1800.0  # seconds for a process, compilation included


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--category", default="laptop", help="(default: %(default)s)")
    parser.add_argument(
        "--preset", choices=tuple(TARGETS), help="(default: fast; with --model both)"
    )
    parser.add_argument(
        "--batch",
        type=positive_int,
        help="samples per step and process or device (default: the preset's)",
    )
    parser.add_argument(
        "--repeats", type=positive_int, default=10, help="steps (default: %(default)s)"
    )
    cost_model.add_arguments(parser.add_argument_group("on paper"))


def run(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A training step in one process and in two, on CPU, each with a core and a batch of its own.

    Two that train apart share the machine and nothing else: what they lose is the machine's.
    Together they also sum gradients and, unless those are of each process's own batch, the
    statistics of batch norm.
    """
    if arguments.model:
        yield from cost_model.run(arguments)
        return
    if arguments.step_ms is not None:
        raise CaperError("--step-ms belongs to --model")
    if not hasattr(os, "sched_getaffinity"):
        raise CaperError("processes cannot be given a core each on this system")
    cores = sorted(os.sched_getaffinity(0))[:_PROCESSES]
    if len(cores) < _PROCESSES:
        raise CaperError(f"{_PROCESSES} processes need as many cores, this one may use 1")
    preset = arguments.preset or "fast"
    size = arguments.batch or cost_model.batch_size(preset, arguments.category)
    gradients = cost_model.network(preset, arguments.category).gradient_bytes
    alone = None
    settings: tuple[tuple[str, int, bool, BatchNormExtent], ...] = (
        ("one process", 1, False, "global"),
        ("two, apart", _PROCESSES, False, "global"),
        ("two, together", _PROCESSES, True, "global"),
        ("two, together, batch norms local", _PROCESSES, True, "local"),
    )
    for name, count, together, batch_norm in settings:
        coordinator = f"localhost:{_free_port()}"
        jobs = [
            Job(
                arguments.category,
                preset,
                size,
                arguments.repeats,
                count,
                rank,
                together,
                batch_norm,
                core,
                coordinator,
            )
            for rank, core in enumerate(cores[:count])
        ]
        found = perform(jobs, arguments.keep_programs)
        rate = sum(size / result["step"] for result in found)
        alone = alone or rate
        reduction = found[0].get("all_reduce")
        yield {
            "what": f"{name:<32}",
            "batch_each": size,
            "samples_per_s": round(rate, 1),
            "step_ms": round(1000 * max(result["step"] for result in found), 1),
            "efficiency_%": round(100 * rate / (count * alone), 1),
            "gradients_MB": round(gradients / 1e6, 3) if together else "-",
            "all_reduce_ms": "-" if reduction is None else round(1000 * reduction, 2),
            "all_reduces": found[0].get("reductions", "-"),
            "load_average": machine.load_average(),
        }


def perform(jobs: Sequence[Job], keep_programs: bool) -> list[dict[str, Any]]:
    """What each of these jobs, run at the same time, found.

    Raises:
      CaperError: one of them failed or took too long.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        if not keep_programs:  # processes apart compile the same one
            environment["JAX_COMPILATION_CACHE_DIR"] = folder
        logs = [Path(folder) / f"process{job.rank}.txt" for job in jobs]
        workers = [_start(job, log, environment) for job, log in zip(jobs, logs, strict=True)]
        try:
            _wait(workers, logs)
        finally:
            for worker in workers:
                worker.kill()
                worker.wait()
        return [json.loads(log.read_text().splitlines()[-1]) for log in logs]


def _wait(workers: Sequence[subprocess.Popen[bytes]], logs: Sequence[Path]) -> None:
    """Until all are done, or one has failed: the others would wait for it."""
    end = time.monotonic() + _PATIENCE
    waiting = True
    while waiting:
        codes = [worker.poll() for worker in workers]
        for code, log in zip(codes, logs, strict=True):
            if code:
                raise CaperError(f"a process to measure failed: {log.read_text().strip()[-300:]}")
        if time.monotonic() > end:
            raise CaperError(f"processes to measure took more than {_PATIENCE:.0f} s")
        waiting = None in codes
        time.sleep(0.05)


def _start(job: Job, log: Path, environment: dict[str, str]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", _WORKER, json.dumps(asdict(job))]
    with log.open("wb") as output:
        return subprocess.Popen(command, stdout=output, stderr=output, env=environment)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return int(probe.getsockname()[1])
