"""The largest row of groups that stand in a row, and its reverse: every group has one owner."""

import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.gathering import ROWS, full
from pnet.ops.cpu.tree import Array
from pnet.ops.grouping import check_winners


def group_max(rows: Tensor) -> tuple[Tensor, Tensor]:
    """See `pnet.ops.grouping`."""
    if rows.shape[2] == 0:
        raise ValueError(f"groups of shape {tuple(rows.shape)} have no rows")
    values = full(rows).flatten(0, 1)
    out = values.new_empty(values.shape[::2])
    winner = torch.empty(out.shape, dtype=torch.int32)
    arrays = values.numpy(), out.numpy(), winner.numpy()
    in_parts(lambda a, b: _group_max(*arrays, a, b), len(values), ROWS)
    shape = *rows.shape[:2], rows.shape[3]
    return out.to(rows.dtype).view(shape), winner.view(shape)


def ungroup_max(grad: Tensor, winner: Tensor, k: int) -> Tensor:
    """See `pnet.ops.grouping`."""
    check_winners(winner, grad)
    taken = grad.detach().contiguous().flatten(0, 1)
    if taken.element_size() == 2:  # nothing is added, so the bits will do: numba knows no short floats
        taken = taken.view(torch.int16)
    out = taken.new_empty(len(taken), k, grad.shape[2])
    arrays = taken.numpy(), winner.contiguous().flatten(0, 1).numpy(), out.numpy()
    in_parts(lambda a, b: _ungroup_max(*arrays, a, b), len(taken), ROWS)
    return out.view(grad.dtype).view(*grad.shape[:2], k, grad.shape[2])


@kernel
def _group_max(rows: Array, out: Array, winner: Array, start: int, stop: int) -> None:
    k, c = rows.shape[1:]
    for group in range(start, stop):
        to, who = out[group], winner[group]
        for j in range(c):
            to[j], who[j] = rows[group, 0, j], 0
        for s in range(1, k):
            at = rows[group, s]
            for j in range(c):
                # not-a-number wins, so that it is seen
                better = at[j] > to[j] or (at[j] != at[j] and to[j] == to[j])
                to[j] = at[j] if better else to[j]
                who[j] = s if better else who[j]


@kernel
def _ungroup_max(grad: Array, winner: Array, out: Array, start: int, stop: int) -> None:
    k, c = out.shape[1:]
    none = out.dtype.type(0)
    for group in range(start, stop):
        at, who = grad[group], winner[group]
        for s in range(k):
            to = out[group, s]
            for j in range(c):
                to[j] = at[j] if who[j] == s else none
