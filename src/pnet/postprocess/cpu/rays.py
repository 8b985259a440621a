"""Rays against triangles on the CPU, compiled."""

import numpy as np
import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import Array


def first_hit(seen: Tensor, camera: Tensor, corners: Tensor, facing: Tensor) -> Tensor:
    """See `pnet.postprocess.surface_registration`."""
    found = torch.full(seen.shape[:2], torch.inf, dtype=torch.float64)
    rays = seen.contiguous().numpy(), camera.contiguous().numpy()
    triangles = corners.contiguous().numpy(), facing.contiguous().numpy()
    in_parts(lambda a, b: _first_hit(*rays, *triangles, found.numpy(), a, b), len(seen))
    return found


@kernel
def _first_hit(
    seen: Array, camera: Array, corners: Array, facing: Array, found: Array, begin: int, end: int
) -> None:
    forms = np.empty((len(corners), 9))  # of a ray's direction: share of each side, and of both with the rest
    height = np.empty(len(corners))
    for pose in range(begin, end):
        count = 0
        for i in range(len(corners)):
            if not facing[pose, i]:
                continue
            b, c, o = (
                corners[i, 1] - corners[i, 0],
                corners[i, 2] - corners[i, 0],
                camera[pose] - corners[i, 0],
            )
            own = forms[count]
            for k in range(3):
                m, n = (k + 1) % 3, (k + 2) % 3
                own[k] = c[m] * b[n] - c[n] * b[m]
                own[3 + k] = c[m] * o[n] - c[n] * o[m]
                own[6 + k] = o[m] * b[n] - o[n] * b[m]
            height[count] = -(o[0] * own[0] + o[1] * own[1] + o[2] * own[2])
            count += 1
        for j in range(seen.shape[1]):
            x, y, z = seen[pose, j] - camera[pose]
            for i in range(count):
                own = forms[i]
                # for a triangle that faces the camera all that follows is positive where the ray hits it
                towards = own[0] * x + own[1] * y + own[2] * z
                u = own[3] * x + own[4] * y + own[5] * z
                v = own[6] * x + own[7] * y + own[8] * z
                if towards > 0 and u >= 0 and v >= 0 and u + v <= towards:
                    found[pose, j] = min(found[pose, j], height[i] / towards)
