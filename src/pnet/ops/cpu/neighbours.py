"""Neighbour searches on a k-d tree."""

import numpy as np
import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import STACK, Array, Tree, box_distance, build_tree

SCAN = 1024  # points tried in index order before the tree is asked
ROWS = 64  # rows that pay for a thread


def ball_query(points: Tensor, centres: Tensor, limit: float, k: int) -> Tensor:
    """First k in index order with a squared distance of at most `limit`; see `pnet.ops.neighbours`."""
    found = torch.empty(len(points), centres.shape[1], k, dtype=torch.int64)
    for cloud, wanted, out in zip(points.numpy(), centres.numpy(), found.numpy(), strict=True):
        tree = build_tree(cloud)
        square = cloud.dtype.type(limit)
        in_parts(lambda a, b: _ball(tree, cloud, wanted, square, out, a, b), len(wanted), ROWS)  # noqa: B023
    return found


def nearest(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k nearest, by distance, then index; see `pnet.ops.neighbours`."""
    index = torch.empty(len(points), queries.shape[1], k, dtype=torch.int64)
    square = points.new_empty(index.shape)
    for cloud, wanted, i, d in zip(
        points.numpy(), queries.numpy(), index.numpy(), square.numpy(), strict=True
    ):
        tree = build_tree(cloud)
        in_parts(lambda a, b: _nearest(tree, wanted, i, d, a, b), len(wanted), ROWS)  # noqa: B023
    return index, square


def octants(points: Tensor, limit: float) -> Tensor:
    """Nearest in each octant with a squared distance of at most `limit`; see `pnet.ops.neighbours`."""
    found = torch.empty(*points.shape[:2], 8, dtype=torch.int64)
    for cloud, out in zip(points.numpy(), found.numpy(), strict=True):
        tree = build_tree(cloud)
        square = cloud.dtype.type(limit)
        in_parts(lambda a, b: _octants(tree, square, out, a, b), len(cloud), ROWS)  # noqa: B023
    return found


@kernel
def _ball(
    tree: Tree, points: Array, centres: Array, limit: float, found: Array, start: int, stop: int
) -> None:
    n, k = len(points), found.shape[1]
    scan = min(n, SCAN)
    stack = np.empty(STACK, np.int64)
    inner = len(tree.start) // 2
    for row in range(start, stop):
        x, y, z = centres[row, 0], centres[row, 1], centres[row, 2]
        out = found[row]
        held = 0
        for i in range(scan):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            if dx * dx + dy * dy + dz * dz <= limit:
                out[held] = i
                held += 1
                if held == k:
                    break
        if held < k and scan < n:
            held, top = 0, 1
            stack[0] = 0
            while top:
                top -= 1
                node = stack[top]
                if held == k and tree.first[node] > out[k - 1]:
                    continue
                if box_distance(tree.low, tree.high, node, x, y, z) > limit:
                    continue
                if node < inner:
                    stack[top], stack[top + 1] = 2 * node + 2, 2 * node + 1
                    top += 2
                    continue
                for i in range(tree.start[node], tree.stop[node]):
                    place = tree.place[i]
                    dx, dy, dz = place[0] - x, place[1] - y, place[2] - z
                    if dx * dx + dy * dy + dz * dz <= limit:
                        held = _insert_index(out, held, tree.number[i])
        filler = out[0] if held else _nearest_one(points, x, y, z)
        for i in range(held, k):
            out[i] = filler


@kernel
def _insert_index(out: Array, held: int, index: int) -> int:
    """Keep the smallest indices in rising order; how many are held afterwards."""
    if held == len(out):
        if index > out[held - 1]:
            return held
        held -= 1
    i = held
    while i > 0 and out[i - 1] > index:
        out[i] = out[i - 1]
        i -= 1
    out[i] = index
    return held + 1


@kernel
def _nearest_one(points: Array, x: float, y: float, z: float) -> int:
    best, nearest_index = np.inf, 0
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
        square = dx * dx + dy * dy + dz * dz
        if square < best:
            best, nearest_index = square, i
    return nearest_index


@kernel
def _nearest(tree: Tree, queries: Array, index: Array, square: Array, start: int, stop: int) -> None:
    k, n = index.shape[1], len(tree.number)
    stack = np.empty(STACK, np.int64)
    inner = len(tree.start) // 2
    for row in range(start, stop):
        x, y, z = queries[row, 0], queries[row, 1], queries[row, 2]
        d, best = square[row], index[row]
        for i in range(k):
            d[i], best[i] = np.inf, n
        top = 1
        stack[0] = 0
        while top:
            top -= 1
            node = stack[top]
            gap = box_distance(tree.low, tree.high, node, x, y, z)
            if gap > d[k - 1] or (gap == d[k - 1] and tree.first[node] > best[k - 1]):
                continue
            if node < inner:
                top = _open_nearer_last(tree, node, x, y, z, stack, top)
                continue
            for p in range(tree.start[node], tree.stop[node]):
                place = tree.place[p]
                dx, dy, dz = place[0] - x, place[1] - y, place[2] - z
                value, who = dx * dx + dy * dy + dz * dz, tree.number[p]
                if value > d[k - 1] or (value == d[k - 1] and who > best[k - 1]):
                    continue
                i = k - 1
                while i > 0 and (d[i - 1] > value or (d[i - 1] == value and best[i - 1] > who)):
                    d[i], best[i] = d[i - 1], best[i - 1]
                    i -= 1
                d[i], best[i] = value, who


@kernel
def _octants(tree: Tree, limit: float, found: Array, start: int, stop: int) -> None:
    n = len(tree.number)
    stack = np.empty(STACK, np.int64)
    best, who = np.empty(8, tree.place.dtype), np.empty(8, np.int64)
    inner = len(tree.start) // 2
    for row in range(start, stop):  # in the tree's order: neighbours follow each other
        x, y, z = tree.place[row, 0], tree.place[row, 1], tree.place[row, 2]
        me = tree.number[row]
        for o in range(8):
            best[o], who[o] = limit, n
        top = 1
        stack[0] = 0
        while top:
            top -= 1
            node = stack[top]
            if not _serves(tree.low, tree.high, node, x, y, z, best):
                continue
            if node < inner:
                top = _open_nearer_last(tree, node, x, y, z, stack, top)
                continue
            for p in range(tree.start[node], tree.stop[node]):
                place = tree.place[p]
                dx, dy, dz = place[0] - x, place[1] - y, place[2] - z
                value, i = dx * dx + dy * dy + dz * dz, tree.number[p]
                o = 4 * (dx > 0) + 2 * (dy > 0) + (dz > 0)
                if (value < best[o] or (value == best[o] and i < who[o])) and i != me:
                    best[o], who[o] = value, i
        for o in range(8):
            found[me, o] = who[o] if who[o] < n else me


@kernel
def _open_nearer_last(tree: Tree, node: int, x: float, y: float, z: float, stack: Array, top: int) -> int:
    """Put a node's children on the stack, the nearer one on top; the stack's new height."""
    left, right = 2 * node + 1, 2 * node + 2
    to_left = box_distance(tree.low, tree.high, left, x, y, z)
    to_right = box_distance(tree.low, tree.high, right, x, y, z)
    if to_left <= to_right:
        left, right = right, left
    stack[top], stack[top + 1] = left, right
    return top + 2


@kernel
def _serves(low: Array, high: Array, node: int, x: float, y: float, z: float, best: Array) -> bool:
    """Whether a node's box may hold, in some octant, a point as near as the best found there."""
    zero = x - x
    far = low.dtype.type(np.inf)  # a double would make the sums below differ from those of points
    x1 = max(zero, low[node, 0] - x) if high[node, 0] > x else far
    x0 = max(zero, x - high[node, 0]) if low[node, 0] <= x else far
    y1 = max(zero, low[node, 1] - y) if high[node, 1] > y else far
    y0 = max(zero, y - high[node, 1]) if low[node, 1] <= y else far
    z1 = max(zero, low[node, 2] - z) if high[node, 2] > z else far
    z0 = max(zero, z - high[node, 2]) if low[node, 2] <= z else far
    for o in range(8):
        dx, dy, dz = (x1 if o & 4 else x0), (y1 if o & 2 else y0), (z1 if o & 1 else z0)
        if dx * dx + dy * dy + dz * dz <= best[o]:
            return True
    return False
