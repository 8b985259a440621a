"""Errors of matched poses."""

import math

import pytest
import roma
import torch

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    cyclic,
    dihedral,
    rotation_about_z,
)
from pnet.metrics.pose_error import axis_error, parameter_error, position_error

EYE = torch.eye(3, dtype=torch.float64)


@pytest.fixture(autouse=True)
def seed():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def space(symmetry, frame_R=EYE, frame_t=0 * EYE[0]) -> PoseSpace:
    return PoseSpace(symmetry, EYE, frame_R, frame_t, 0.1)


def turn(axis: list[float], degrees: float) -> torch.Tensor:
    axis = torch.tensor(axis, dtype=torch.float64)
    return roma.rotvec_to_rotmat(math.radians(degrees) * axis / axis.norm())


def test_position_error_is_measured_at_the_surface_centroid():
    # the centroid lies 0.2 m along x, so a half turn about z carries it by 0.4 m
    body = space(cyclic(2), frame_t=torch.tensor([-0.2, 0, 0], dtype=torch.float64))
    zero = torch.zeros(3, dtype=torch.float64)
    error = position_error(body, EYE[None], zero[None], turn([0, 0, 1], 180)[None], zero[None])
    torch.testing.assert_close(error, torch.tensor([0.4]).double())


def test_a_translation_is_its_length_in_any_frame():
    R, t = roma.random_rotmat(5).double(), torch.rand(5, 3).double()
    frame = space(cyclic(1), roma.random_rotmat().double(), torch.rand(3).double())
    move = torch.tensor([0.3, 0.0, -0.4]).double()
    torch.testing.assert_close(position_error(frame, R, t, R, t + move), torch.full((5,), 0.5).double())


@pytest.mark.parametrize(("reflected", "expected"), [(False, [30, 150, 0]), (True, [30, 30, 0])])
def test_axis_error_of_a_revolution(reflected, expected):
    R = torch.stack([turn([1, 0, 0], 30), turn([0, 1, 0], 150), turn([0, 0, 1], 77)])
    error = axis_error(space(RevolutionSymmetry(reflected)), EYE, R)
    torch.testing.assert_close(error.rad2deg(), torch.tensor(expected).double())


def test_axis_error_without_symmetry_is_the_rotation_angle():
    error = axis_error(space(cyclic(1)), EYE, turn([1, 2, 3], 41))
    assert math.degrees(error) == pytest.approx(41)


def test_axis_error_of_a_finite_group_is_the_smallest_angle():
    R = torch.stack([turn([0, 0, 1], 65), turn([0, 0, 1], 120) @ turn([1, 0, 0], 7)])
    error = axis_error(space(cyclic(6)), EYE, R)
    torch.testing.assert_close(error.rad2deg(), torch.tensor([5.0, 7.0]).double())


def test_axis_error_takes_the_group_in_the_inertial_frame():
    # the body's symmetry axis is its x; the inertial frame turns it to z
    frame = turn([0, 1, 0], -90)
    body = space(cyclic(4), frame)
    torch.testing.assert_close(frame @ EYE[0], EYE[2])
    assert math.degrees(axis_error(body, EYE, turn([1, 0, 0], 90))) == pytest.approx(0, abs=1e-6)
    assert math.degrees(axis_error(body, EYE, turn([0, 0, 1], 90))) == pytest.approx(90)


def test_symmetry_elements_on_the_right_change_nothing():
    group = dihedral(3)
    frame = roma.random_rotmat().double()
    body = space(group, frame)
    in_body = FiniteSymmetry(frame.T @ group.rotations @ frame).rotations
    a, b = roma.random_rotmat(2).double()
    torch.testing.assert_close(axis_error(body, a, b @ in_body), axis_error(body, a, b).expand(6))


def test_a_sphere_has_no_axis_error():
    R = roma.random_rotmat(4).double()
    assert axis_error(space(SphericalSymmetry()), R, EYE).tolist() == [0, 0, 0, 0]


def test_single_precision_poses_are_measured_in_double():
    R = rotation_about_z(torch.tensor([0.01]))
    t = torch.zeros(1, 3)
    assert position_error(space(cyclic(1)), R, t, R, t).dtype == torch.float64
    assert axis_error(space(cyclic(1)), R, EYE).dtype == torch.float64


def test_parameter_error_is_absolute_for_each_parameter():
    a, b = torch.tensor([[1.0, 5.0]]), torch.tensor([[3.0, 4.5]])
    assert parameter_error(a, b).tolist() == [[2.0, 0.5]]
    with pytest.raises(ValueError, match="shapes"):
        parameter_error(a, b[:, :1])
