"""Rows in bins."""

import numpy as np

from pnet.reporting.breakdown_bins import fixed_bins, quantile_bins, value_bins


def test_fixed_bins_take_their_lower_border_and_the_last_one_its_upper_too():
    bins = fixed_bins("x", np.array([0.0, 0.5, 0.99, 1.0, 2.0, np.nan, 2.1]), np.array([0.0, 1.0, 2.0]))
    assert bins.count.tolist() == [3, 2] and bins.labels == ["0–1", "1–2"]
    assert bins.member[1].tolist() == [False, False, False, True, True, False, False]


def test_an_empty_bin_is_left_out():
    bins = fixed_bins("x", np.array([0.5, 2.5]), np.array([0.0, 1.0, 2.0, 3.0]))
    assert bins.low.tolist() == [0, 2] and bins.high.tolist() == [1, 3]


def test_quantile_bins_hold_as_many_and_never_divide_equal_values():
    bins = quantile_bins("x", np.arange(100.0)[::-1], 4)
    assert bins.count.tolist() == [25] * 4
    bins = quantile_bins("x", np.array([1.0] * 7 + [2.0, 3.0, np.inf, np.nan]), 3)
    assert bins.low[0] == bins.high[0] == 1 and bins.count[0] == 7 and bins.count.sum() == 9


def test_nothing_finite_makes_no_bin():
    assert quantile_bins("x", np.full(5, np.nan), 4).labels == []
    assert fixed_bins("x", np.full(5, np.nan), np.arange(3.0)).member.shape == (0, 5)
    assert value_bins("x", np.zeros(0)).labels == []


def test_few_values_have_a_bin_each_and_many_are_gathered():
    bins = value_bins("r, mm", np.array([12.0, 14, 12, 16.5]))
    assert bins.labels == ["12", "14", "16.5"] and bins.count.tolist() == [2, 1, 1]
    assert len(value_bins("r, mm", np.arange(40.0)).labels) == 8
