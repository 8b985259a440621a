"""The robust mean: by hand, against outliers, and the compiled one against plain torch."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.location import location


def test_the_location_by_hand():
    """Median 0.01, distances 0.01, 0, 0.01; with cut 2 the weights at 1/2 are 9/16; the far one has none."""
    values = torch.tensor([[[0.0], [0.01], [0.02], [5.0]]], dtype=torch.float64)
    centre, spread = location(values, torch.ones(1, 4, dtype=torch.bool), 2.0)
    assert float(centre) == pytest.approx(0.01)
    assert float(spread) == pytest.approx(0.01 * math.sqrt(2 * 9 / 16 / (1 + 2 * 9 / 16)))


def test_the_location_leaves_invalid_entries_out():
    values = torch.tensor([[[1.0, 2.0]] * 3 + [[7.0, 7.0]] * 5, [[3.0, 4.0]] * 8], dtype=torch.float64)
    valid = torch.tensor([[True] * 3 + [False] * 5, [True] * 8])
    centre, spread = location(values, valid, 3.0)
    assert centre.tolist() == [[1, 2], [3, 4]] and spread.tolist() == [0, 0]


@pytest.mark.parametrize("wild", [0, 10, 45])
def test_the_location_of_a_cloud_is_its_middle_whatever_lies_far_off(wild):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(1, 100, 3, generator=generator, dtype=torch.float64)
    values[:, :wild] += 1000
    centre, spread = location(values, torch.ones(1, 100, dtype=torch.bool), 3.0)
    assert float(centre.norm()) < 0.4
    assert 1 < float(spread) < 2  # √3 for the whole cloud


def test_scattered_votes_keep_their_median():
    """Two votes, each a median distance or more from the middle of a cut below one: neither counts."""
    values = torch.tensor([[[0.0, 1.0], [1.0, 0.0]]], dtype=torch.float64)
    centre, _ = location(values, torch.ones(1, 2, dtype=torch.bool), 0.5)
    assert centre.tolist() == [[0, 0]]


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 60),
    c=st.integers(1, 4),
    cut=st.sampled_from([0.5, 1.5, 3.0]),
)
def test_the_compiled_location_is_the_plain_one(seed, n, c, cut):
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(5, n, c, generator=generator, dtype=torch.float64)
    values[:, ::4] *= 20
    values[1] = values[1, :1]  # all equal
    valid = torch.rand(5, n, generator=generator) < 0.8
    valid[:, 0] = True
    found = location(values, valid, cut)
    with only(Kernels.PLAIN):
        expected = location(values, valid, cut)
    torch.testing.assert_close(found[0], expected[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(found[1], expected[1], rtol=0, atol=1e-9)
