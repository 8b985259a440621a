"""A k-d tree over one cloud: halves along the longest side, tight boxes, the same shape for any cloud.

Nodes are numbered as in a heap: node i has the children 2i + 1 and 2i + 2. Rounding is monotone, so the
distance to a box, computed in the same order as that to a point, is never above that of a point in it; a
search that prunes by it therefore finds exactly what a search of all points finds.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnet.ops.cpu.compiled import kernel

Array = NDArray[Any]
LEAF = 12  # points of a leaf, at most
STACK = 64  # open nodes of a descent; a tree's depth is far below


class Tree(NamedTuple):
    """A cloud in the order of its leaves.

    Attributes:
        place: (n, 3) points. number: (n,) int64 where each stood in the cloud.
        start, stop: (nodes,) int64 the part of `place` below a node. low, high: (nodes, 3) its box.
        first: (nodes,) int64 the smallest number below it.
    """

    place: Array
    number: Array
    start: Array
    stop: Array
    low: Array
    high: Array
    first: Array


def build_tree(points: Array, leaf: int = LEAF) -> Tree:
    """The tree of points (n, 3), n >= 1, finite."""
    depth = 0
    while len(points) > leaf << depth:
        depth += 1
    return Tree(*_build(points, depth))


@kernel
def _build(points: Array, depth: int) -> tuple[Array, ...]:
    n, nodes = len(points), (2 << depth) - 1
    place, index = points.copy(), np.arange(n)
    start, stop = np.zeros(nodes, np.int64), np.zeros(nodes, np.int64)
    low, high = np.empty((nodes, 3), points.dtype), np.empty((nodes, 3), points.dtype)
    first = np.empty(nodes, np.int64)
    stop[0] = n
    for node in range(nodes):
        a, b = start[node], stop[node]
        first[node] = n
        for axis in range(3):
            low[node, axis], high[node, axis] = np.inf, -np.inf
        for i in range(a, b):
            first[node] = min(first[node], index[i])
            for axis in range(3):
                low[node, axis] = min(low[node, axis], place[i, axis])
                high[node, axis] = max(high[node, axis], place[i, axis])
        if 2 * node + 2 < nodes:
            axis = 0
            for other in range(1, 3):
                if high[node, other] - low[node, other] > high[node, axis] - low[node, axis]:
                    axis = other
            middle = (a + b) // 2
            _halve(place, index, a, b, middle, axis)
            start[2 * node + 1], stop[2 * node + 1] = a, middle
            start[2 * node + 2], stop[2 * node + 2] = middle, b
    return place, index, start, stop, low, high, first


@kernel
def _halve(place: Array, index: Array, a: int, b: int, middle: int, axis: int) -> None:
    """Reorder [a, b) so that no point before `middle` lies above one behind it (Hoare's selection)."""
    b -= 1
    while a < b:
        pivot = place[(a + b) // 2, axis]
        i, j = a, b
        while i <= j:
            while place[i, axis] < pivot:
                i += 1
            while place[j, axis] > pivot:
                j -= 1
            if i <= j:
                for k in range(3):
                    place[i, k], place[j, k] = place[j, k], place[i, k]
                index[i], index[j] = index[j], index[i]
                i += 1
                j -= 1
        if middle <= j:
            b = j
        elif middle >= i:
            a = i
        else:
            return


@kernel
def box_distance(low: Array, high: Array, node: int, x: float, y: float, z: float) -> float:
    """Squared distance of a place from a node's box."""
    zero = x - x
    dx = max(zero, low[node, 0] - x, x - high[node, 0])
    dy = max(zero, low[node, 1] - y, y - high[node, 1])
    dz = max(zero, low[node, 2] - z, z - high[node, 2])
    return dx * dx + dy * dy + dz * dz
