import numpy as np
import pytest
import torch
from sklearn.cluster import MeanShift

from pnet.postprocess import mean_shift as module
from pnet.postprocess.mean_shift import mean_shift
from pnet.postprocess.neighbourhoods import climb, nearest_mode


def pile_of_votes(seed: int, bodies: int, points: int, spread: float) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    low, high = [-0.07, -0.07, 0.6], [0.07, 0.07, 0.65]
    votes = rng.uniform(low, high, (bodies, 3))[rng.integers(0, bodies, points)]
    votes += rng.normal(0, spread, votes.shape)
    votes[: points // 20] = rng.uniform(low, high, (points // 20, 3))
    return torch.from_numpy(votes)


@pytest.mark.parametrize("spread", [0.0005, 0.0015, 0.004])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_clusters_are_those_of_scikit_learn(seed, spread):
    votes = pile_of_votes(seed, bodies=20, points=1500, spread=spread)
    modes, labels = mean_shift(votes, bandwidth=0.006, min_seed_points=5)
    check_against_scikit_learn(votes, modes, labels, 0.006, 5)


@pytest.mark.parametrize(("bandwidth", "min_seed_points"), [(0.006, 5), (0.01, 40)])
def test_a_full_scene_is_clustered_as_by_scikit_learn(bandwidth, min_seed_points):
    """Sixty bodies, 16,384 points, a twentieth of them anywhere."""
    votes = pile_of_votes(3, bodies=60, points=16384, spread=0.0007)
    modes, labels = mean_shift(votes, bandwidth, min_seed_points)
    check_against_scikit_learn(votes, modes, labels, bandwidth, min_seed_points)


def check_against_scikit_learn(votes, modes, labels, bandwidth, min_seed_points):
    twin = MeanShift(
        bandwidth=bandwidth, bin_seeding=True, min_bin_freq=min_seed_points, cluster_all=False
    ).fit(votes.numpy())
    np.testing.assert_allclose(modes.numpy(), twin.cluster_centers_, atol=1e-9)
    np.testing.assert_array_equal(labels.numpy(), twin.labels_)


@pytest.mark.parametrize("search", [climb, module._climb])
def test_a_seed_that_sees_no_point_stays_and_counts_none(search):
    """Eight corners 8.6 mm away from the second seed, a bandwidth of 8 mm."""
    corner = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)]).double()
    points = torch.cat([0.004 * corner, 0.005 * corner + 0.1])
    seeds = torch.tensor([[0.001, 0, 0], [0.1, 0.1, 0.1]], dtype=torch.float64)
    centres, seen = search(points, seeds, 0.008, 8e-6, 300)
    assert seen.tolist() == [8, 0]
    torch.testing.assert_close(centres, seeds.new_tensor([[0.0] * 3, [0.1] * 3]), rtol=0, atol=1e-15)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("spread", [0.0007, 0.004])
def test_the_compiled_search_is_the_plain_one_whatever_the_number_of_threads(spread, threads, monkeypatch):
    votes = pile_of_votes(4, bodies=30, points=4000, spread=spread)
    seeds = module._seeds(votes, 0.006, 2)
    plain = module._climb(votes, seeds, 0.006, 6e-6, 300)
    alone = climb(votes, seeds, 0.006, 6e-6, 300)
    modes = module._distinct(*plain, 0.006)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    found = climb(votes, seeds, 0.006, 6e-6, 300)
    torch.testing.assert_close(found[0], plain[0], rtol=0, atol=1e-9)
    assert torch.equal(found[1], plain[1])
    assert torch.equal(found[0], alone[0]) and torch.equal(found[1], alone[1])
    assert torch.equal(nearest_mode(votes, modes, 0.006), module._nearest_mode(votes, modes, 0.006))


def test_seeds_are_the_cells_with_enough_points():
    votes = pile_of_votes(5, bodies=10, points=900, spread=0.002)
    cells, count = torch.unique((votes / 0.006).round(), dim=0, return_counts=True)
    assert torch.equal(module._seeds(votes, 0.006, 5), cells[count >= 5] * 0.006)
    wide = torch.cat([votes[:200], votes[:200] + 1e30])  # too far apart to be numbered as a grid
    assert len(module._seeds(wide, 0.006, 1)) == len(torch.unique((wide / 0.006).round(), dim=0))
    assert module._seeds(votes[:0], 0.006, 1).shape == (0, 3)


def test_two_balls_have_their_means_as_modes_and_a_stray_point_has_none():
    ball = torch.tensor([[0.0, 0, 0], [0.001, 0, 0], [0, 0.001, 0], [-0.001, -0.001, 0]], dtype=torch.float64)
    votes = torch.cat([ball, ball[:3] + 0.05, torch.tensor([[0.2, 0, 0]], dtype=torch.float64)])
    modes, labels = mean_shift(votes, bandwidth=0.01, min_seed_points=3)
    torch.testing.assert_close(modes, torch.stack([ball.mean(0), (ball[:3] + 0.05).mean(0)]))
    assert labels.tolist() == [0, 0, 0, 0, 1, 1, 1, -1]


def test_nothing_dense_enough_gives_no_mode():
    modes, labels = mean_shift(torch.eye(3, dtype=torch.float64), bandwidth=0.1, min_seed_points=2)
    assert modes.shape == (0, 3)
    assert labels.tolist() == [-1, -1, -1]
