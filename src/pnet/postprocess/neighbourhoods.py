"""Compiled searches of neighbourhoods on the CPU: what mean shift and the radius filter spend their time on.

Every search, point or vote has one owner and one order of summation, so results do not depend on the number
of threads.
"""

import numpy as np
import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import STACK, Array, Tree, box_distance, build_tree

SEEDS, POINTS = 8, 1024  # that pay for a thread


def climb(points: Tensor, seeds: Tensor, bandwidth: float, stop: float, steps: int) -> tuple[Tensor, Tensor]:
    """Move every seed to the mean of the points around it until it stays.

    Args:
        points: (N, 3), N >= 1, seeds: (s, 3) float64, metres. bandwidth: radius around, metres.
        stop: a shorter step is the last one, metres. steps: at most.
    Returns:
        centres (s, 3) metres; intensity (s,) how many points were around at the last step.
    """
    tree = build_tree(points.contiguous().numpy())
    centres, intensity = seeds.clone(), seeds.new_zeros(len(seeds))
    arrays = centres.numpy(), intensity.numpy(), bandwidth * bandwidth, stop, steps
    in_parts(lambda a, b: _climb(tree, *arrays, a, b), len(seeds), SEEDS)
    return centres, intensity


def nearest_mode(points: Tensor, modes: Tensor, bandwidth: float) -> Tensor:
    """(N,) int64 the first of the nearest modes (d, 3); −1 where it is farther than the bandwidth."""
    labels = torch.empty(len(points), dtype=torch.int64)
    arrays = points.numpy(), modes.numpy(), bandwidth * bandwidth, labels.numpy()
    in_parts(lambda a, b: _nearest_mode(*arrays, a, b), len(points), POINTS)
    return labels


def near_enough(
    votes: Tensor, end: Tensor, neighbours: int, enough: float, widening: tuple[float, float, float]
) -> Tensor:
    """Which votes have so many others of their cluster within a radius, cluster by cluster.

    Args:
        votes: (N, 3) float64, metres, cluster after cluster. end: (d,) int64 where each ends.
        neighbours: how many others. enough: the share of a cluster's votes at which it is done.
        widening: the radius, by how much it grows until then, and up to where, metres.
    Returns:
        (N,) bool; all of a cluster where at the last radius there is none.
    """
    kept = torch.empty(len(votes), dtype=torch.bool)
    arrays = votes.contiguous().numpy(), end.numpy(), neighbours, enough, *widening, kept.numpy()
    in_parts(lambda a, b: _near_enough(*arrays, a, b), len(end))
    return kept


@kernel
def _climb(
    tree: Tree, centres: Array, intensity: Array, reach: float, stop: float, steps: int, begin: int, end: int
) -> None:
    inner = len(tree.start) // 2
    stack = np.empty(STACK, np.int64)
    for s in range(begin, end):
        centre = centres[s]
        for _ in range(steps):
            x, y, z = centre
            count, sx, sy, sz = 0, 0.0, 0.0, 0.0
            top = 1
            stack[0] = 0
            while top:  # in the tree's order: seeds that see the same points get the very same mean
                top -= 1
                node = stack[top]
                if box_distance(tree.low, tree.high, node, x, y, z) > reach:
                    continue
                if node < inner:
                    stack[top], stack[top + 1] = 2 * node + 2, 2 * node + 1
                    top += 2
                    continue
                for p in range(tree.start[node], tree.stop[node]):
                    px, py, pz = tree.place[p]
                    dx, dy, dz = px - x, py - y, pz - z
                    if dx * dx + dy * dy + dz * dz <= reach:
                        count += 1
                        sx, sy, sz = sx + px, sy + py, sz + pz
            intensity[s] = count
            if count == 0:
                break
            centre[0], centre[1], centre[2] = sx / count, sy / count, sz / count
            dx, dy, dz = centre[0] - x, centre[1] - y, centre[2] - z
            if np.sqrt(dx * dx + dy * dy + dz * dz) <= stop:
                break


@kernel
def _nearest_mode(points: Array, modes: Array, reach: float, labels: Array, begin: int, end: int) -> None:
    for i in range(begin, end):
        x, y, z = points[i]
        best, label = np.inf, -1
        for m in range(len(modes)):
            dx, dy, dz = modes[m, 0] - x, modes[m, 1] - y, modes[m, 2] - z
            value = dx * dx + dy * dy + dz * dz
            if value < best:
                best, label = value, m
        labels[i] = label if best <= reach else -1


@kernel
def _near_enough(
    votes: Array,
    end: Array,
    neighbours: int,
    enough: float,
    radius: float,
    widen: float,
    largest: float,
    kept: Array,
    begin: int,
    stop: int,
) -> None:
    for cluster in range(begin, stop):
        first, last = end[cluster - 1] if cluster else 0, end[cluster]
        reach = radius
        while first < last:
            found = 0
            for i in range(first, last):
                kept[i] = _has_neighbours(votes, first, last, i, neighbours, reach * reach)
                found += kept[i]
            if found / (last - first) >= enough:
                break
            reach += widen
            # a nanometre of slack: 0.01 + 5 · 0.002 is a little more than 0.02 in floating point
            if reach > largest + 1e-9 or widen <= 0:
                if found == 0:  # nothing is dense enough: better all votes than an instance without any
                    kept[first:last] = True
                break


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
