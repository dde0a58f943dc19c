"""Paired comparisons against scipy, published sample sizes and simulated studies."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from caper_jax.reproduce.paired import compare, seeds_needed


def test_difference_interval_and_p_value_are_scipys():
    rng = np.random.default_rng(0)
    variant, baseline = rng.normal(1.0, 0.5, 8), rng.normal(0.8, 0.5, 8)
    one = compare(variant, baseline)
    test = stats.ttest_rel(variant, baseline)
    interval = test.confidence_interval(0.95)
    assert one.difference == pytest.approx((variant - baseline).mean())
    assert (one.low, one.high) == pytest.approx((interval.low, interval.high))
    assert one.p_value == pytest.approx(test.pvalue)
    assert one.is_seen == (test.pvalue < 0.05)
    assert one.pairs == 8


def test_a_common_spread_of_the_seeds_hides_nothing():
    rng = np.random.default_rng(1)
    seeds = rng.normal(5.0, 3.0, 8)
    one = compare(seeds + 0.2 + 0.01 * rng.normal(size=8), seeds)
    assert one.is_seen and one.difference == pytest.approx(0.2, abs=0.02)


# Sample sizes of a two-sided paired t-test at 5 % with a power of 80 %, as G*Power gives them.
@pytest.mark.parametrize(
    ("effect", "pairs"), [(0.2, 199), (0.5, 34), (0.8, 15), (1.0, 10), (1.5, 6)]
)
def test_number_of_seeds_is_that_of_published_tables(effect, pairs):
    assert seeds_needed(effect) == pairs


def test_so_many_seeds_find_it_in_four_of_five_studies():
    rng, effect = np.random.default_rng(2), 0.9
    pairs = seeds_needed(effect)
    differences = rng.normal(effect, 1.0, (20_000, pairs))
    found = stats.ttest_1samp(differences, 0.0, axis=1).pvalue < 0.05
    fewer = stats.ttest_1samp(differences[:, :-1], 0.0, axis=1).pvalue < 0.05
    assert fewer.mean() < 0.8 + 0.01 and found.mean() > 0.8 - 0.01


def test_effects_beyond_any_number_of_seeds():
    assert seeds_needed(0.01) is None
    assert seeds_needed(50.0) == 2


def test_a_single_pair_has_no_interval():
    one = compare([2.0], [1.5])
    assert (one.difference, one.low, one.p_value, one.seeds_needed) == (0.5, None, None, None)
    assert not one.is_seen


def test_a_variant_that_changes_nothing():
    one = compare([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    assert (one.difference, one.low, one.high, one.p_value) == (0.0, 0.0, 0.0, 1.0)
    assert one.seeds_needed is None and not one.is_seen
