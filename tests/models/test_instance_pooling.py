"""Points share features where their centroid votes meet, and nowhere else."""

import pytest
import torch

from pnet.models.instance_pooling import SIDES, InstancePooling, pooling_of

F, CELL, SCALE = 5, 0.006, 0.02


@pytest.fixture
def pooling() -> InstancePooling:
    torch.manual_seed(0)
    return InstancePooling(F, 7, CELL, SCALE).double().eval()


def two_instances(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features, points and votes of 40 points that vote for two places far from any cell's border."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(1, 40, F, dtype=torch.float64, generator=generator)
    points = 0.02 * torch.randn(1, 40, 3, dtype=torch.float64, generator=generator)
    centre = torch.tensor([[0.2, 0.3, 100.1], [5.2, -3.7, 101.2]], dtype=torch.float64) * CELL
    votes = centre[torch.arange(40) % 2] + 0.02 * CELL * torch.rand(1, 40, 3, generator=generator)
    return features, points, votes.double()


def naive_means(own: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """The mean over the points of the same cell, point by point."""
    cells = [tuple(row) for row in place.floor().long().tolist()]
    rows = [own[[k for k, other in enumerate(cells) if other == cell]].mean(0) for cell in cells]
    return torch.stack(rows)


def test_pooled_features_are_the_means_of_a_naive_loop(pooling):
    generator = torch.Generator().manual_seed(1)
    own = torch.randn(1, 60, 7, dtype=torch.float64, generator=generator)
    place = 3 * torch.rand(1, 60, 3, dtype=torch.float64, generator=generator)  # 27 cells, all below SIDES
    pooled = pooling._pooled(own, place)
    torch.testing.assert_close(pooled[0], naive_means(own[0], place[0]), rtol=0, atol=1e-6)


def test_votes_a_table_apart_share_a_cell_and_others_do_not(pooling):
    own = torch.tensor([[[1.0], [3.0], [5.0]]], dtype=torch.float64)
    place = torch.tensor([[[0.5, 0.5, 0.5], [0.5 + SIDES[0], 0.5, 0.5 - SIDES[2]], [1.5, 0.5, 0.5]]]).double()
    assert pooling._pooled(own, place).flatten().tolist() == [2.0, 2.0, 5.0]


def test_a_point_learns_of_its_own_instance_only(pooling):
    features, points, votes = two_instances()
    before = pooling(features, points, votes)
    changed = features.clone()
    changed[0, 0] += 1.0
    moved = (pooling(changed, points, votes) - before).abs().amax((0, 2)) > 1e-9
    assert moved[0::2].any() and not moved[1::2].any()


def test_the_points_order_does_not_matter(pooling):
    features, points, votes = two_instances()
    order = torch.randperm(40, generator=torch.Generator().manual_seed(3))
    turned = pooling(features[:, order], points[:, order], votes[:, order])
    torch.testing.assert_close(turned, pooling(features, points, votes)[:, order], rtol=0, atol=1e-6)


def test_scenes_of_a_batch_do_not_mix(pooling):
    one, other = two_instances(0), two_instances(1)
    both = pooling(*(torch.cat(pair) for pair in zip(one, other, strict=True)))
    torch.testing.assert_close(both[:1], pooling(*one), rtol=0, atol=1e-6)
    torch.testing.assert_close(both[1:], pooling(*other), rtol=0, atol=1e-6)


def test_features_get_a_gradient_and_votes_none(pooling):
    features, points, votes = two_instances()
    features.requires_grad_()
    votes.requires_grad_()
    pooling(features, points, votes).square().sum().backward()
    assert votes.grad is None and bool((features.grad.abs().sum(-1) > 0).all())


def test_the_votes_of_an_untrained_network_are_taken_wherever_they_are(pooling):
    features, points, votes = two_instances()
    assert bool(pooling(features, points, 1e9 * votes).isfinite().all())


@pytest.mark.parametrize("cell", [0.0, -0.006])
def test_a_cell_without_width_is_refused(cell):
    with pytest.raises(ValueError, match=rf"model\.pooling is {cell}, expected a positive width"):
        pooling_of(F, cell, SCALE)


def test_no_cell_is_no_pooling():
    assert pooling_of(F, None, SCALE) is None
