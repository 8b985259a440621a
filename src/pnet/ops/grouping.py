"""The largest of rows that stand in groups already, with backward: no table of indices."""

from typing import Any

import torch
from torch import Tensor

from pnet.ops.operators import kernel, operator


def group_max(rows: Tensor) -> Tensor:
    """The largest row of each group, channel by channel.

    Args:
        rows: (B, M, k, C).
    Returns:
        (B, M, C). The gradient goes to the winner; among equal ones to the first of the group.
    """
    largest: Tensor = _group_max(rows)[0]
    return largest


def first_largest(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Largest of (B, M, k, C) over k and its first place (B, M, C) int64; not-a-number is larger than all."""
    largest, k = rows.amax(2), rows.shape[2]
    place = torch.arange(k, device=rows.device)[:, None]
    wins = (rows == largest[:, :, None]) | rows.isnan()
    return largest, torch.where(wins, place, k).amin(2)


def check_winners(winner: Tensor, grad: Tensor) -> None:
    """For kernels, which read where they are told: raise ValueError where the two differ in shape."""
    if winner.shape != grad.shape:
        raise ValueError(f"winners {tuple(winner.shape)} do not fit a gradient {tuple(grad.shape)}")


@operator
def _group_max(rows: Tensor) -> tuple[Tensor, Tensor]:
    """The maximum, and the place in its group (B, M, C) int32 that each channel comes from."""
    largest, first = first_largest(rows)
    return largest, first.int()


@operator
def _ungroup_max(grad: Tensor, winner: Tensor, k: int) -> Tensor:
    """The reverse of `_group_max`: (B, M, C) → (B, M, k, C), zeros but for the winners."""
    place = torch.arange(k, device=grad.device, dtype=winner.dtype)[:, None]
    return torch.where(winner[:, :, None] == place, grad[:, :, None], 0)


@kernel(_group_max, "cpu")
def _(rows: Tensor) -> tuple[Tensor, Tensor]:
    from pnet.ops.cpu import grouping as kernels

    return kernels.group_max(rows)


@kernel(_ungroup_max, "cpu")
def _(grad: Tensor, winner: Tensor, k: int) -> Tensor:
    from pnet.ops.cpu import grouping as kernels

    return kernels.ungroup_max(grad, winner, k)


@kernel(_group_max, "cuda")
def _(rows: Tensor) -> tuple[Tensor, Tensor]:
    from pnet.ops.cuda import grouping as kernels

    return kernels.group_max(rows)


@kernel(_ungroup_max, "cuda")
def _(grad: Tensor, winner: Tensor, k: int) -> Tensor:
    from pnet.ops.cuda import grouping as kernels

    return kernels.ungroup_max(grad, winner, k)


@_group_max.register_fake
def _(rows: Tensor) -> tuple[Tensor, Tensor]:
    shape = (*rows.shape[:2], rows.shape[3])
    return rows.new_empty(shape), rows.new_empty(shape, dtype=torch.int32)


@_ungroup_max.register_fake
def _(grad: Tensor, winner: Tensor, k: int) -> Tensor:
    return grad.new_empty(*grad.shape[:2], k, grad.shape[2])


def _keep_max(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    ctx.save_for_backward(output[1])
    ctx.k = inputs[0].shape[2]


def _max_backward(ctx: Any, grad: Tensor, _: None) -> Tensor:
    return _ungroup_max(grad, ctx.saved_tensors[0], ctx.k)


_group_max.register_autograd(_max_backward, setup_context=_keep_max)
