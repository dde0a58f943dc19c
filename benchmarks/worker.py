"""One process of ``bin/benchmark processes``: joins the others, trains, prints what it took."""

from __future__ import annotations

import json
import os
import statistics
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from caper_jax.config import BatchNormExtent


@dataclass(frozen=True)
class Job:
    """What one process does.

    Attributes:
      category, preset: of the training run.
      batch: samples per step of each process.
      repeats: steps that are timed.
      processes: that run at the same time.
      rank: of this one.
      together: whether they train one model; else each trains its own.
      batch_norm: "global" or "local", of one model.
      core: that it runs on.
      coordinator: "host:port" of the first process.
    """

    category: str
    preset: str
    batch: int
    repeats: int
    processes: int
    rank: int
    together: bool
    batch_norm: BatchNormExtent
    core: int
    coordinator: str


def perform(job: Job) -> dict[str, Any]:
    """Seconds of a step; together also seconds of summing the gradients, and sums per step."""
    from benchmarks import timing, training
    from caper_jax.training import parallel

    if job.processes > 1:
        parallel.initialize(job.coordinator, job.processes, job.rank)
    mesh = parallel.data_mesh() if job.together else None
    batch = job.batch * (job.processes if job.together else 1)
    step = training.make(job.category, job.preset, batch, mesh=mesh, batch_norm=job.batch_norm)
    timing.seconds_of(step.call)
    if job.processes > 1:
        parallel.agree([0.0])  # none begins while another compiles
    seconds = statistics.median(timing.seconds_of(step.call) for _ in range(job.repeats))
    if mesh is None:
        return {"step": seconds}
    gradients = step.gradients if job.batch_norm == "global" else _flat(step.gradients)
    call = _all_reduce(gradients, mesh)
    timing.seconds_of(call)
    alone = timing.median_seconds(lambda _: call(), max(job.repeats, 10))
    return {"step": seconds, "all_reduce": alone, "reductions": step.reductions}


def _all_reduce(shapes: Any, mesh: Any) -> Any:
    """A call that sums arrays of these shapes over the mesh, as the step does its gradients.

    On CPU each array is a message of its own, however the program groups them.
    """
    import jax
    import numpy as np

    from caper_jax.training import parallel

    def own(leaf: Any) -> np.ndarray:
        return np.ones((jax.local_device_count(), *leaf.shape), leaf.dtype)

    parts = parallel.place_rows(jax.tree.map(own, shapes), mesh)
    total = jax.jit(
        lambda tree: jax.tree.map(lambda leaf: leaf.sum(0), tree),
        out_shardings=parallel.replicated(mesh),
    )
    return lambda: total(parts)


def _flat(shapes: Any) -> Any:
    """One vector as long as all arrays of these shapes."""
    import jax

    leaves = jax.tree.leaves(shapes)
    return jax.ShapeDtypeStruct((sum(leaf.size for leaf in leaves),), leaves[0].dtype)


def main(text: str) -> None:
    """Does a job, given as JSON, on its core."""
    job = Job(**json.loads(text))
    # Before JAX counts the cores and starts as many threads.
    os.sched_setaffinity(0, {job.core})
    import jax

    from caper_jax.machine import keep_programs

    keep_programs()
    print(json.dumps(perform(job)))
    if job.processes > 1:
        jax.distributed.shutdown()


if __name__ == "__main__":
    main(sys.argv[1])
