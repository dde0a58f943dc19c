"""What a measured time depends on."""

from __future__ import annotations

import os
import platform
from typing import Any

from caper_jax.cli.cache import cpu_fact


def machine() -> dict[str, Any]:
    """Processor, cores, load, version of JAX and device."""
    import jax

    # What this process may use, where the system says so.
    affinity = getattr(os, "sched_getaffinity", None)
    return {
        "processor": processor(),
        "cores": os.cpu_count() if affinity is None else len(affinity(0)),
        "load_average": load_average(),
        "jax": jax.__version__,
        "device": f"{jax.devices()[0].device_kind} x {jax.device_count()}",
    }


def processor() -> str:
    """What kind of processor this is, as the system calls it."""
    return cpu_fact("model name") or platform.processor() or platform.machine()


def load_average() -> float:
    """Processes that wanted to run, mean over the last minute."""
    return round(os.getloadavg()[0], 2)
