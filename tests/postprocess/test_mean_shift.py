import numpy as np
import pytest
import torch
from sklearn.cluster import MeanShift

from pnet.postprocess.climb import climb, distinct, nearest_mode
from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.mean_shift import find_seeds, mean_shift

BOTH = pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])


def pile_of_votes(seed: int, bodies: int, points: int, spread: float) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    low, high = [-0.07, -0.07, 0.6], [0.07, 0.07, 0.65]
    votes = rng.uniform(low, high, (bodies, 3))[rng.integers(0, bodies, points)]
    votes += rng.normal(0, spread, votes.shape)
    votes[: points // 20] = rng.uniform(low, high, (points // 20, 3))
    return torch.from_numpy(votes)


def clustered(votes: torch.Tensor, bandwidth: float, min_seed_points: int):
    """Modes (d, 3) and labels (N,) of one scene (N, 3)."""
    everything = torch.ones(1, len(votes), dtype=torch.bool)
    modes, number, labels = mean_shift(votes[None], everything, bandwidth, min_seed_points)
    return modes[0, : number[0]], labels[0]


def every(points: torch.Tensor) -> torch.Tensor:
    return torch.ones(points.shape[:2], dtype=torch.bool)


@pytest.mark.parametrize("spread", [0.0005, 0.0015, 0.004])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_clusters_are_those_of_scikit_learn(seed, spread):
    votes = pile_of_votes(seed, bodies=20, points=1500, spread=spread)
    check_against_scikit_learn(votes, 0.006, 5)


@pytest.mark.parametrize(("bandwidth", "min_seed_points"), [(0.006, 5), (0.01, 40)])
def test_a_full_scene_is_clustered_as_by_scikit_learn(bandwidth, min_seed_points):
    """Sixty bodies, 16,384 points, a twentieth of them anywhere."""
    check_against_scikit_learn(pile_of_votes(3, 60, 16384, 0.0007), bandwidth, min_seed_points)


def test_plain_torch_finds_the_clusters_of_scikit_learn_too():
    with only(Kernels.PLAIN):
        check_against_scikit_learn(pile_of_votes(1, 20, 1500, 0.0015), 0.006, 5)


def check_against_scikit_learn(votes, bandwidth, min_seed_points):
    modes, labels = clustered(votes, bandwidth, min_seed_points)
    twin = MeanShift(
        bandwidth=bandwidth, bin_seeding=True, min_bin_freq=min_seed_points, cluster_all=False
    ).fit(votes.numpy())
    np.testing.assert_allclose(modes.numpy(), twin.cluster_centers_, atol=1e-9)
    np.testing.assert_array_equal(labels.numpy(), twin.labels_)


@BOTH
def test_every_scene_of_a_batch_has_the_modes_it_has_alone(kernels):
    """Scenes of many modes, of few, of none, and one without a point that counts."""
    scenes = [pile_of_votes(seed, bodies, 600, 0.001) for seed, bodies in ((0, 20), (1, 3), (2, 9))]
    scenes.insert(1, torch.arange(600.0).double()[:, None].expand(-1, 3))
    points = torch.stack(scenes)
    counted = torch.ones(4, 600, dtype=torch.bool)
    counted[3] = False
    with only(kernels):
        modes, number, labels = mean_shift(points, counted, 0.006, 5)
        for i in range(3):
            own, own_labels = clustered(points[i], 0.006, 5)
            assert torch.equal(modes[i, : number[i]], own) and torch.equal(labels[i], own_labels)
    assert number[0] > number[2] > 0 and number[1] == number[3] == 0
    assert labels[3].tolist() == [-1] * 600


@BOTH
def test_a_seed_that_sees_no_point_stays_and_counts_none(kernels):
    """Eight corners 8.6 mm away from the second seed, a bandwidth of 8 mm; the third is none."""
    corner = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)]).double()
    points = torch.cat([0.004 * corner, 0.005 * corner + 0.1])[None]
    seeds = torch.tensor([[[0.001, 0, 0], [0.1, 0.1, 0.1], [torch.nan] * 3]], dtype=torch.float64)
    with only(kernels):
        centres, seen = climb(points, every(points), seeds, 0.008, 8e-6, 300)
    assert seen.tolist() == [[8, 0, 0]]
    torch.testing.assert_close(centres[0, :2], seeds.new_tensor([[0.0] * 3, [0.1] * 3]), rtol=0, atol=1e-15)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("spread", [0.0007, 0.004])
def test_the_compiled_search_is_the_plain_one_whatever_the_number_of_threads(spread, threads, monkeypatch):
    votes = torch.stack([pile_of_votes(seed, 30, 2000, spread) for seed in (4, 5)])
    counted = torch.rand(2, 2000, generator=torch.Generator().manual_seed(0)) < 0.9
    counted[1, 1000:] = False
    seeds = find_seeds(votes, counted, 0.006, 2)
    assert bool(seeds.isnan().any())  # one scene has fewer
    given = votes, counted, seeds, 0.006, 6e-6, 300
    with only(Kernels.PLAIN):
        plain = climb(*given)
        stays = distinct(plain[0], plain[1] > 0, 0.006)
        labels = nearest_mode(votes, *front(plain[0], stays), 0.006)
    alone = climb(*given)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    found = climb(*given)
    torch.testing.assert_close(found[0], plain[0], rtol=0, atol=1e-9, equal_nan=True)
    assert torch.equal(found[1], plain[1]) and torch.equal(found[1], alone[1])
    assert torch.equal(found[0].nan_to_num(), alone[0].nan_to_num())
    assert torch.equal(distinct(plain[0], plain[1] > 0, 0.006), stays)
    assert torch.equal(nearest_mode(votes, *front(plain[0], stays), 0.006), labels)
    assert int(labels.max()) > 20 and int(labels.min()) == -1


