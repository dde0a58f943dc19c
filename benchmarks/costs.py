"""What a program computes and moves, as the compiler counts it, beside what the device can do.

A lower bound. The compiler counts the body of a loop once, however often it runs: farthest points,
scans and registration count too little. Of a conditional it counts the dearer branch. On
accelerators the products that libraries compute are calls of which the compiled program does not
say what they cost, so operations are counted before compilation, which adds and removes some, and
bytes after it, where those of such calls are missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from benchmarks import ceilings

COLUMNS = ("GFLOP/s", "of_matmul_%", "GB/s", "of_copy_%")


@dataclass(frozen=True)
class Costs:
    """Of one call; None where the backend does not say.

    Attributes:
      flops: floating-point operations.
      bytes: read and written by all operations; where caches serve some of them, their rate may
        exceed a copy's.
    """

    flops: float | None
    bytes: float | None


def of(lowered: Any, compiled: Any) -> Costs:
    """What a lowered program and what was compiled from it say about themselves."""
    return Costs(_counted(lowered, "flops"), _counted(compiled, "bytes accessed"))


def columns(costs: Costs, seconds: float, times: int = 1) -> dict[str, Any]:
    """Rates, and their shares of a float32 product's and of a copy's; "-" where not known.

    Args:
      costs: of the program.
      seconds: of a call.
      times: how often the call runs what ``costs`` counts once.
    """
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "-")
    found = zip((costs.flops, costs.bytes), (COLUMNS[:2], COLUMNS[2:]), (0, 1), strict=True)
    for amount, (rate_name, share_name), which in found:
        if amount is not None:
            rate = times * amount / seconds
            row[rate_name] = round(rate / 1e9, 2)
            row[share_name] = round(100 * rate / ceilings.rates()[which], 2)
    return row


def _counted(program: Any, key: str) -> float | None:
    """A figure of ``cost_analysis``, which is a dict, a list of one, or nothing."""
    try:
        analysis = program.cost_analysis()
    except (NotImplementedError, RuntimeError):
        return None
    if isinstance(analysis, list | tuple):
        analysis = analysis[0] if analysis else None
    value = (analysis or {}).get(key)
    # Unknown costs are also told as 0 or below.
    return float(value) if value is not None and math.isfinite(value) and value > 0 else None
