"""Robust means on the CPU, compiled: cluster by cluster, so without padding."""

import numpy as np
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import Array


def locate(values: Tensor, valid: Tensor, cut: float, floor: float, rounds: int) -> tuple[Tensor, Tensor]:
    """See `pnet.postprocess.location`."""
    centre, spread = values.new_empty(len(values), values.shape[2]), values.new_empty(len(values))
    given = values.contiguous().numpy(), valid.contiguous().numpy(), cut, floor, rounds
    found = centre.numpy(), spread.numpy()
    in_parts(lambda a, b: _locate(*given, *found, a, b), len(values))
    return centre, spread


@kernel
def _locate(
    values: Array,
    valid: Array,
    cut: float,
    floor: float,
    rounds: int,
    centres: Array,
    spreads: Array,
    begin: int,
    end: int,
) -> None:
    _, n, c = values.shape
    own, distance, scratch = np.empty((n, c)), np.empty(n), np.empty(n)
    for cluster in range(begin, end):
        count = 0
        for i in range(n):
            if valid[cluster, i]:
                own[count] = values[cluster, i]
                count += 1
        centre = centres[cluster]
        for axis in range(c):
            centre[axis] = _median(own[:, axis], count, scratch)
        _distances(own, count, centre, distance)
        total, square = 0.0, 0.0
        for _ in range(rounds):
            scale = max(cut * _median(distance, count, scratch), floor)
            mean = np.zeros(c)
            total, square = 0.0, 0.0
            for i in range(count):
                share = distance[i] / scale
                weight = max(1 - share * share, 0.0) ** 2
                scratch[i] = weight
                total += weight
                for axis in range(c):
                    mean[axis] += weight * own[i, axis]
            if total > 1e-9:  # else votes so scattered that none is near: the median stands
                for axis in range(c):
                    centre[axis] = mean[axis] / total
            _distances(own, count, centre, distance)
            for i in range(count):
                square += scratch[i] * distance[i] * distance[i]
        spreads[cluster] = np.sqrt(square / max(total, 1e-9))


@kernel
def _distances(own: Array, count: int, centre: Array, distance: Array) -> None:
    for i in range(count):
        square = 0.0
        for axis in range(own.shape[1]):
            off = own[i, axis] - centre[axis]
            square += off * off
        distance[i] = np.sqrt(square)


@kernel
def _median(values: Array, count: int, scratch: Array) -> float:
    """Lower median of the first `count` values (Hoare's selection)."""
    for i in range(count):
        scratch[i] = values[i]
    middle, a, b = (count - 1) // 2, 0, count - 1
    while a < b:
        pivot = scratch[(a + b) // 2]
        i, j = a, b
        while i <= j:
            while scratch[i] < pivot:
                i += 1
            while scratch[j] > pivot:
                j -= 1
            if i <= j:
                scratch[i], scratch[j] = scratch[j], scratch[i]
                i += 1
                j -= 1
        if middle <= j:
            b = j
        elif middle >= i:
            a = i
        else:
            break
    return scratch[middle]
