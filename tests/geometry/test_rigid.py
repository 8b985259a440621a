"""Rigid transforms and the least-squares fit."""

import math

import pytest
import roma
import torch

from pnet.geometry.rigid import (
    apply_inverse_pose,
    apply_pose,
    axis_angle_between,
    fit_rigid,
    rotation_angle,
)


@pytest.fixture(autouse=True)
def seed():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def random_poses(n: int, dtype=torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    return roma.random_rotmat(n, dtype=dtype), torch.randn(n, 3, dtype=dtype)


def test_apply_pose_turns_then_moves():
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = apply_pose(quarter, torch.tensor([10.0, 0, 0]), torch.tensor([[1.0, 2, 3]]))
    assert moved.tolist() == [[8, 1, 3]]


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_apply_inverse_pose_undoes_apply_pose(dtype, atol):
    R, t = random_poses(6, dtype)
    points = torch.randn(6, 5, 3, dtype=dtype)
    back = apply_inverse_pose(R, t, apply_pose(R, t, points))
    torch.testing.assert_close(back, points, atol=atol, rtol=0)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 1e-4), (torch.float64, 1e-9)])
def test_fit_rigid_recovers_the_pose(weighted, dtype, atol):
    R, t = random_poses(50, dtype)
    source = torch.randn(50, 8, 3, dtype=dtype)
    weight = torch.rand(50, 8, dtype=dtype) + 0.1 if weighted else None
    R_fit, t_fit = fit_rigid(source, apply_pose(R, t, source), weight)
    torch.testing.assert_close(R_fit, R, atol=atol, rtol=0)
    torch.testing.assert_close(t_fit, t, atol=atol, rtol=0)


def test_fit_rigid_recovers_the_pose_from_three_points():
    R, t = random_poses(50)
    source = torch.eye(3).double().expand(50, 3, 3)
    R_fit, t_fit = fit_rigid(source, apply_pose(R, t, source))
    torch.testing.assert_close(R_fit, R, atol=1e-9, rtol=0)
    torch.testing.assert_close(t_fit, t, atol=1e-9, rtol=0)


def test_fit_rigid_leaves_out_points_without_weight():
    R, t = random_poses(20)
    source = torch.randn(20, 6, 3).double()
    target = apply_pose(R, t, source)
    target[:, 0] += 5.0
    weight = torch.ones(20, 6).double()
    weight[:, 0] = 0
    R_fit, t_fit = fit_rigid(source, target, weight)
    torch.testing.assert_close(R_fit, R, atol=1e-9, rtol=0)
    torch.testing.assert_close(t_fit, t, atol=1e-9, rtol=0)


def test_fit_rigid_weighs_like_repeated_points():
    source, target = torch.randn(2, 5, 3).double()
    weight = torch.tensor([1, 2, 1, 3, 1])
    fit = fit_rigid(source, target, weight.double())
    repeated = fit_rigid(source.repeat_interleave(weight, 0), target.repeat_interleave(weight, 0))
    torch.testing.assert_close(fit, repeated, atol=1e-9, rtol=0)


def test_fit_rigid_of_a_mirrored_target_is_still_a_rotation():
    source = torch.randn(30, 7, 3).double()
    R, _ = fit_rigid(source, source * torch.tensor([1.0, 1.0, -1.0]).double())
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(30).double())


def test_fit_rigid_is_the_least_squares_minimum():
    source, target = torch.randn(2, 10, 3).double()
    R, t = fit_rigid(source, target)
    best = (apply_pose(R, t, source) - target).square().sum()
    for nudge in 0.01 * torch.randn(50, 6).double():
        turned = roma.rotvec_to_rotmat(nudge[:3]) @ R
        assert (apply_pose(turned, t + nudge[3:], source) - target).square().sum() > best


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 1.0, 90.0, 180.0])
def test_rotation_angle_is_the_angle_of_the_turn_between(degrees):
    vector = math.radians(degrees) * torch.tensor([0.6, 0.0, 0.8]).double()
    R, _ = random_poses(1)
    angle = rotation_angle(R, R @ roma.rotvec_to_rotmat(vector))
    assert angle.item() == pytest.approx(math.radians(degrees), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1.0, 90.0, 180.0 - 1e-7, 180.0])
def test_axis_angle_between_is_exact_at_both_ends(degrees):
    radians = math.radians(degrees)
    a = torch.tensor([2.0, 0, 0], dtype=torch.float64)
    b = torch.tensor([math.cos(radians), math.sin(radians), 0], dtype=torch.float64)
    assert axis_angle_between(a, b).item() == pytest.approx(radians, abs=1e-14)
