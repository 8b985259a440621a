"""Many fits at once against the library's, one batch each."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import apply_pose, fit_rigid
from pnet.postprocess.cpu.fits import fit_rigid_many


def clouds(rows: int, n: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Source, weight, R, t; metres."""
    generator = torch.Generator().manual_seed(seed)
    source = 0.02 * torch.randn(rows, n, 3, dtype=torch.float64, generator=generator)
    weight = torch.rand(rows, n, dtype=torch.float64, generator=generator) + 0.05
    R = torch.from_numpy(Rotation.random(rows, random_state=seed).as_matrix())
    return source, weight, R, torch.rand(rows, 3, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("n", [3, 4, 7])
def test_exact_points_give_the_pose_back(n):
    source, weight, R, t = clouds(500, n)
    found_R, found_t = fit_rigid_many(source, apply_pose(R, t, source), weight)
    assert float((found_R - R).abs().max()) < 1e-12 and float((found_t - t).abs().max()) < 1e-13


@pytest.mark.parametrize("n", [3, 4, 7])
@pytest.mark.parametrize("mirrored", [False, True])
def test_noisy_points_give_the_librarys_fit(n, mirrored):
    source, weight, R, t = clouds(500, n, seed=1)
    target = apply_pose(R, t, source) + 0.002 * torch.randn(500, n, 3, dtype=torch.float64)
    if mirrored and n > 3:  # the best rotation is far from fitting; three points always fit somehow
        source = source * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    expected_R, expected_t = fit_rigid(source, target, weight)
    found_R, found_t = fit_rigid_many(source, target, weight)
    assert float((found_R - expected_R).abs().max()) < 1e-8
    assert float((found_t - expected_t).abs().max()) < 1e-9
    torch.testing.assert_close(found_R @ found_R.mT, torch.eye(3).double().expand_as(R), rtol=0, atol=1e-14)
    assert bool((torch.linalg.det(found_R) > 0).all())


def test_points_without_weight_do_not_count():
    source, weight, R, t = clouds(50, 5)
    target = apply_pose(R, t, source)
    target[:, 4] += 1.0
    weight[:, 4] = 0
    assert float((fit_rigid_many(source, target, weight)[0] - R).abs().max()) < 1e-12


def test_points_on_a_line_fit_whatever_the_turn():
    source, weight, R, t = clouds(50, 3)
    source = source[:, :1] * torch.tensor([0.0, 1.0, -2.0], dtype=torch.float64)[:, None]
    target = apply_pose(R, t, source)
    found_R, found_t = fit_rigid_many(source, target, weight)
    assert float((apply_pose(found_R, found_t, source) - target).abs().max()) < 1e-13


def test_points_in_one_place_are_brought_there():
    source, weight, _, t = clouds(20, 4)
    found_R, found_t = fit_rigid_many(source, t[:, None].expand(-1, 4, -1), weight)
    middle = (weight[..., None] * source).sum(1) / weight.sum(1, keepdim=True)
    torch.testing.assert_close(apply_pose(found_R, found_t, middle[:, None])[:, 0], t)


def test_leading_dimensions_and_views_are_kept():
    source, weight, R, t = clouds(12, 4)
    target = apply_pose(R, t, source)
    grid = [x.view(3, 4, *x.shape[1:]) for x in (source[:4].repeat(3, 1, 1), target, weight)]
    found_R, found_t = fit_rigid_many(source[:4].expand(3, 4, 4, 3), grid[1], grid[2])
    expected_R, expected_t = fit_rigid_many(*grid)
    assert found_R.shape == (3, 4, 3, 3) and found_t.shape == (3, 4, 3)
    assert torch.equal(found_R, expected_R) and torch.equal(found_t, expected_t)


def test_threads_do_not_change_the_fits():
    source, weight, R, t = clouds(1000, 4)
    target = apply_pose(R, t, source) + 0.001
    threads, found = torch.get_num_threads(), []
    for count in (1, 3):
        torch.set_num_threads(count)
        found.append(fit_rigid_many(source, target, weight))
    torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_nothing_that_counts_gives_a_finite_fit():
    source, weight, _, _ = clouds(3, 4)
    found_R, found_t = fit_rigid_many(source, source, 0 * weight)
    assert torch.equal(found_R, torch.eye(3).double().expand(3, 3, 3)) and not bool(found_t.any())
