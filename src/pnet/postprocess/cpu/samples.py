"""Nearest samples of a surface on the CPU, compiled: those that no pose shows are passed over once."""

import numpy as np
import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import Array


def nearest_samples(local: Tensor, samples: Tensor, facing: Tensor) -> Tensor:
    """See `pnet.postprocess.surface_registration`."""
    found = torch.empty(local.shape[:2], dtype=torch.int64)
    given = local.contiguous().numpy(), samples.contiguous().numpy(), facing.contiguous().numpy()
    in_parts(lambda a, b: _nearest_samples(*given, found.numpy(), a, b), len(local))
    return found


@kernel
def _nearest_samples(local: Array, samples: Array, facing: Array, found: Array, begin: int, end: int) -> None:
    _, n, _ = local.shape
    x, y, z = np.empty(len(samples)), np.empty(len(samples)), np.empty(len(samples))
    number = np.empty(len(samples), np.int64)
    for pose in range(begin, end):
        count = 0
        for i in range(len(samples)):
            if facing[pose, i]:
                x[count], y[count], z[count] = samples[i, 0], samples[i, 1], samples[i, 2]
                number[count] = i
                count += 1
        for j in range(n):
            a, b, c = local[pose, j, 0], local[pose, j, 1], local[pose, j, 2]
            least, best = np.inf, 0
            for i in range(count):
                square = (x[i] - a) ** 2 + (y[i] - b) ** 2 + (z[i] - c) ** 2
                if square < least:
                    least, best = square, i
            found[pose, j] = number[best] if count else 0
