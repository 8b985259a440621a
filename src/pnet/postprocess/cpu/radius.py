"""The radius filter on the CPU: a cluster is one thread's, radius after radius."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import Array
from pnet.postprocess.grouping import Groups


def near_enough(
    votes: Tensor, groups: Groups, neighbours: int, enough: float, radii: Sequence[float]
) -> Tensor:
    """See `pnet.postprocess.neighbour_count`."""
    end = groups.size.cumsum(0).numpy()
    kept = torch.empty(votes.shape[1], len(votes), dtype=torch.bool)
    for column, keep in zip(votes.unbind(1), kept, strict=True):
        arrays = column.contiguous().numpy(), end, neighbours, enough, np.array(radii), keep.numpy()
        in_parts(partial(_near_enough, *arrays), len(end))
    return kept.mT


@kernel
def _near_enough(
    votes: Array,
    end: Array,
    neighbours: int,
    enough: float,
    radii: Array,
    kept: Array,
    begin: int,
    stop: int,
) -> None:
    for cluster in range(begin, stop):
        first, last = end[cluster - 1] if cluster else 0, end[cluster]
        for radius in radii:
            found = 0
            for i in range(first, last):
                kept[i] = _has_neighbours(votes, first, last, i, neighbours, radius * radius)
                found += kept[i]
            if found / (last - first) >= enough:
                break
        else:
            if found == 0:  # nothing is dense enough: better all votes than an instance without any
                kept[first:last] = True


@kernel
def _has_neighbours(votes: Array, first: int, last: int, i: int, neighbours: int, reach: float) -> bool:
    """Whether vote i of a cluster [first, last) has so many others within the root of `reach`."""
    x, y, z = votes[i]
    missing = neighbours + 1  # it is near itself
    for j in range(first, last):
        dx, dy, dz = votes[j, 0] - x, votes[j, 1] - y, votes[j, 2] - z
        missing -= dx * dx + dy * dy + dz * dz <= reach
        if missing <= 0:
            return True
    return False
