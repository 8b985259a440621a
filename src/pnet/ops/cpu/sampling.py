"""Farthest point sampling on a k-d tree."""

import numpy as np
import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import Array, Tree, box_distance, build_tree


def farthest_points(points: Tensor, count: int, start: int) -> Tensor:
    """See `pnet.ops.sampling.farthest_points`; clouds are spread over threads."""
    found = torch.empty(len(points), count, dtype=torch.int64)

    def run(first: int, last: int) -> None:
        for b in range(first, last):
            _sample(build_tree(points[b].numpy()), start, found[b].numpy())

    in_parts(run, len(points))
    return found


def _sample(tree: Tree, start: int, order: Array) -> None:
    taken = min(len(order), len(tree.number))
    _order(tree, start, taken, order)
    order[:] = np.resize(order[:taken], len(order))


@kernel
def _order(tree: Tree, start: int, count: int, order: Array) -> None:
    """Every node knows its point that is farthest from the sample; a new point touches few nodes."""
    place, index = tree.place, tree.number
    nodes, inner = len(tree.start), len(tree.start) // 2
    gap = np.full(len(index), np.inf, place.dtype)  # squared distance of each point from the sample
    far = np.full(nodes, np.inf, place.dtype)  # the largest below each node
    best = np.zeros(nodes, np.int64)  # where it stands
    touched = np.empty(nodes, np.int64)
    chosen = 0
    while index[chosen] != start:
        chosen += 1
    for step in range(count):
        order[step] = index[chosen]
        gap[chosen] = -1.0  # so that it is not chosen again, not even where points coincide
        x, y, z = place[chosen, 0], place[chosen, 1], place[chosen, 2]
        number, top = 0, 1
        touched[0] = 0
        while number < top:
            node = touched[number]
            number += 1
            if node < inner:
                for child in (2 * node + 1, 2 * node + 2):
                    inside = tree.start[child] <= chosen < tree.stop[child]
                    if inside or box_distance(tree.low, tree.high, child, x, y, z) < far[child]:
                        touched[top] = child
                        top += 1
        for k in range(top - 1, -1, -1):
            node = touched[k]
            if node < inner:
                left, right = 2 * node + 1, 2 * node + 2
                take = left
                if far[right] > far[left] or (
                    far[right] == far[left] and index[best[right]] < index[best[left]]
                ):
                    take = right
                far[node], best[node] = far[take], best[take]
            else:
                top_gap, top_place = gap[tree.start[node]], tree.start[node]
                for i in range(tree.start[node], tree.stop[node]):
                    dx, dy, dz = place[i, 0] - x, place[i, 1] - y, place[i, 2] - z
                    gap[i] = min(gap[i], dx * dx + dy * dy + dz * dz)
                    if i == tree.start[node]:
                        top_gap = gap[i]
                    if gap[i] > top_gap or (gap[i] == top_gap and index[i] < index[top_place]):
                        top_gap, top_place = gap[i], i
                far[node], best[node] = top_gap, top_place
        chosen = best[0]
