"""The radius filter: CUDA kernels against the CPU's."""

from dataclasses import replace

import pytest
import torch

from pnet.postprocess.grouping import Groups
from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.neighbour_count import neighboured
from pnet.postprocess.radius_filter import RadiusFilter

RF = RadiusFilter(radius=0.01, neighbours=3, widen=0.002, max_radius=0.02, enough=0.1)


def standing(*size: int) -> Groups:
    sizes = torch.tensor(size)
    return Groups(torch.arange(len(size)).repeat_interleave(sizes), sizes, max(size))


def moved(groups: Groups, here) -> Groups:
    owner, size = here(groups.owner, groups.size)
    return replace(groups, owner=owner, size=size)


@pytest.mark.parametrize(
    "size, neighbours", [((1,), 0), ((1,), 1), ((5, 1, 130, 2, 20), 3), ((64, 64), 20)], ids=str
)
def test_the_same_votes_have_neighbours_as_on_the_cpu(here, size, neighbours):
    """Two columns, tight and wide clusters; votes on a grid, so that many distances are the radius."""
    groups, g = standing(*size), torch.Generator().manual_seed(0)
    places = torch.randint(0, 9, (len(groups.owner), 2, 3), generator=g).double() / 512
    places[:, 1] *= 4
    rf = replace(RF, neighbours=neighbours, radius=1 / 256, max_radius=0.007, enough=0.6)
    expected = rf(places, groups)
    with only(Kernels.TRITON):
        found = rf(*here(places), moved(groups, here))
    assert torch.equal(found.cpu(), expected)


def test_clusters_that_are_done_are_not_searched(here):
    groups = standing(30, 30)
    votes, done = torch.zeros(60, 2, 3).double(), torch.tensor([[True, False], [False, True]])
    with only(Kernels.TRITON):
        near = neighboured(*here(votes), moved(groups, here), *here(done), 3, 0.01)
    assert near.cpu().view(2, 30, 2).all(1).tolist() == [[False, True], [True, False]]
    assert near.cpu().view(2, 30, 2).any(1).tolist() == [[False, True], [True, False]]


def test_a_distance_that_is_the_radius_is_within_it(here):
    """√(0.1² + 0.2²) squared again is not the sum of the squares in floating point."""
    votes, groups = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0]], dtype=torch.float64)[:, None], standing(2)
    verdicts = set()
    for radius in (0.22360679774997894, 0.22360679774997896, 0.223606797749979):
        within = radius * radius >= 0.1 * 0.1 + 0.2 * 0.2
        with only(Kernels.TRITON):
            near = neighboured(*here(votes), moved(groups, here), *here(torch.zeros(1, 1).bool()), 1, radius)
        assert near.tolist() == [[within]] * 2
        verdicts.add(within)
    assert verdicts == {True, False}
