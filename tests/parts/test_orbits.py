"""Which of the equivalent directions an orbit picks (equation 1), against dense sampling and by hand."""

import math

import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.parts.orbits import RingOrbit, SphereOrbit, pair_orbit, point_orbit, polygon_orbit

FINITE = {
    "point": point_orbit((0, 0, 2)),
    "pair": pair_orbit((0, 0, 1)),
    "triangle": polygon_orbit(3),
    "hexagon": polygon_orbit(6),
}
ORBITS = {**FINITE, "ring": RingOrbit(), "sphere": SphereOrbit()}
LOOKING_DOWN = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))


@pytest.fixture(params=ORBITS.values(), ids=ORBITS.keys())
def orbit(request):
    return request.param


def dense_sample(orbit) -> torch.Tensor:
    """(q, 3) all directions of a finite orbit, half a degree apart on a ring, a degree on a sphere."""
    if hasattr(orbit, "directions"):
        return orbit.directions
    angle = torch.linspace(-math.pi, math.pi, 721, dtype=torch.float64)[:-1]
    if isinstance(orbit, RingOrbit):
        return torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    polar = torch.linspace(0, math.pi, 181, dtype=torch.float64)[:, None]
    grid = [polar.sin() * angle.cos(), polar.sin() * angle.sin(), polar.cos().expand(-1, len(angle))]
    return torch.stack(grid, -1).reshape(-1, 3)


def random_rotations(n: int, seed: int = 0) -> torch.Tensor:
    normal = torch.randn(n, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return roma.special_procrustes(normal)


def naive_nearest(directions: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
    """Smallest camera z, then y, then x, one by one."""
    rounded = (directions @ R.mT).mul(1e9).round().tolist()
    x, y, z = 0, 1, 2
    best = min(range(len(rounded)), key=lambda i: (rounded[i][z], rounded[i][y], rounded[i][x]))
    return directions[best]


def test_directions_are_unit_vectors_in_the_orbit_with_the_canonical_first(orbit):
    chosen = orbit.nearest_to_camera(random_rotations(50))
    torch.testing.assert_close(chosen.norm(dim=-1), torch.ones(50).double(), atol=1e-12, rtol=0)
    torch.testing.assert_close(orbit.project(chosen), chosen, atol=1e-12, rtol=0)
    if hasattr(orbit, "directions"):
        assert torch.equal(orbit.canonical, orbit.directions[0])
    torch.testing.assert_close(orbit.project(orbit.canonical), orbit.canonical)


@pytest.mark.parametrize("orbit", FINITE.values(), ids=FINITE.keys())
def test_a_finite_choice_is_the_exhaustive_minimum(orbit):
    R = random_rotations(200)
    expected = torch.stack([naive_nearest(orbit.directions, one) for one in R])
    assert torch.equal(orbit.nearest_to_camera(R), expected)


def test_no_sampled_direction_is_nearer_to_the_camera_than_the_choice(orbit):
    R = random_rotations(30)
    chosen = (R @ orbit.nearest_to_camera(R)[..., None])[:, 2, 0]
    sampled = (dense_sample(orbit) @ R.mT)[..., 2].amin(-1)
    assert (chosen <= sampled + 1e-12).all()
    assert (chosen >= sampled - 2e-4).all()  # a sample lies within half a step, 1 − cos(0.75°) of it


def test_views_exactly_along_an_axis_fall_back_to_y_and_then_x():
    """Along z all vertices are equally near; camera y is −y: 60° and 120° tie, and 120° has the smaller x."""
    half, high = 0.5, math.sqrt(0.75)
    torch.testing.assert_close(
        polygon_orbit(6).nearest_to_camera(LOOKING_DOWN), torch.tensor([-half, high, 0]).double()
    )
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(
        polygon_orbit(6).nearest_to_camera(eye), torch.tensor([-half, -high, 0]).double()
    )
    torch.testing.assert_close(
        RingOrbit().nearest_to_camera(LOOKING_DOWN), torch.tensor([0, 1.0, 0]).double()
    )
    torch.testing.assert_close(RingOrbit().nearest_to_camera(eye), torch.tensor([0, -1.0, 0]).double())


def test_a_pair_seen_from_the_side_falls_back_to_y_and_then_x():
    pair = pair_orbit((0, 0, 1))
    part_z_is_camera_y = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).double()
    assert pair.nearest_to_camera(part_z_is_camera_y).tolist() == [0, 0, -1]
    part_z_is_camera_x = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]).double()
    assert pair.nearest_to_camera(part_z_is_camera_x).tolist() == [0, 0, -1]
    part_z_is_against_camera_x = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]).double()
    assert pair.nearest_to_camera(part_z_is_against_camera_x).tolist() == [0, 0, 1]


def test_two_equally_near_vertices_are_told_apart_by_y():
    """The hexagon's axis lies along camera x, a side faces the camera: vertices 0 and 60° tie in z."""
    axis, to_camera = torch.tensor([0.0, 0, 1]), torch.tensor([math.sqrt(0.75), 0.5, 0])
    R = torch.stack([axis, torch.linalg.cross(-to_camera, axis), -to_camera]).double()
    torch.testing.assert_close(torch.linalg.det(R), torch.tensor(1.0).double(), atol=1e-6, rtol=0)
    z = (polygon_orbit(6).directions @ R.mT)[:, 2]
    assert abs(z[0] - z[1]) < 1e-7
    chosen = polygon_orbit(6).nearest_to_camera(roma.special_procrustes(R))
    torch.testing.assert_close(chosen, naive_nearest(polygon_orbit(6).directions, roma.special_procrustes(R)))


def test_batch_shape_and_dtype_follow_the_view(orbit):
    view = random_rotations(6).reshape(2, 3, 3, 3).float()
    chosen = orbit.nearest_to_camera(view)
    assert chosen.shape == (2, 3, 3) and chosen.dtype == torch.float32
    torch.testing.assert_close(chosen.double(), orbit.nearest_to_camera(view.double()), atol=1e-5, rtol=0)


@settings(max_examples=30, deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: math.hypot(d[0], d[1]) > 1e-3))
def test_projection_is_the_nearest_direction_of_the_orbit(direction):
    given_direction = torch.tensor(direction, dtype=torch.float64)
    for orbit in ORBITS.values():
        projected = orbit.project(given_direction)
        best = (dense_sample(orbit) @ given_direction).max()
        assert projected @ given_direction >= best - 1e-12
        assert orbit.project(7 * given_direction) @ given_direction >= best - 1e-12


def test_a_direction_upright_on_the_ring_projects_to_the_canonical_one():
    assert RingOrbit().project(torch.tensor([0.0, 0, -3])).tolist() == [1, 0, 0]
