"""The compiled first hits of rays against the plain ones, the triangles' planes, and the rendering."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pnet.geometry.camera import Camera
from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.surface import sample_surface
from pnet.postprocess.surface_registration import first_hit
from pnet.scenes.rendering import render_view

BOTH = pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
CAMERA = Camera(64, 48, 400.0, 400.0, 31.5, 23.5, near=0.3, far=1.0)
Case = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def turned_to(camera: torch.Tensor, corners: torch.Tensor) -> torch.Tensor:
    """(q, f) which triangles show the cameras (q, 3) their outside."""
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return ((camera[:, None] - corners[:, 0]) * normal).sum(-1) > 0


def a_case(q: int, r: int, f: int, seed: int) -> Case:
    """Places within a soup of triangles seen from 0.5 m; of those that face some are said not to."""
    generator = torch.Generator().manual_seed(seed)
    corners = 0.02 * torch.randn(f, 3, 3, generator=generator).double()
    seen = 0.02 * torch.randn(q, r, 3, generator=generator).double()
    camera = torch.randn(q, 3, generator=generator).double()
    camera = 0.5 * camera / torch.linalg.vector_norm(camera, dim=-1, keepdim=True)
    said = torch.rand(q, f, generator=generator) < 0.8
    return seen, camera, corners, said & turned_to(camera, corners)


def naive(
    place: np.ndarray, camera: np.ndarray, corners: np.ndarray, facing: np.ndarray
) -> tuple[float, float]:
    """Share of the way to the nearest hit with a triangle's plane on the inner side of all its edges, and how
    nearly any triangle's edge was met, as a share of the triangle's size."""
    least, margin = math.inf, math.inf
    for (a, b, c), shown in zip(corners, facing, strict=True):
        normal = np.cross(b - a, c - a)
        if not shown:
            continue
        share = normal @ (a - camera) / (normal @ (place - camera))
        hit = camera + share * (place - camera)
        edges = ((a, b), (b, c), (c, a))
        inner = [np.cross(end - start, hit - start) @ normal / (normal @ normal) for start, end in edges]
        margin = min(margin, *map(abs, inner))
        if min(inner) >= 0 and share > 0:
            least = min(least, share)
    return least, margin


@settings(max_examples=25, deadline=None)
@given(q=st.integers(1, 3), r=st.integers(1, 9), f=st.integers(1, 30), seed=st.integers(0, 10**6))
@BOTH
def test_a_ray_meets_the_first_plane_within_its_triangle(kernels, q, r, f, seed):
    case = a_case(q, r, f, seed)
    with only(kernels):
        found = first_hit(*case)
    assert found.shape == (q, r) and found.dtype == torch.float64
    seen, camera, corners, facing = (x.numpy() for x in case)
    for i in range(q):
        for j in range(r):
            expected, margin = naive(seen[i, j], camera[i], corners, facing[i])
            if margin > 1e-7:  # on an edge either may be right
                assert float(found[i, j]) == pytest.approx(expected, rel=1e-9)


@BOTH
def test_both_outcomes_occur(kernels):
    """Of the cases above: a fair share of the rays meets something, before the place and behind it."""
    with only(kernels):
        found = first_hit(*a_case(3, 200, 30, 0))
    hit = found[found.isfinite()]
    assert 0.1 < len(hit) / 600 < 0.95 and float(hit.min()) < 0.99 and float(hit.max()) > 1.01


SQUARE = torch.tensor(  # 2 × 2 in the plane z = 1, its outside towards the origin
    [[[-1, -1, 1], [-1, 1, 1], [1, 1, 1]], [[-1, -1, 1], [1, 1, 1], [1, -1, 1]]], dtype=torch.float64
)


@BOTH
@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.3, -0.5, 2), 0.5),  # half way
        ((-0.5, 0.3, 2), 0.5),  # the other triangle
        ((0, 0, 4), 0.25),  # on the edge that both share
        ((0.2, 0.1, 1), 1),  # on it
        ((0.2, 0.1, 0.5), 2),  # the place lies before the square
        ((2.2, 0, 2), math.inf),  # beside it
        ((-2.2, 0, 2), math.inf),
        ((0, 2.2, 2), math.inf),
        ((0, -2.2, 2), math.inf),
        ((0.1, 0.2, -2), math.inf),  # the other way
        ((1, 1, 0), math.inf),  # along its plane
        ((0, 0, 0), math.inf),  # the camera itself: padding
    ],
)
def test_a_square_by_hand(kernels, place, expected):
    camera = torch.zeros(1, 3, dtype=torch.float64)
    assert bool(turned_to(camera, SQUARE).all())
    with only(kernels):
        found = first_hit(
            torch.tensor([[place]], dtype=torch.float64), camera, SQUARE, turned_to(camera, SQUARE)
        )
        nothing = first_hit(
            torch.tensor([[place]], dtype=torch.float64), camera, SQUARE, torch.zeros(1, 2, dtype=torch.bool)
        )
    assert float(found) == pytest.approx(expected, abs=1e-12) and float(nothing) == math.inf


@BOTH
def test_the_nearer_of_two_squares_counts_unless_it_does_not_face(kernels):
    corners = torch.cat([SQUARE + torch.tensor([0, 0, 0.5], dtype=torch.float64), SQUARE])
    seen, camera = torch.tensor([[[0.1, 0.3, 3]]] * 2, dtype=torch.float64), torch.zeros(2, 3).double()
    facing = torch.tensor([[True] * 4, [True, True, False, False]])
    with only(kernels):
        found = first_hit(seen, camera, corners, facing)
    np.testing.assert_allclose(found[:, 0], [1 / 3, 0.5], rtol=1e-12)


@BOTH
def test_places_alone_stand_in_no_rays_way(kernels):
    """Triangles of three times one place, rays straight through them."""
    places = torch.tensor([[0, 0, 1], [0.1, 0.2, 1]], dtype=torch.float64)
    with only(kernels):
        found = first_hit(
            2 * places[None],
            torch.zeros(1, 3, dtype=torch.float64),
            places[:, None].expand(-1, 3, -1).contiguous(),
            torch.ones(1, 2, dtype=torch.bool),
        )
    assert found.tolist() == [[math.inf, math.inf]]


@BOTH
@pytest.mark.parametrize("name", ["tn06", "tn34", "tn42"])
def test_depths_are_those_of_the_rendering(kernels, name, request):
    """Whole parts, pixel by pixel; a pixel on the outline may be met by one alone."""
    part = request.getfixturevalue(name)
    size = part.grids["L"].mean(0)
    triangles = sample_surface(part, tuple(size.tolist()), 10).triangles
    R = Rotation.random(2, np.random.default_rng(0)).as_matrix()
    t = np.array([[0.004, -0.003, 0.5], [-0.002, 0.001, 0.6]])
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].reshape(2, -1)
    ends = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 0 * u + 1.0], -1)  # 1 m deep
    seen = torch.from_numpy((ends - t[:, None]) @ R)
    camera, corners = torch.from_numpy(-(t[:, None] @ R)[:, 0]), torch.from_numpy(triangles.corners)
    with only(kernels):
        found = first_hit(seen, camera, corners, turned_to(camera, corners)).numpy()
    for i in range(2):
        view = render_view(CAMERA, part.mesh(size), R[i : i + 1], t[i : i + 1])
        depth, hit = view.depth.ravel(), view.instance.ravel() == 0
        both = hit & np.isfinite(found[i])
        assert hit.sum() > 150 and (hit != np.isfinite(found[i])).sum() <= 2
        np.testing.assert_allclose(found[i][both], depth[both], rtol=0, atol=2e-6)


@settings(max_examples=20, deadline=None)
@given(q=st.integers(1, 3), r=st.integers(0, 40), f=st.integers(1, 80), seed=st.integers(0, 10**6))
def test_kernel_and_plain_agree(q, r, f, seed):
    seen, camera, corners, facing = a_case(q, r, f, seed)
    seen = torch.cat([seen, camera[:, None]], 1)  # padding
    with only(Kernels.PLAIN):
        plain = first_hit(seen, camera, corners, facing)
    found = first_hit(seen, camera, corners, facing)
    torch.testing.assert_close(found, plain, rtol=1e-10, atol=0)
    assert found[:, -1].tolist() == [math.inf] * q
