"""This machine: what measured times depend on, and where compiled programs are kept."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SWITCH = "CAPER_CACHE"  # environment variable; "off" compiles every time
MAX_BYTES = 512 * 1024**2
# Below this (seconds) compiling again is as fast as looking it up.
_WORTH_KEEPING = 0.1


def machine() -> dict[str, Any]:
    """Processor, cores, load, version of JAX and device."""
    import jax

    return {
        "processor": processor(),
        "cores": cores(),
        "load_average": load_average(),
        "jax": jax.__version__,
        "device": f"{jax.devices()[0].device_kind} x {jax.device_count()}",
    }


def cores() -> int | None:
    """How many cores this process may use; all there are where the system does not say."""
    affinity = getattr(os, "sched_getaffinity", None)
    return os.cpu_count() if affinity is None else len(affinity(0))


def processor() -> str:
    """What kind of processor this is, as the system calls it."""
    return _cpu_fact("model name") or platform.processor() or platform.machine()


def free_bytes() -> float | None:
    """Memory that this process may still take on its device; None where nobody says."""
    import jax

    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        if "bytes_limit" not in stats:
            return None
        return float(stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    known = dict(line.split(":", 1) for line in lines)
    return 1024.0 * int(known["MemAvailable"].split()[0]) if "MemAvailable" in known else None


def load_average() -> float:
    """Processes that wanted to run, mean over the last minute."""
    return round(os.getloadavg()[0], 2)


def split_cores(environment: Mapping[str, str] = os.environ) -> None:
    """Makes every core a device of JAX, for what runs side by side on a CPU.

    Does nothing where the user has told JAX itself (``JAX_NUM_CPU_DEVICES``, or a number in
    ``XLA_FLAGS``), or where JAX has looked for devices before.
    """
    if "JAX_NUM_CPU_DEVICES" in environment or "device_count" in environment.get("XLA_FLAGS", ""):
        return
    import jax

    try:
        jax.config.update("jax_num_cpu_devices", cores() or 1)
    except RuntimeError:  # too late
        return


def keep_programs(environment: Mapping[str, str] = os.environ) -> Path | None:
    """Makes JAX keep what it compiles in this process, and use what others have kept.

    Does nothing where the user has told JAX itself (``JAX_COMPILATION_CACHE_DIR``), has switched
    it off (``CAPER_CACHE=off``), or has no folder that can be written in. JAX's own bound on the
    size needs another package and a lock at every look-up, for which commands that run side by
    side would wait; here a command that starts removes what has not been used for longest.

    Returns:
      The folder, or None.
    """
    if environment.get(SWITCH, "").lower() in ("off", "0", "no", "false"):
        return None
    parent = user_folder(environment)
    if parent is None or "JAX_COMPILATION_CACHE_DIR" in environment:
        return None
    # By kind of processor: machine code for another one, in a shared home, would crash.
    facts = platform.machine() + platform.processor() + _cpu_fact("flags", "Features")
    folder = parent / "caper_jax" / hashlib.sha256(facts.encode()).hexdigest()[:12]
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(folder, os.W_OK | os.X_OK):
        return None
    trim(folder, MAX_BYTES)
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in environment:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)
    # A full disk or a damaged entry costs time, nothing else.
    warnings.filterwarnings("ignore", message=".*persistent compilation cache", append=True)
    return folder


def user_folder(environment: Mapping[str, str], system: str = sys.platform) -> Path | None:
    """Where this system's programs keep what can be made again; None for a user without home."""
    if given := environment.get("XDG_CACHE_HOME"):
        return Path(given) if Path(given).is_absolute() else None
    if system == "win32" and (given := environment.get("LOCALAPPDATA")):
        return Path(given)
    try:
        home = Path(environment["HOME"]) if "HOME" in environment else Path.home()
    except RuntimeError:
        return None
    # A home that does not exist is not ours to make.
    if not home.is_dir():
        return None
    return home / ("Library/Caches" if system == "darwin" else ".cache")


def trim(folder: Path, max_bytes: int) -> None:
    """Removes the files of a folder that have not been used for longest, down to a size."""
    files = []
    try:
        for entry in os.scandir(folder):
            facts = entry.stat()
            files.append((max(facts.st_atime, facts.st_mtime), facts.st_size, entry.path))
        excess = sum(size for _, size, _ in files) - max_bytes
        for _, size, path in sorted(files):
            if excess <= 0:
                return
            os.unlink(path)
            excess -= size
    except OSError:  # another command removes the same, or it is not ours: another time
        return


def _cpu_fact(*names: str) -> str:
    """What Linux says of the processor under the first of these names it has, else ""."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line.split(":", 1)[-1].strip() for line in lines if line.startswith(names)), "")
