"""Mean shift's searches on the CPU: seeds climb over a k-d tree, modes near denser ones go, points choose.

Every seed and point has one owner and one order of summation.
"""

from functools import partial

import numpy as np
import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import STACK, Array, Tree, box_distance, build_tree

SEEDS, POINTS = 8, 1024  # that pay for a thread


def climb(
    points: Tensor, counted: Tensor, seeds: Tensor, bandwidth: float, stop: float, steps: int
) -> tuple[Tensor, Tensor]:
    """Move every seed to the mean of the points around it until it stays.

    Args:
        points: (B, N, 3), seeds: (B, S, 3) float64, metres; NaN behind a scene's last seed.
        counted: (B, N) bool, the points that are there. bandwidth: radius around, metres.
        stop: a shorter step is the last one, metres. steps: at most.
    Returns:
        centres (B, S, 3) metres; intensity (B, S) how many points were around at the last step.
    """
    centres, intensity = seeds.clone(), torch.zeros_like(seeds[..., 0])
    for cloud, mask, centre, around in zip(points, counted, centres, intensity, strict=True):
        number = int((centre[:, 0] == centre[:, 0]).sum())
        if number:  # then some points count
            tree = build_tree((cloud if bool(mask.all()) else cloud[mask]).contiguous().numpy())
            arrays = tree, centre.numpy(), around.numpy(), bandwidth * bandwidth, stop, steps
            in_parts(partial(_climb, *arrays), number, SEEDS)
    return centres, intensity


def distinct(centres: Tensor, seen: Tensor, bandwidth: float) -> Tensor:
    """Which centres are kept: those that are seen and not within a bandwidth of an earlier one kept.

    Args:
        centres: (B, S, 3) float64, metres. seen: (B, S) bool.
    Returns:
        (B, S) bool.
    """
    kept = torch.zeros_like(seen)
    for centre, own, keep in zip(centres, seen, kept, strict=True):
        _distinct(centre.numpy(), own.numpy(), bandwidth * bandwidth, keep.numpy())
    return kept


def nearest_mode(points: Tensor, modes: Tensor, number: Tensor, bandwidth: float) -> Tensor:
    """The first of the nearest modes of each point in its own scene.

    Args:
        points: (B, N, 3), modes: (B, S, 3) float64, metres. number: (B,) of each scene's modes.
    Returns:
        (B, N) int64; −1 where the mode is farther than the bandwidth.
    """
    labels = torch.empty(points.shape[:2], dtype=torch.int64)
    for cloud, mode, d, label in zip(points, modes, number.tolist(), labels, strict=True):
        arrays = cloud.numpy(), mode[:d].numpy(), bandwidth * bandwidth, label.numpy()
        in_parts(partial(_nearest_mode, *arrays), len(cloud), POINTS)
    return labels


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
def _distinct(centres: Array, seen: Array, reach: float, kept: Array) -> None:
    for i in range(len(centres)):
        free = seen[i]
        for j in range(i):
            if not free:
                break
            if kept[j]:
                dx, dy, dz = (
                    centres[i, 0] - centres[j, 0],
                    centres[i, 1] - centres[j, 1],
                    centres[i, 2] - centres[j, 2],
                )
                free = dx * dx + dy * dy + dz * dz > reach
        kept[i] = free


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
