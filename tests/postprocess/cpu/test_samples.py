"""The compiled search for the nearest sample against the plain one and scipy."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.surface_registration import nearest_samples


def a_case(q: int, n: int, s: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    local = 0.02 * torch.randn(q, n, 3, generator=generator).double()
    samples = 0.02 * torch.randn(s, 3, generator=generator).double()
    return local, samples, torch.rand(q, s, generator=generator) < 0.6


@settings(max_examples=20, deadline=None)
@given(q=st.integers(1, 5), n=st.integers(1, 9), s=st.integers(1, 60), seed=st.integers(0, 10**6))
@pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
def test_each_point_has_the_nearest_of_the_samples_that_face(kernels, q, n, s, seed):
    local, samples, facing = a_case(q, n, s, seed)
    facing[:, 0] |= ~facing.any(1)
    with only(kernels):
        found = nearest_samples(local, samples, facing)
    assert found.shape == (q, n) and bool(facing.gather(1, found).all())
    for pose in range(q):
        expected = cKDTree(samples[facing[pose]].numpy()).query(local[pose].numpy())[0]
        distance = torch.linalg.vector_norm(local[pose] - samples[found[pose]], dim=-1)
        np.testing.assert_allclose(distance, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
def test_where_no_sample_faces_it_is_the_first(kernels):
    local, samples, facing = a_case(3, 4, 10, 0)
    facing[1] = False
    with only(kernels):
        found = nearest_samples(local, samples, facing)
    assert found[1].tolist() == [0] * 4 and bool(facing[[0, 2]].gather(1, found[[0, 2]]).all())


def test_kernel_and_plain_agree():
    local, samples, facing = a_case(20, 96, 700, 1)
    with only(Kernels.PLAIN):
        plain = nearest_samples(local, samples, facing)
    assert torch.equal(nearest_samples(local, samples, facing), plain)
