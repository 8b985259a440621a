"""Clouds in runs of near points, each with its tight box: a search leaves out the runs that cannot matter.

Rounding is monotone, so the distance to a box, computed in the same order as that to a point, is never above
that of a point in it: what is left out by it cannot be what is sought.
"""

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

WAYS = 8  # parts of a cut: sorts are few, and parts are hardly longer than those of halvings


class Buckets(NamedTuple):
    """Clouds in the order of their buckets; all of them hold as many places, a power of two.

    Attributes:
        place: (B, 3, S) points by axis, metres; those behind the last are copies of it.
        number: (B, S) int32 where each stood in its cloud; N and more for copies.
        low, high: (B, 3, buckets) their boxes, metres.
    """

    place: Tensor
    number: Tensor
    low: Tensor
    high: Tensor


def build_buckets(points: Tensor, size: int) -> Buckets:
    """Cut clouds along their longest sides until a bucket is left, every part on its own.

    Args:
        points: (B, N, 3) metres. size: places of a bucket, a power of two.
    """
    B, n, _ = points.shape
    count = triton.next_power_of_2(triton.cdiv(n, size))
    number = torch.arange(count * size, device=points.device)
    place = points.transpose(1, 2).index_select(2, number.clamp(max=n - 1))
    number = number.expand(B, -1)
    parts = 1
    while parts < count:
        place, number = _sort_parts(place, number, parts)
        parts = min(parts * WAYS, count)
    low, high = place.view(B, 3, count, size).aminmax(dim=3)
    return Buckets(place, number.int().contiguous(), low, high)


def _sort_parts(place: Tensor, number: Tensor, parts: int) -> tuple[Tensor, Tensor]:
    """Sort each of so many equal parts along its longest side."""
    B, _, slots = place.shape
    place = place.view(B, 3, parts, -1)
    low, high = place.aminmax(dim=3)
    axis = (high - low).argmax(1)[:, None, :, None]
    order = place.gather(1, axis.expand_as(place[:, :1])).sort(dim=3, stable=True).indices
    place = place.gather(3, order.expand_as(place))
    return place.view(B, 3, slots), number.reshape(B, parts, -1).gather(2, order[:, 0]).view(B, slots)


@triton.jit
def coordinates(pointer, STEP: tl.constexpr):
    """x, y and z, which stand STEP apart."""
    return tl.load(pointer), tl.load(pointer + STEP), tl.load(pointer + 2 * STEP)


@triton.jit
def sortable(square):
    """The bits of squared distances (or −1) as whole numbers: in the same order, and reduced faster."""
    return square.to(tl.int32 if square.dtype == tl.float32 else tl.int64, bitcast=True)


@triton.jit
def box_offset(low, high, x):
    """How far a coordinate lies outside boxes along an axis, metres."""
    return tl.maximum(tl.maximum(low - x, x - high), 0.0)
