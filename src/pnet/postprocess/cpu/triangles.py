"""Nearest places on triangles on the CPU, compiled: what is too far off is passed over."""

import numpy as np
import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import Array

SLIM = 1e-12  # squared sine of an angle between two sides below which rounding decides what is inside


def nearest_on_triangles(
    local: Tensor, corners: Tensor, normals: Tensor, facing: Tensor
) -> tuple[Tensor, Tensor]:
    """See `pnet.postprocess.surface_registration`."""
    place = corners[0, 0].repeat(*local.shape[:2], 1)  # a copy, whatever the shape
    which = torch.zeros(local.shape[:2], dtype=torch.int64)
    middle = corners.mean(1)
    radius = torch.linalg.vector_norm(corners - middle[:, None], dim=-1).amax(1)
    shape = torch.cat([corners.flatten(1), normals, middle, radius[:, None]], 1)
    given = local.contiguous().numpy(), shape.contiguous().numpy(), facing.contiguous().numpy()
    in_parts(lambda a, b: _nearest_on_triangles(*given, place.numpy(), which.numpy(), a, b), len(local))
    return place, which


@kernel
def _nearest_on_triangles(
    local: Array, shape: Array, facing: Array, place: Array, which: Array, begin: int, end: int
) -> None:
    _, n, _ = local.shape
    number = np.empty(len(shape), np.int64)
    found = np.empty(3)
    for pose in range(begin, end):
        count = 0
        for i in range(len(shape)):
            if facing[pose, i]:
                number[count] = i
                count += 1
        for j in range(n):
            x, y, z = local[pose, j]
            least = square = np.inf
            for k in range(count):
                own = shape[number[k]]
                height = own[9] * (x - own[0]) + own[10] * (y - own[1]) + own[11] * (z - own[2])
                if abs(height) > least:
                    continue
                far = (x - own[12]) ** 2 + (y - own[13]) ** 2 + (z - own[14]) ** 2
                if far > (least + own[15]) ** 2:
                    continue
                off = _nearest_place(x, y, z, own, found)
                if off < square:
                    square, least = off, np.sqrt(off)
                    which[pose, j] = number[k]
                    place[pose, j] = found


@kernel
def _nearest_place(x: float, y: float, z: float, own: Array, found: Array) -> float:
    """Squared distance from one triangle, and the place on it."""
    bx, by, bz = own[3] - own[0], own[4] - own[1], own[5] - own[2]
    cx, cy, cz = own[6] - own[0], own[7] - own[1], own[8] - own[2]
    px, py, pz = x - own[0], y - own[1], z - own[2]
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    pb, pc = px * bx + py * by + pz * bz, px * cx + py * cy + pz * cz
    area = bb * cc - bc * bc
    u, v = cc * pb - bc * pc, bb * pc - bc * pb  # place = a + (u b + v c) / area
    least = np.inf
    if area > SLIM * bb * cc and u >= 0 and v >= 0 and u + v <= area:
        u, v = u / area, v / area
        found[0], found[1], found[2] = (
            own[0] + u * bx + v * cx,
            own[1] + u * by + v * cy,
            own[2] + u * bz + v * cz,
        )
        return (x - found[0]) ** 2 + (y - found[1]) ** 2 + (z - found[2]) ** 2
    for side in range(3):  # from a to b, from a to c, from b to c
        if side == 0:
            u = min(max(pb / bb, 0.0), 1.0) if bb > 0 else 0.0
            v = 0.0
        elif side == 1:
            u = 0.0
            v = min(max(pc / cc, 0.0), 1.0) if cc > 0 else 0.0
        else:
            length = bb - 2 * bc + cc
            v = min(max((pc - pb - bc + bb) / length, 0.0), 1.0) if length > 0 else 0.0
            u = 1 - v
        sx, sy, sz = u * bx + v * cx, u * by + v * cy, u * bz + v * cz
        off = (px - sx) ** 2 + (py - sy) ** 2 + (pz - sz) ** 2
        if off < least:
            least = off
            found[0], found[1], found[2] = own[0] + sx, own[1] + sy, own[2] + sz
    return least
