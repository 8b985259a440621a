import numpy as np
import pytest
import torch
from sklearn.cluster import MeanShift

from pnet.postprocess.mean_shift import mean_shift


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
    twin = MeanShift(bandwidth=0.006, bin_seeding=True, min_bin_freq=5, cluster_all=False).fit(votes.numpy())
    np.testing.assert_allclose(modes.numpy(), twin.cluster_centers_, atol=1e-9)
    np.testing.assert_array_equal(labels.numpy(), twin.labels_)


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
