"""Which votes have enough others of their own cluster around them, radius after radius."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pnet.ops.operators import squared_distance
from pnet.postprocess.grouping import Groups
from pnet.postprocess.kernels import Kernels, step

CHUNK = 2**22  # distances that the plain search holds at a time


@step("radius", Kernels.NUMBA)
def near_enough(
    votes: Tensor, groups: Groups, neighbours: int, enough: float, radii: Sequence[float]
) -> Tensor:
    """Which votes have so many others of their cluster within a radius.

    Args:
        votes: (M, q, 3) float64, metres; each column by itself. groups: how they stand.
        neighbours: how many others. enough: the share of a cluster's votes at which it is done.
        radii: tried until then, metres.
    Returns:
        (M, q) bool; all of a cluster's where at the last radius there is none.
    """
    kept = torch.zeros_like(votes[..., 0], dtype=torch.bool)
    found = torch.zeros(len(groups), votes.shape[1], dtype=torch.int64, device=votes.device)
    done = torch.zeros_like(found, dtype=torch.bool)
    for radius in radii:
        near = neighboured(votes, groups, done, neighbours, radius)
        found = torch.zeros_like(found).index_add_(0, groups.owner, near.long())
        kept = torch.where(done[groups.owner], kept, near)
        done = done | (found.double() / groups.size[:, None] >= enough)
    # nothing is dense enough: better all votes than an instance without any
    return kept | (~done & (found == 0))[groups.owner]


@step("radius", Kernels.TRITON)
def neighboured(votes: Tensor, groups: Groups, done: Tensor, neighbours: int, radius: float) -> Tensor:
    """One radius' search.

    Args:
        votes, groups, neighbours: as in `near_enough`. done: (d, q) bool, clusters that need no search.
        radius: metres.
    Returns:
        (M, q) bool, False for clusters that are done.
    """
    columns = votes.shape[1]
    near = torch.zeros(len(votes) + 1, columns, dtype=torch.bool, device=votes.device)
    some = max(1, CHUNK // max(1, groups.largest**2 * columns))  # clusters at a time
    for index, valid in zip(*(x.split(some) for x in groups.first(groups.largest)), strict=True):
        place = votes[index].transpose(1, 2)  # (c, q, n, 3)
        square = squared_distance(place[..., None, :], place[..., None, :, :])
        count = ((square <= radius * radius) & valid[:, None, None]).sum(-1)
        # each is near itself; the last row takes what is not valid
        near[torch.where(valid, index, len(votes))] = (count > neighbours).transpose(1, 2)
    return near[:-1] & ~done[groups.owner]
