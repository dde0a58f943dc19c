"""Paired comparison of a variant with a baseline over seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

_LEVEL = 0.95
_POWER = 0.8
MOST_SEEDS = 1000  # beyond which nobody asks


@dataclass(frozen=True)
class Comparison:
    """How much larger a variant's error is than the baseline's, over n pairs of equal seed.

    Attributes:
      difference: mean over pairs, variant - baseline; above 0 the baseline is better.
      low, high: ends of its 95 % confidence interval (paired t); None with fewer than two pairs.
      p_value: of the two-sided paired t-test; None likewise.
      seeds_needed: pairs with which that test would find such a difference at 5 % in four of five
        studies; None where it is beyond ``MOST_SEEDS``, or cannot be told.
      pairs: n.
    """

    difference: float
    low: float | None
    high: float | None
    p_value: float | None
    seeds_needed: int | None
    pairs: int

    @property
    def is_seen(self) -> bool:
        """Whether the interval leaves out zero."""
        return self.low is not None and self.high is not None and not self.low <= 0 <= self.high


def compare(variant: Sequence[float], baseline: Sequence[float]) -> Comparison:
    """Compares errors that are paired by seed.

    Args:
      variant, baseline: n errors, of equal seeds at equal places.
    """
    differences = np.asarray(variant, np.float64) - np.asarray(baseline, np.float64)
    count, mean = len(differences), float(differences.mean())
    if count < 2:
        return Comparison(mean, None, None, None, None, count)
    deviation = float(differences.std(ddof=1))
    error = deviation / math.sqrt(count)
    half = float(stats.t.ppf(0.5 + _LEVEL / 2, count - 1)) * error
    if deviation == 0.0:  # the same in all pairs: a variant that changes nothing, or all alike
        p_value, needed = (1.0, None) if mean == 0.0 else (0.0, 2)
    else:
        p_value = float(2.0 * stats.t.sf(abs(mean) / error, count - 1))
        needed = seeds_needed(abs(mean) / deviation)
    return Comparison(mean, mean - half, mean + half, p_value, needed, count)


def seeds_needed(effect: float) -> int | None:
    """Smallest number of pairs at which a paired t-test finds an effect in four of five studies.

    Args:
      effect: mean of the differences over their standard deviation.

    Returns:
      None where it is beyond ``MOST_SEEDS``.
    """
    low, high = 2, MOST_SEEDS
    if _power(effect, high) < _POWER:
        return None
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if _power(effect, middle) >= _POWER else (middle + 1, high)
    return low


def _power(effect: float, count: int) -> float:
    """Chance that a two-sided paired t-test at 5 % finds an effect."""
    limit = stats.t.ppf(0.5 + _LEVEL / 2, count - 1)
    shift = effect * math.sqrt(count)
    either = stats.nct.sf(limit, count - 1, shift) + stats.nct.cdf(-limit, count - 1, shift)
    # Far from the limit scipy's distribution underflows to NaN: the effect is plain then.
    return 1.0 if np.isnan(either) else float(either)
