"""The radius filter on CUDA: a program owns a block of votes, each of which walks through its own cluster.

A vote is content as soon as it has found enough others, in a dense cluster after a few; the program ends
when all of its votes are content or through.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.launch import EXACT, block, on_device_of
from pnet.postprocess.grouping import Groups

VOTES = 128  # of a program
AT_ONCE = 8  # of the others that are read together


def neighboured(votes: Tensor, groups: Groups, done: Tensor, neighbours: int, radius: float) -> Tensor:
    """See `pnet.postprocess.neighbour_count`."""
    m, q, _ = votes.shape
    near = torch.empty(m, q, dtype=torch.bool, device=votes.device)
    size = block(m, VOTES)
    if near.numel():
        with on_device_of(votes):
            _neighboured[triton.cdiv(m, size), q](
                votes.contiguous(), groups.owner.contiguous(), groups.size.contiguous(),
                groups.size.cumsum(0), done.contiguous(), near,
                votes.new_full((1,), radius * radius), m, q, neighbours,
                VOTES=size, AT_ONCE=AT_ONCE, **EXACT,
            )  # fmt: skip
    return near


@triton.jit
def _neighboured(
    votes, owner, size, end, done, near, limit, m, q, neighbours,
    VOTES: tl.constexpr, AT_ONCE: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * VOTES + tl.arange(0, VOTES)
    column = tl.program_id(1)
    own = i < m
    cluster = tl.load(owner + i, own, 0)
    count = tl.load(size + cluster, own, 0).to(tl.int32)
    first = tl.load(end + cluster, own, 0) - count
    searches = own & (tl.load(done + cluster * q + column, own, 1) == 0)
    at = votes + (i * q + column) * 3
    x, y, z = tl.load(at, own, 0.0), tl.load(at + 1, own, 0.0), tl.load(at + 2, own, 0.0)
    reach = tl.load(limit)
    missing = tl.where(searches, neighbours + 1, 0)  # a vote is near itself
    left = tl.max(tl.where(missing > 0, count, 0))
    step = tl.min(missing) * 0
    while step < left:
        for s in tl.static_range(AT_ONCE):
            inside = own & (step + s < count)
            other = votes + ((first + step + s) * q + column) * 3
            dx = tl.load(other, inside, 0.0) - x
            dy = tl.load(other + 1, inside, 0.0) - y
            dz = tl.load(other + 2, inside, 0.0) - z
            missing -= (inside & ((dx * dx + dy * dy) + dz * dz <= reach)).to(tl.int32)
        step += AT_ONCE
        left = tl.max(tl.where(missing > 0, count, 0))
    tl.store(near + i * q + column, searches & (missing <= 0), own)
