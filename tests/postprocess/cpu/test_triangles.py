"""The compiled search for the nearest place on triangles against the plain one, trimesh and by hand."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F

from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.surface_registration import nearest_on_triangles

BOTH = pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
Case = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def a_case(q: int, n: int, f: int, seed: int, single: float = 0.0) -> Case:
    """Points, corners, normals, facing; a share of the triangles is three times one place, of any normal."""
    generator = torch.Generator().manual_seed(seed)
    local = 0.02 * torch.randn(q, n, 3, generator=generator).double()
    corners = 0.02 * torch.randn(f, 3, 3, generator=generator).double()
    side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = F.normalize(torch.linalg.cross(side, other), dim=-1)
    alone = torch.rand(f, generator=generator) < single
    corners = torch.where(alone[:, None, None], corners[:, :1], corners)
    anyhow = F.normalize(torch.randn(f, 3, generator=generator).double(), dim=-1)
    normals = torch.where(alone[:, None], anyhow, normals)
    return local, corners, normals, torch.rand(q, f, generator=generator) < 0.6


def reference(points: torch.Tensor, corners: torch.Tensor) -> np.ndarray:
    """(n, f) distances by trimesh, which does without normals; metres."""
    n, f = len(points), len(corners)
    triangles, places = 1000 * corners.numpy(), 1000 * points.numpy()  # in metres too small for trimesh
    nearest = trimesh.triangles.closest_point(np.tile(triangles, (n, 1, 1)), np.repeat(places, f, 0))
    return np.linalg.norm(nearest.reshape(n, f, 3) - places[:, None], axis=2) / 1000


@settings(max_examples=25, deadline=None)
@given(q=st.integers(1, 4), n=st.integers(1, 9), f=st.integers(1, 40), seed=st.integers(0, 10**6))
@BOTH
def test_the_place_is_on_its_triangle_and_none_that_faces_is_nearer(kernels, q, n, f, seed):
    local, corners, normals, facing = a_case(q, n, f, seed)
    facing[:, 0] |= ~facing.any(1)
    with only(kernels):
        place, which = nearest_on_triangles(local, corners, normals, facing)
    assert place.shape == (q, n, 3) and which.shape == (q, n) and which.dtype == torch.int64
    assert bool(facing.gather(1, which).all())
    for pose in range(q):
        distance = torch.linalg.vector_norm(local[pose] - place[pose], dim=-1)
        expected = reference(local[pose], corners)
        least = expected[:, facing[pose].numpy()].min(1)
        np.testing.assert_allclose(distance, least, rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(expected[np.arange(n), which[pose]], least, rtol=1e-7, atol=1e-10)
        on = reference(place[pose], corners)[np.arange(n), which[pose]]
        np.testing.assert_allclose(on, 0, atol=1e-9)


@BOTH
@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((1, 1, 5), (1, 1, 0)),  # over the middle, before it and behind it
        ((1, 1, -5), (1, 1, 0)),
        ((2, -3, 1), (2, 0, 0)),  # past each of the sides
        ((-2, 1, 1), (0, 1, 0)),
        ((4, 3, 0), (2.5, 1.5, 0)),
        ((-1, -2, 3), (0, 0, 0)),  # past each of the corners
        ((6, -1, 0), (4, 0, 0)),
        ((-1, 7, 2), (0, 4, 0)),
        ((1, 2, 0), (1, 2, 0)),  # on it
    ],
)
def test_every_region_of_a_triangle_by_hand(kernels, point, expected):
    corners = torch.tensor([[[0, 0, 0], [4, 0, 0], [0, 4, 0]]], dtype=torch.float64)
    normals = torch.tensor([[0, 0, 1]], dtype=torch.float64)
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        given = torch.tensor([[point]], dtype=torch.float64), corners[:, order], normals
        with only(kernels):
            place, which = nearest_on_triangles(*given, torch.ones(1, 1, dtype=torch.bool))
        assert place[0, 0].tolist() == pytest.approx(expected, abs=1e-12) and which.tolist() == [[0]]


@settings(max_examples=20, deadline=None)
@given(n=st.integers(1, 9), f=st.integers(1, 40), seed=st.integers(0, 10**6))
@BOTH
def test_of_places_alone_it_is_the_nearest(kernels, n, f, seed):
    """Triangles of three times one place, whatever their normals."""
    local, corners, normals, _ = a_case(1, n, f, seed, single=1.1)
    with only(kernels):
        place, which = nearest_on_triangles(local, corners, normals, torch.ones(1, f, dtype=torch.bool))
    assert torch.equal(which[0], torch.cdist(local[0], corners[:, 0]).argmin(1))
    torch.testing.assert_close(place[0], corners[which[0], 0], rtol=0, atol=1e-15)


@BOTH
def test_the_nearer_triangle_does_not_count_where_another_faces(kernels):
    """Two in parallel planes, a point 1 mm over the one and 3 mm over the other."""
    flat = torch.tensor([[0, 0, 0], [0.004, 0, 0], [0, 0.004, 0]], dtype=torch.float64)
    corners = torch.stack([flat, flat - torch.tensor([0, 0, 0.002], dtype=torch.float64)])
    normals = torch.tensor([[0, 0, 1], [0, 0, 1]], dtype=torch.float64)
    facing = torch.tensor([[True, True], [False, True], [True, False]])
    local = torch.tensor([0.001, 0.001, 0.001], dtype=torch.float64).expand(3, 1, 3)
    with only(kernels):
        place, which = nearest_on_triangles(local, corners, normals, facing)
    assert which.tolist() == [[0], [1], [0]]
    np.testing.assert_allclose(place[:, 0, 2], [0, -0.002, 0], rtol=0, atol=1e-15)


@BOTH
def test_where_none_faces_it_is_the_first_corner_of_all(kernels):
    local, corners, normals, facing = a_case(3, 4, 10, 0)
    facing[1] = False
    with only(kernels):
        place, which = nearest_on_triangles(local, corners, normals, facing)
    assert which[1].tolist() == [0] * 4 and torch.equal(place[1], corners[0, 0].expand(4, 3))
    assert bool(facing[[0, 2]].gather(1, which[[0, 2]]).all())
    assert float((place[[0, 2]] - corners[0, 0]).norm(dim=-1).min()) > 0


@settings(max_examples=20, deadline=None)
@given(q=st.integers(1, 4), n=st.integers(0, 30), f=st.integers(1, 120), seed=st.integers(0, 10**6))
def test_kernel_and_plain_agree(q, n, f, seed):
    """Triangles and places alone mixed; some poses show none."""
    local, corners, normals, facing = a_case(q, n, f, seed, single=0.3)
    facing[0] &= seed % 2 == 0
    with only(Kernels.PLAIN):
        plain = nearest_on_triangles(local, corners, normals, facing)
    compiled = nearest_on_triangles(local, corners, normals, facing)
    torch.testing.assert_close(compiled[0], plain[0], rtol=0, atol=1e-12)
    assert torch.equal(compiled[1], plain[1])


@BOTH
@pytest.mark.parametrize(("q", "n"), [(1, 1), (3, 7)])
def test_what_is_given_stays(kernels, q, n):
    case = a_case(q, n, 20, 2, single=0.3)
    kept = [x.clone() for x in case]
    with only(kernels):
        nearest_on_triangles(*case)
    assert all(torch.equal(a, b) for a, b in zip(kept, case, strict=True))