def front(centres: torch.Tensor, stays: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Those that stay in front, and how many."""
    order = torch.argsort((~stays).byte(), dim=1, stable=True)
    return centres.gather(1, order[..., None].expand(-1, -1, 3)), stays.sum(1)


def one_after_the_other(centres: torch.Tensor, seen: torch.Tensor, bandwidth: float) -> list[bool]:
    """The rule, centre by centre."""
    kept: list[int] = []
    for i in range(len(centres)):
        if bool(seen[i]) and all(float((centres[i] - centres[j]).norm()) > bandwidth for j in kept):
            kept.append(i)
    return [i in kept for i in range(len(centres))]


@BOTH
@pytest.mark.parametrize("width", [0.004, 0.03, 0.2])
def test_what_stays_of_near_modes_is_decided_one_after_the_other(kernels, width):
    """Also chains, in which a mode stays because the one that would send it away is sent away itself."""
    g = torch.Generator().manual_seed(0)
    centres = width * torch.rand(3, 40, 3, generator=g, dtype=torch.float64)
    centres[2] = torch.arange(40)[:, None] * torch.tensor([0.004, 0, 0])
    seen = torch.rand(3, 40, generator=g) < 0.8
    seen[2] = True
    with only(kernels):
        stays = distinct(centres, seen, 0.006)
    for centre, own, found in zip(centres, seen, stays, strict=True):
        assert found.tolist() == one_after_the_other(centre, own, 0.006)
    assert stays[2].tolist() == [True, False] * 20


@BOTH
def test_a_point_between_two_modes_goes_to_the_first(kernels):
    points = torch.tensor([[[0.5, 0, 0], [0.6, 0, 0], [3, 0, 0]]] * 3, dtype=torch.float64)
    modes = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0]]] * 3, dtype=torch.float64)
    with only(kernels):
        labels = nearest_mode(points, modes, torch.tensor([2, 0, 3]), 1.0)
    assert labels.tolist() == [[0, 1, -1], [-1, -1, -1], [2, 2, -1]]


def seeds_of(votes: torch.Tensor, bandwidth: float, min_seed_points: int) -> torch.Tensor:
    return find_seeds(votes[None], every(votes[None]), bandwidth, min_seed_points)[0]


def test_seeds_are_the_cells_with_enough_points():
    votes = pile_of_votes(5, bodies=10, points=900, spread=0.002)
    cells, count = torch.unique((votes / 0.006).round(), dim=0, return_counts=True)
    assert torch.equal(seeds_of(votes, 0.006, 5), cells[count >= 5] * 0.006)
    wide = torch.cat([votes[:200], votes[:200] + 1e30])  # too far apart to be numbered as a grid
    assert len(seeds_of(wide, 0.006, 1)) == len(torch.unique((wide / 0.006).round(), dim=0))
    assert seeds_of(votes[:0], 0.006, 1).shape == (0, 3)


def test_a_cell_on_both_sides_of_zero_is_one():
    votes = torch.tensor([[-0.001, 0.001, -0.001], [0.001, -0.001, 0.001]]).double()
    assert seeds_of(votes, 0.006, 2).tolist() == [[0, 0, 0]]


def test_seeds_of_a_batch_stand_in_their_own_rows():
    votes = torch.stack([pile_of_votes(seed, bodies, 300, 0.001) for seed, bodies in ((5, 3), (6, 12))])
    counted = every(votes)
    counted[1, ::3] = False
    seeds = find_seeds(votes, counted, 0.006, 4)
    few, many = seeds_of(votes[0], 0.006, 4), seeds_of(votes[1, counted[1]], 0.006, 4)
    assert 0 < len(few) < len(many) == seeds.shape[1]
    assert torch.equal(seeds[0, : len(few)], few) and bool(seeds[0, len(few) :].isnan().all())
    assert torch.equal(seeds[1], many)


def test_two_balls_have_their_means_as_modes_and_a_stray_point_has_none():
    ball = torch.tensor([[0.0, 0, 0], [0.001, 0, 0], [0, 0.001, 0], [-0.001, -0.001, 0]], dtype=torch.float64)
    votes = torch.cat([ball, ball[:3] + 0.05, torch.tensor([[0.2, 0, 0]], dtype=torch.float64)])
    modes, labels = clustered(votes, bandwidth=0.01, min_seed_points=3)
    torch.testing.assert_close(modes, torch.stack([ball.mean(0), (ball[:3] + 0.05).mean(0)]))
    assert labels.tolist() == [0, 0, 0, 0, 1, 1, 1, -1]


@BOTH
def test_nothing_dense_enough_gives_no_mode(kernels):
    with only(kernels):
        modes, labels = clustered(torch.eye(3, dtype=torch.float64), bandwidth=0.1, min_seed_points=2)
    assert modes.shape == (0, 3)
    assert labels.tolist() == [-1, -1, -1]


@BOTH
@pytest.mark.parametrize("shape", [(0, 5, 3), (2, 0, 3)])
def test_nothing_at_all_gives_no_mode(kernels, shape):
    points = torch.zeros(shape, dtype=torch.float64)
    with only(kernels):
        modes, number, labels = mean_shift(points, every(points), 0.1, 1)
    assert modes.shape == (shape[0], 0, 3) and labels.shape == shape[:2] and number.tolist() == [0] * shape[0]
